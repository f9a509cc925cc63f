"""Files from elsewhere: checked, or read in a process with limits; nothing in them is executed."""
