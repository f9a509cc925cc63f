"""The published scripts' command lines and the variables of their batch scripts."""
