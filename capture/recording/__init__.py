"""Attention with recorded rows: the attention function of all policies, the recorder of its rows, and the contributions."""
