"""`vla-attention store`: copies of stores, one store of several, checks."""
