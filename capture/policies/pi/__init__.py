"""pi0 and pi0.5 in plain torch: models, checkpoints, prompts, preprocessing, and a small untrained policy."""
