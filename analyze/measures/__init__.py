"""From a question to tables: masses, means over replans and episodes, contribution norms, sinks, maps of patches."""
