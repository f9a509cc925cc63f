"""`vla-attention copy`: a copy of a store: smaller, packed, from elsewhere, or uploaded."""
