"""One episode: the attention function that emits rows, the rollout, and the loop over episodes."""
