"""`vla-analyze compare`: runs paired by initial state and seed."""
