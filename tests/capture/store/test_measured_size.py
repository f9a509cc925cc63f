"""The size that is measured on a few replans is within 10 % of what a long episode takes, whatever is recorded."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.capture.store.test_disk_estimate import large_tokens
from vla_attention.capture.store.codecs import TARGET_CHUNK_BYTES
from vla_attention.capture.store.measured_size import ArraySize, SampleOfReplans, smaller_record
from vla_attention.testing.stores import StoreSpec, denoise_times, episode_records, root_attributes, write_store

SPEC = StoreSpec(
    tokens=large_tokens(40),
    tasks=(0,),
    episodes=1,
    layers=(0, 1, 2),
    num_layers=3,
    heads=(0, 1, 2, 3),
    denoise_steps=(0, 4, 9),
    contributions=True,
)


def sample_of(spec: StoreSpec, replans: int) -> SampleOfReplans:
    start, records = episode_records(spec, 0, 0)
    return SampleOfReplans(root_attributes(spec), start, denoise_times(spec), records[:replans])


def bytes_written(spec: StoreSpec, folder: Path) -> int:
    episode = write_store(folder / "a.zarr", spec=spec) / "episodes" / "task000_episode000"
    return sum(file.stat().st_size for file in episode.rglob("*") if file.is_file())


@pytest.mark.parametrize(
    "changes",
    [
        {"mantissa_bits": 23},
        {"mantissa_bits": 10},
        {"mantissa_bits": 7},
        {"mantissa_bits": 4},
        {"layers": (2,), "denoise_steps": (9,), "heads": (1, 3)},
        {"layers": (0, 2), "contributions": False},
        {"frames": False, "denoise_steps": (0, 9)},
    ],
    ids=str,
)
def test_a_long_episode_takes_what_eight_replans_say(tmp_path, changes):
    spec = replace(SPEC, **changes)
    asked = root_attributes(spec).recording
    # A run without pictures is tried without them; all else is taken from one sample.
    sample = sample_of(replace(SPEC, frames=spec.frames), 8)
    sizes = sample.size(asked)
    assert sizes.bytes_of(40) == pytest.approx(bytes_written(spec, tmp_path), rel=0.1)
    estimate = sizes.estimate(40, 3)
    assert estimate.total_bytes == pytest.approx(3 * sizes.bytes_of(40), rel=1e-3)


def test_pictures_in_front_of_one_background_are_counted_by_the_chunk(tmp_path):
    """The first picture of a chunk takes much more than the next ones, and long episodes have several chunks."""
    spec = StoreSpec(tokens=large_tokens(60, pixels=200), tasks=(0,), episodes=1, layers=(0,), num_layers=1)
    start, records = episode_records(spec, 0, 0)
    noise = np.random.default_rng(0).integers(0, 255, (200, 200, 3), dtype=np.uint8)
    assert 60 * noise.nbytes > 3 * TARGET_CHUNK_BYTES
    still = []
    for number, record in enumerate(records):
        frames = {camera: noise.copy() for camera in record.frames}
        for frame in frames.values():
            frame[number : number + 20, :20] = number  # something small that moves
        still.append(replace(record, frames=frames))
    from vla_attention.capture.store.store_writer import open_run

    attributes = root_attributes(spec)
    with open_run(tmp_path / "a.zarr", attributes, "new", durable=False).episode(
        start, denoise_times(spec), 60
    ) as writer:
        for record in still:
            writer.append(record)
        folder = writer.commit(True, 10)
    real = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
    sample = SampleOfReplans(attributes, start, denoise_times(spec), still[:8])
    assert sample.size(attributes.recording).bytes_of(60) == pytest.approx(real, rel=0.1)


def test_the_bytes_of_a_sample_are_those_of_its_episode(tmp_path):
    whole = sample_of(SPEC, 40)
    # Only the outcome, which nobody knows of a sample, is written otherwise.
    assert whole.bytes_written(whole.attributes.recording) == pytest.approx(bytes_written(SPEC, tmp_path), rel=1e-4)


def test_bytes_of_an_array():
    size = ArraySize(per_chunk=100, per_replan=10, chunk=4)
    assert [size.bytes_of(count) for count in (1, 4, 5, 8, 9)] == [110, 140, 250, 280, 390]


def test_a_smaller_record_has_the_chosen_rows_of_the_chosen_numbers():
    attributes = root_attributes(SPEC)
    full = attributes.recording
    record = episode_records(SPEC, 0, 0)[1][0]
    wanted = replace(full, layers=(1, 2), denoise_steps=(9,), heads=(3,), contributions=False)
    smaller = smaller_record(record, full, wanted, attributes.sites).rows["joint"]
    given = record.rows["joint"]
    np.testing.assert_array_equal(smaller.rows, given.rows[1:, 2:, 3:])
    np.testing.assert_array_equal(smaller.row_sum, given.row_sum[1:, 2:, 3:])
    assert smaller.contribution is None


def test_one_replan_says_nothing():
    with pytest.raises(ValueError, match="a sample of 1 replans"):
        sample_of(SPEC, 1).size(root_attributes(SPEC).recording)
