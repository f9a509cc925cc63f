"""`vla-analyze repair`: moves damaged episodes out of a store."""
