"""`vla-attention deviation`: how far a policy's actions are from those of the data set that it was replayed over."""
