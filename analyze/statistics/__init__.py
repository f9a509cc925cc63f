"""Statistics over episodes: intervals, effect sizes, autocorrelation. Pure functions on arrays."""
