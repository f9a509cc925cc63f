"""`vla-analyze words`: which words of the instruction are read."""
