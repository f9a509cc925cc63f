"""From a question to tables: masses, aggregation over replans and episodes, contribution norms, sinks, maps of patches."""
