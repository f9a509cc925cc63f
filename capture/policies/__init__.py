"""The policies whose attention can be recorded: one folder per family, registered in `families.py`."""
