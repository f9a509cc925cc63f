"""The contract between the two stages: token layout, groupings, store, results. numpy at most; no torch, no zarr I/O."""
