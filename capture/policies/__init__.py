"""The policies whose attention can be recorded, and what they all offer the rollout."""
