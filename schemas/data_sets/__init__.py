"""Data sets of robots in the formats of LeRobot, read without it and without torch."""
