"""The contract between the two stages: token layout, groupings, store, results; and the reading and checking of stores.

No torch. zarr is imported when an array is opened.
"""
