"""Scripts, notebooks, and `cubes_policy`, which `python -m examples.cubes_policy` runs from the top of a clone."""
