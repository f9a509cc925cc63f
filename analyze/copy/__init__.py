"""`vla-analyze copy`: a smaller copy of a store."""
