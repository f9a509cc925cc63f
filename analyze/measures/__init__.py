"""From rows and groups to masses, ratios and contribution norms, as tables of steps, replans, episodes and tasks."""
