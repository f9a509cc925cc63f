"""Cosmos Policy in plain torch: the diffusion transformer, its sampler, observation to action, and its two attention sites."""
