"""Several processes that fill one store: claims on episodes, records of each process, SIGTERM, SLURM, and the status of a store."""
