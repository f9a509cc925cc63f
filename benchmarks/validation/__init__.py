"""Whether what this tool prints tells on what a policy acts: `docs/validation.md` is made here."""
