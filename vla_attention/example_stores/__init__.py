"""Small stores that are shipped, an archive each: `va.example("cubes")` is the path of one.

They are recordings of `pi05_cubes`, a pi0.5 of 1.5 million parameters for coloured cubes (docs/validation.md).
`scripts/make_example_stores.py` makes them, and says what is in them.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
from pathlib import Path

from vla_attention.schemas.errors import unknown_name
from vla_attention.schemas.stores.tar_files import unpack
from vla_attention.schemas.user_cache import user_cache

FOLDER = Path(__file__).parent
#: cubes: "touch the red (green, blue) cube", two episodes each, with pictures, and effects of words and cameras.
#: cubes_one_colour: the same initial states and noise, by a copy of the policy to which the colours are one word.
#: cubes_noise: a rerun, the first episode of each task of cubes again, with other noise.
EXAMPLES = ("cubes", "cubes_one_colour", "cubes_noise")


def archive_of(name: str) -> Path:
    """The archive of an example store; raises `UnknownName` for one that there is not."""
    if name not in EXAMPLES:
        raise unknown_name("example store", name, EXAMPLES)
    return FOLDER / f"{name}.tar.xz"


def example(name: str) -> Path:
    """The path of an example store, which is unpacked once into the user's cache (below `XDG_CACHE_HOME`).

    Raises:
        UnknownName: there is no such store; the error lists those that there are.
    """
    archive = archive_of(name)
    folder = user_cache("examples") / hashlib.sha256(archive.read_bytes()).hexdigest()[:16]
    store = folder / f"{name}.zarr"
    if not store.is_dir():
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder) as building:
            unpack(archive, Path(building))
            try:
                os.rename(Path(building) / store.name, store)
            except OSError:
                if not store.is_dir():  # no other process was faster
                    raise
    return store
