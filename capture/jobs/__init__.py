"""Many processes, one store: claims, SLURM jobs, run records, SIGTERM, status."""
