"""`vla-attention export`: tables as CSV or Parquet, masses and rows as NetCDF."""
