"""`vla-analyze report`: one self-contained HTML file."""
