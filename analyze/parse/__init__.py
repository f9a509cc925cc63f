"""`parse-attention-ratio-results`: results files of anybody, as numbers, text and plots."""
