"""`vla-attention compare`: runs paired by initial state and seed."""
