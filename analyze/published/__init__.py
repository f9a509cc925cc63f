"""The results files of the published scripts and ours: written, read, and as tables."""
