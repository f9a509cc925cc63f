"""What every question shows its results with: text tables, headings, result files, progress, plot style, shared plots."""
