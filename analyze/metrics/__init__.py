"""Metrics of rows, keys, heads and layers: pure functions on arrays, and the tables that are made with them."""
