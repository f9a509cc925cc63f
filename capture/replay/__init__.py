"""Policy calls on recorded data sets of robots, without a simulator: `vla-capture replay`, and the readers."""
