"""The machine that a run has: memory, torch with its device, and what an episode's provenance says of it."""
