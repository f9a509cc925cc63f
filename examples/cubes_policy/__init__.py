"""A small pi0.5 for the suite `cubes`: demonstrations, training, evaluation; `python -m` runs the commands."""
