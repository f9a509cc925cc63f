"""Arrays that are written as they grow are those that are written at once, and wait in no memory meanwhile."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
import zarr
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.kit.examples import examples
from tests.kit.stores import StoreSpec, denoise_times, episode_records, root_attributes
from vla_attention.capture.store import codecs, site_writer
from vla_attention.capture.store.codecs import write_whole
from vla_attention.capture.store.episode_writer import StoreWriteFailed
from vla_attention.capture.store.growing_arrays import GrowingArray, SpilledArrays
from vla_attention.capture.store.store_writer import open_run


@given(
    counts=st.lists(st.integers(0, 5), min_size=1, max_size=12).filter(any),
    rest=st.sampled_from([(), (3,), (2, 5), (40,)]),
    dtype=st.sampled_from([np.float32, np.float64, np.uint8]),
    target=st.sampled_from([1, 64, 400, 1 << 20]),
)
@settings(max_examples=examples(60))
def test_it_is_what_is_written_at_once(tmp_path_factory, counts, rest, dtype, target):
    folder = tmp_path_factory.mktemp("arrays")
    stream = np.random.default_rng(0)
    parts = [(stream.random((count, *rest)) * 200).astype(dtype) for count in counts]
    axes = ("replan", *(f"axis_{i}" for i in range(len(rest))))
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(codecs, "TARGET_CHUNK_BYTES", target)
        group = zarr.create_group(folder, zarr_format=3)
        write_whole(group, "whole", np.concatenate(parts), axes)
        growing = GrowingArray(group, folder, "growing", axes)
        for part in parts:
            growing.append(part)
        record = growing.finish()
    given_files, wanted = (
        {file.relative_to(folder / name).as_posix(): file for file in (folder / name).rglob("*") if file.is_file()}
        for name in ("growing", "whole")
    )
    assert given_files.keys() == wanted.keys()
    assert given_files["zarr.json"].read_bytes() == wanted["zarr.json"].read_bytes()
    np.testing.assert_array_equal(group["growing"][...], group["whole"][...])
    assert record.shape == group["whole"].shape


def test_spilled_arrays_are_read_by_cell(tmp_path):
    waiting = SpilledArrays(tmp_path / "episode", "<f4")
    for _ in range(2):
        arrays = [np.random.default_rng(i).random((2, 3, 4 + i)).astype(np.float32) for i in range(3)]
        for array in arrays:
            waiting.append(array[::-1])  # not contiguous
        assert len(waiting) == 3
        for number, array in enumerate(arrays):
            np.testing.assert_array_equal(waiting.part(number), array[::-1])
            np.testing.assert_array_equal(waiting.part(number, 1, 2), array[0, 2])
        waiting.clear()
    waiting.close()
    assert list(tmp_path.iterdir()) == []


def test_memory_does_not_grow_with_replans(tmp_path, monkeypatch):
    """Rows, masses, pictures and facts of replans are on the disk; chunks are made small so that many are full."""
    monkeypatch.setattr(codecs, "TARGET_CHUNK_BYTES", 1 << 12)
    monkeypatch.setattr(site_writer, "_MOST_WAITING", 0)
    monkeypatch.setattr(site_writer, "_MOST_BESIDE", 0)
    spec = StoreSpec(queries="all", prompts="same", contributions=True, heads=tuple(range(8)), num_action_queries=8)
    start, records = episode_records(spec, 0, 0)
    store = open_run(tmp_path / "a.zarr", root_attributes(spec), "new")
    held = []
    with store.episode(start, denoise_times(spec)) as writer:
        tracemalloc.start()
        for number in range(200):
            record = records[number % len(records)]
            writer.append(replace(record, env_step=number, noise_seed=number))
            if number % 50 == 49:
                held.append(tracemalloc.get_traced_memory()[0])
        tracemalloc.stop()
    of_replan = sum(rows.rows.nbytes for rows in records[0].rows.values())
    of_replan += sum(values.nbytes for values, _ in records[0].arrays.values())
    assert (held[3] - held[1]) / 100 < of_replan / 4  # facts, and where chunks are


def test_an_episode_of_which_a_replan_failed_halfway_is_refused(tmp_path, monkeypatch):
    start, records = episode_records(spec := StoreSpec(), 0, 0)
    store = open_run(tmp_path / "a.zarr", root_attributes(spec), "new", durable=False)
    append, calls = GrowingArray.append, []

    def failing(array, values):
        calls.append(values)
        if len(calls) == 3:
            raise OSError(28, "No space left on device")
        append(array, values)

    monkeypatch.setattr(GrowingArray, "append", failing)
    with store.episode(start, denoise_times(spec)) as writer:
        with pytest.raises(StoreWriteFailed, match="No space left"):
            writer.append(records[0])
        for add in (lambda: writer.append(records[0]), lambda: writer.commit(True, 15)):
            with pytest.raises(StoreWriteFailed, match="not written wholly"):
                add()
    assert list((tmp_path / "a.zarr" / "episodes").glob("task*")) == []


@pytest.mark.parametrize("committed", [True, False])
def test_what_waits_on_the_disk_is_given_back(tmp_path, monkeypatch, committed):
    monkeypatch.setattr(site_writer, "_MOST_WAITING", 0)
    monkeypatch.setattr(site_writer, "_MOST_BESIDE", 0)
    opened = []

    def kept(*args):
        opened.append(SpilledArrays(*args))
        return opened[-1]

    monkeypatch.setattr(site_writer, "SpilledArrays", kept)
    start, records = episode_records(spec := StoreSpec(), 0, 0)
    store = open_run(tmp_path / "a.zarr", root_attributes(spec), "new", durable=False)
    with store.episode(start, denoise_times(spec)) as writer:
        for record in records:
            writer.append(record)
        if committed:
            writer.commit(True, 15)
    assert len(opened) == 3
    assert all(one._file.closed for one in opened)
