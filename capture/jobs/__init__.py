"""Several processes that fill one store: their locks and logs, SIGTERM, SLURM, and the status."""
