"""Stage two: from stored rows, without the model: masses, ratios, statistics, tables, plots. Never imports torch or mujoco."""
