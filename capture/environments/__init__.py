"""Simulation environments behind one small interface. Importing `suites` loads no simulator."""
