"""`vla-attention overlay`: attention on the stored pictures, as strips and videos."""
