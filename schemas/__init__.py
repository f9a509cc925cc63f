"""The contract between the two stages: token layout, groupings, store, results. No torch; zarr only where stores are read."""
