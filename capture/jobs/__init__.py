"""Several processes that fill one store: their claims on episodes and their records, SIGTERM, SLURM, and the status."""
