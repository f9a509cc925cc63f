"""`vla-attention view`: a local page on which the attention of a store is explored."""
