"""Small stores that come along, to try questions on: `va.open(example_stores.CUBES)`.

They are recordings of `pi05_cubes`, a pi0.5 of 1.5 million parameters for coloured cubes on a table (docs/cubes.md),
packed into one file an episode. `scripts/make_example_stores.py` makes them, and says what is in them.
"""

from __future__ import annotations

from pathlib import Path

FOLDER = Path(__file__).parent
#: "touch the red (green, blue) cube", two episodes each, with pictures, and effects of words and cameras.
CUBES = FOLDER / "cubes.zarr"
#: The same initial states and noise, by a copy of the policy to which the three colour words are the same.
ONE_COLOUR = FOLDER / "cubes_one_colour.zarr"
#: A rerun: the first episode of each task of `CUBES` again, with other noise.
NOISE = FOLDER / "cubes_noise.zarr"
