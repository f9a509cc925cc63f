"""A store of many episodes from one of a few: their arrays are hard links, so that it takes little room on the disk.

Each episode has an index and a seal of its own, so that everything is read and checked as in a store that was captured.
"""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path


def repeat_store(source: Path, path: Path, times: int) -> Path:
    """Write a store with every episode of `source` so many times, each under another index; returns its path."""
    from vla_attention.schemas.stores.reader import open_store
    from vla_attention.schemas.stores.seal import seal_episode
    from vla_attention.schemas.stores.store_format import episode_name

    store = open_store(source)
    partial = path.with_name(f"{path.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    (partial / "episodes").mkdir(parents=True)
    for document in ("zarr.json", "episodes/zarr.json"):
        if (source / document).exists():
            shutil.copy(source / document, partial / document)
    indices = max(episode.attributes.episode_index for episode in store.episodes) + 1
    for episode in store.episodes:
        attributes = episode.attributes
        for number in range(times):
            index = attributes.episode_index + number * indices
            name = episode_name(attributes.task_id, index)
            folder = partial / "episodes" / name
            shutil.copytree(episode.folder, folder, copy_function=os.link)
            document = json.loads((folder / "zarr.json").read_bytes())
            document["attributes"]["episode_index"] = index
            for changed in ("zarr.json", "seal/zarr.json"):  # not through the link: the source stays as it is
                (folder / changed).unlink()
            (folder / "zarr.json").write_text(json.dumps(document))
            seal_episode(folder, name, episode.run)
    partial.rename(path)
    return path
