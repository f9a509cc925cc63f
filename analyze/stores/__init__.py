"""Stored episodes as an analysis takes them: selected, read row by row, described."""
