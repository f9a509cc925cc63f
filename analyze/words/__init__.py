"""`vla-attention words`: which words of the instruction are read."""
