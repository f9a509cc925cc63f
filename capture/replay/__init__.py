"""Policy calls on recorded data sets of robots, without a simulator: `capture replay`, and the readers."""
