"""Stores on disk: reading, selecting, verifying, copying, describing. Zarr is touched nowhere else."""
