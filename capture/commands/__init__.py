"""The command line of stage one: arguments of every command, and how one is run."""
