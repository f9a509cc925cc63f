"""`vla-attention verify`: reads a store back and checks it."""
