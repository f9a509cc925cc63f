"""Stores, results files and groupings that attack memory, time, paths, links and text, with what must be said of each.

`python -m tests.thorough.hostile.make FOLDER` writes all of them.
"""
