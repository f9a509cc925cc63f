"""Rows as the analysis gets them: against the raw arrays, without missing values, no more bytes than are needed."""

import re
from pathlib import Path

import numpy as np
import pytest
import zarr

from vla_attention.analyze.measures.question import ask
from vla_attention.analyze.measures.question_settings import AnalysisSettings
from vla_attention.analyze.measures.steps import measure_episodes
from vla_attention.analyze.stores.rows import layer_rows
from vla_attention.analyze.stores.selection import select
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.store_format import CorruptEpisode
from vla_attention.testing.stores import StoreSpec, reseal, write_store
from vla_attention.testing.tokens import libero_tokens


def raw_rows(path: Path) -> np.ndarray:
    return zarr.open_array(path / "episodes/task000_episode000/joint/rows", mode="r")[:]


@pytest.mark.parametrize("queries", ["mean", "all"])
@pytest.mark.parametrize("heads", [None, [3, 1]])
@pytest.mark.parametrize("per_head", [True, False])
def test_rows_are_numpys_means_of_the_stored_ones_to_the_last_bit(tmp_path, queries, heads, per_head):
    path = write_store(tmp_path / "a.zarr", tasks=(0,), episodes=1, replans=11, heads=(0, 1, 3), queries=queries)
    store = open_store(path)
    selection = select(store.attributes, layers=[2, 0], heads=heads, per_head=per_head)
    raw = raw_rows(path)
    seen = []
    for part in layer_rows(store.attributes, store.episodes[0], selection, "joint"):
        expected = raw[:, selection.layers[part.layer], selection.denoise[part.denoise]][:, list(selection.heads)]
        expected = expected.mean(axis=2) if queries == "all" else expected[:, :, 0]
        if not per_head:
            expected = expected.mean(axis=1, keepdims=True)
        np.testing.assert_array_equal(part.rows, expected)
        seen.append((part.layer, part.denoise))
    assert seen == [(0, 0), (0, 1), (1, 0), (1, 1)]


def test_a_caller_can_keep_heads_apart_whatever_the_selection_says(tmp_path):
    path = write_store(tmp_path / "a.zarr", tasks=(0,), episodes=1, heads=(0, 1, 3))
    store = open_store(path)
    first = next(layer_rows(store.attributes, store.episodes[0], select(store.attributes), "joint", per_head=True))
    np.testing.assert_array_equal(first.rows, raw_rows(path)[:, 0, 0, :, 0])


@pytest.mark.parametrize("per_head", [True, False])
@pytest.mark.parametrize("queries", ["mean", "all"])
def test_one_missing_value_in_one_head_is_an_error(tmp_path, per_head, queries):
    path = write_store(tmp_path / "a.zarr", tasks=(0,), episodes=1, replans=11, queries=queries)
    folder = path / "episodes/task000_episode000"
    rows = zarr.open_array(folder / "joint/rows", mode="r+")
    rows[7, 1, 1, 1, 0, 5] = np.nan
    reseal(folder)
    store = open_store(path)
    selection = select(store.attributes, per_head=per_head)
    with pytest.raises(CorruptEpisode, match="joint/rows of episode task000_episode000 has missing values"):
        list(layer_rows(store.attributes, store.episodes[0], selection, "joint"))
    others = select(store.attributes, layers=[0], per_head=per_head)
    assert len(list(layer_rows(store.attributes, store.episodes[0], others, "joint"))) == 2


@pytest.mark.skipif(not Path("/proc/self/io").exists(), reason="the system does not count the bytes that are read")
def test_three_layers_of_eighteen_read_a_quarter_of_the_bytes_at_most(tmp_path):
    spec = StoreSpec(
        tasks=(0,), episodes=2, layers=tuple(range(18)), num_layers=18, frames=False, tokens=libero_tokens(16)
    )
    path = write_store(tmp_path / "a.zarr", spec=spec)

    def bytes_read(layers: tuple[int, ...] | None) -> int:
        before = read_so_far()
        settings = AnalysisSettings(groups=("soup=word:soup", "v=role:image"), ratio="v/soup", layers=layers)
        measure_episodes(ask([open_store(path)], settings))
        return read_so_far() - before

    bytes_read((0,))  # modules that are imported on first use
    every, three = bytes_read(None), bytes_read((3, 4, 17))
    assert every > (path / "episodes").stat().st_size + sum(shard_sizes(path)) * 0.9  # the counter counts
    assert three < every / 4


def read_so_far() -> int:
    found = re.search(r"rchar: (\d+)", Path("/proc/self/io").read_text())
    assert found is not None
    return int(found[1])


def shard_sizes(path: Path) -> list[int]:
    return [file.stat().st_size for file in path.rglob("joint/rows/c.*")]
