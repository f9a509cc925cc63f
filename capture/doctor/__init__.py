"""`vla-capture doctor`: what this machine can do for a run, and whether a published checkpoint does what it should."""
