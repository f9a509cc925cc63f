"""The cache: what was measured of an episode is kept beside the results, and is not measured a second time."""
