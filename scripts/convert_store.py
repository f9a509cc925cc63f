"""Bring stores of before 30 November 2026 up to date: rows as float16 of p x 2^15, and seals with checksums of chunks.

Usage: python scripts/convert_store.py STORE.zarr|STORE.tar.xz [...]

Stores are changed in place, one episode after the other; what is up to date stays as it is. Probabilities above 2^-29
stay the same to the bit, smaller ones move by at most 2^-40. Sums of rows go behind the masses of segments. What
uniform attention gives is left out where the keys' roles say it. Run it again after an interruption.
"""

from __future__ import annotations

import json
import shutil
import sys
import tempfile
from pathlib import Path

import numpy as np
import zarr

from vla_attention.capture.store.codecs import RowCodec, keys_per_chunk, write_whole
from vla_attention.capture.store.site_writer import ShardWriter
from vla_attention.schemas.jsonable import to_json
from vla_attention.schemas.stores.digest import ArrayDigest
from vla_attention.schemas.stores.reader import Store, StoredEpisode, open_store
from vla_attention.schemas.stores.seal import seal_episode
from vla_attention.schemas.stores.store_format import ATOM_AXES, ROW_AXES
from vla_attention.schemas.stores.tar_files import unpack, write_tar


def main() -> int:
    """Convert the stores that are named; returns the exit code."""
    if len(sys.argv) < 2:
        print(__doc__)
        return 2
    for given in map(Path, sys.argv[1:]):
        if given.is_dir():
            print(f"{given}: {convert(given)} episodes converted")
            continue
        with tempfile.TemporaryDirectory() as folder:
            unpack(given, Path(folder))
            (store,) = Path(folder).iterdir()
            number = convert(store)
            if number:
                write_tar(store, given)
        print(f"{given}: {number} episodes converted")
    return 0


def convert(path: Path) -> int:
    """Convert each episode whose rows have another form; returns how many."""
    store = open_store(path)
    return sum(_convert_episode(store, episode, path / "episodes" / episode.name) for episode in store.episodes)


def _convert_episode(store: Store, episode: StoredEpisode, folder: Path) -> bool:
    bits = store.attributes.recording.mantissa_bits
    if not any(name.endswith("/row_sum") for name in episode.attributes.arrays):
        return False
    for file in episode.files.records:
        episode.files.check(file)
    with tempfile.TemporaryDirectory(dir=folder.parent.parent, prefix=".converting_") as temporary:
        building = Path(temporary) / folder.name
        shutil.copytree(folder, building)
        document = json.loads((building / "zarr.json").read_bytes())
        arrays = document["attributes"]["arrays"]
        for site in store.attributes.sites:
            name = f"{site.name}/rows"
            group, keys = zarr.open_group(building, mode="r+", zarr_format=3), keys_per_chunk(site)
            if group[name].dtype != RowCodec.of_bits(bits).dtype:
                rows = np.asarray(group[name])
                shutil.rmtree(building / name)
                writer = ShardWriter(group, building, name, rows.shape[1:], bits, keys)
                for of_replan in rows:
                    writer.append(of_replan)
                arrays[name] = to_json(writer.finish(ROW_AXES))
            if (sums := f"{site.name}/row_sum") in arrays:
                atoms = np.concatenate([group[f"{site.name}/atoms"][:], group[sums][:][..., None]], axis=-1)
                shutil.rmtree(building / sums)
                shutil.rmtree(building / f"{site.name}/atoms")
                write_whole(group, f"{site.name}/atoms", atoms, ATOM_AXES)
                digest = ArrayDigest()
                digest.update(atoms)
                arrays[f"{site.name}/atoms"] = {"shape": atoms.shape, "sha256": digest.hexdigest()}
                del arrays[sums]
            uniform = f"{site.name}/uniform"
            if uniform in arrays and (np.asarray(group[uniform]) == episode.uniform_of_roles(site.name)).all():
                shutil.rmtree(building / uniform)
                del arrays[uniform]
        (building / "zarr.json").write_text(json.dumps(document, indent=2))
        seal_episode(building, episode.name, episode.seal.run, episode.captured)
        old = Path(temporary) / "old"
        folder.rename(old)
        building.rename(folder)
    return True


if __name__ == "__main__":
    sys.exit(main())
