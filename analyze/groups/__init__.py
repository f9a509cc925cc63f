"""`vla-analyze groups`: what a grouping takes, before any number."""
