"""Cosmos Policy in plain torch: diffusion transformer, sampler, observation to action, and both attention sites."""
