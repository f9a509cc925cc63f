"""`vla-attention heads`: heads, layers, depth and denoise steps; entropy, largest keys and sinks of single rows."""
