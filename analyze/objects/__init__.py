"""`vla-attention objects`: which objects are looked at, and how well attention finds them."""
