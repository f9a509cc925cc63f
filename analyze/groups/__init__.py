"""`vla-attention groups`: what a grouping takes, before any number."""
