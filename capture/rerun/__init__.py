"""Running stored policy calls again, without a simulator: unchanged, or with interventions."""
