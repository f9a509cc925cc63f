"""`vla-attention effects`: how much actions change under interventions, beside the attention of the same replans."""
