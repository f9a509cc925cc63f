"""`vla-attention report`: one self-contained HTML file."""
