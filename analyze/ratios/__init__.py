"""`vla-attention analyze STORE`: masses, fractions and ratios with intervals, the summary and the default plots."""
