"""Interventions: the arithmetic on attention, the keys that they name, and changed prompts and pictures."""
