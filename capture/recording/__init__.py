"""The attention function of all policies, the recorder of its rows, and the contributions of the keys."""
