"""Statistics over episodes: intervals, effect sizes, many looks, autocorrelation. Pure functions, no draws."""
