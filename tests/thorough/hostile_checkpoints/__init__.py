"""Checkpoints that attack memory, time, paths and the machine, each with the sentence that refuses it."""
