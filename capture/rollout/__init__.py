"""Running a policy in an environment: one episode, the loop over episodes, and their progress on the terminal."""
