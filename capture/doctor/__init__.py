"""`vla-attention capture doctor`: what a run needs, and what this machine lacks of it."""
