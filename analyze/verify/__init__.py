"""`vla-analyze verify`: reads a store back and checks it."""
