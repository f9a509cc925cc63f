"""The estimate printed before a run is never less than what the run then takes."""

from __future__ import annotations

import dataclasses
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from vla_attention.capture.store.codecs import TARGET_CHUNK_BYTES
from vla_attention.capture.store.disk_estimate import (
    EPISODE_OVERHEAD,
    ArraySize,
    DiskEstimate,
    SampleOfReplans,
    bytes_per_number,
    describe,
    estimate_disk,
    format_bytes,
    smaller_record,
)
from vla_attention.schemas.groupings.vocabulary import EpisodeTokens
from vla_attention.schemas.layout import PatchGrid, SiteLayout, Span
from vla_attention.testing.stores import (
    StoreSpec,
    denoise_times,
    episode_records,
    root_attributes,
    small_steps,
    write_store,
)
from vla_attention.testing.tokens import OBJECTS, small_prompt


def large_tokens(replans: int, pixels: int = 56) -> EpisodeTokens:
    """800 keys, none of them masked; every replan with a prompt of its own."""
    grid = PatchGrid(17, 20, pixels, pixels)
    layout = SiteLayout(
        "joint",
        (
            Span("base", "image", 0, 340, camera="base", grid=grid),
            Span("wrist", "image", 340, 680, camera="wrist", grid=grid),
            Span("prompt", "text", 680, 750),
            Span("actions", "action", 750, 800),
        ),
    )
    roles = np.full((replans, 800), 1, dtype=np.uint8)
    roles[:, 750:] = 8
    prompts = []
    for replan in range(replans):
        digits = " ".join(str(1000 * replan + i) for i in range(60))
        prompt, roles[replan, 680:750] = small_prompt(layout, "put the bowl on the plate", digits)
        prompts.append(prompt)
    edges = np.zeros((replans, 340, 5), dtype=np.float32)
    edges[:, np.arange(340), np.arange(340) // 70] = 1
    return EpisodeTokens(layout, roles, tuple(prompts), np.arange(replans), OBJECTS, {"base": edges, "wrist": edges})


def size_of(path: Path) -> int:
    return sum(file.stat().st_size for file in path.rglob("*") if file.is_file())


@pytest.mark.parametrize("bits", [1, 4, 7, 10, 16, 23])
def test_a_store_of_random_rows_and_pictures_stays_below_the_estimate(tmp_path, bits):
    """Softmaxed normal logits of a standard deviation of 3, and noise for pictures: nothing that a codec could find."""
    tokens = large_tokens(12)
    layers, heads = tuple(range(8)), tuple(range(8))
    spec = StoreSpec(
        tokens=tokens, mantissa_bits=bits, tasks=(0,), episodes=1, layers=layers, num_layers=8, heads=heads
    )
    size = size_of(write_store(tmp_path / "a.zarr", spec=spec) / "episodes")
    recording = root_attributes(spec).recording
    pictures = [span.grid.image_height * span.grid.image_width * 3 for span in tokens.layout.spans if span.grid]
    estimate = estimate_disk(recording, (tokens.layout,), pictures, 12, 1)
    assert size <= estimate.total_bytes
    assert size >= 0.5 * estimate.total_bytes, "the estimate has become useless"


@pytest.mark.parametrize(("queries", "frames", "replans"), [("mean", True, 1), ("all", False, 2), ("mean", False, 9)])
def test_small_stores_stay_below_the_estimate(tmp_path, queries, frames, replans):
    spec = StoreSpec(queries=queries, frames=frames, replans=replans, tasks=(0,))
    path = write_store(tmp_path / "a.zarr", spec=spec)
    pictures = [12 * 16 * 3, 8 * 8 * 3]
    estimate = estimate_disk(root_attributes(spec).recording, (spec.layout,), pictures, replans, 2)
    assert size_of(path / "episodes") <= estimate.total_bytes


def test_bytes_per_number_are_above_what_was_measured():
    measured = {4: 1.0, 7: 1.43, 10: 1.79, 12: 2.04, 23: 3.40}  # rows of a trained transformer
    for bits, size in measured.items():
        assert size < bytes_per_number(bits) < 1.5 * size
    sizes = [bytes_per_number(bits) for bits in range(1, 24)]
    assert sizes == sorted(sizes)
    assert bytes_per_number(23) < 4


def test_what_is_asked_for_is_what_is_counted():
    spec = StoreSpec(tokens=large_tokens(1), heads=tuple(range(8)))
    layout = spec.layout

    def size(pictures: list[int], **changes: object) -> int:
        recording = root_attributes(StoreSpec(tokens=spec.tokens, **changes)).recording  # type: ignore[arg-type]
        return estimate_disk(recording, (layout,), pictures, 1, 1).bytes_per_replan

    heads = {"heads": tuple(range(8))}
    assert size([10_000], frames=False, **heads) == size([], **heads)
    assert 10_000 <= size([10_000], **heads) - size([], **heads) <= 10_200
    one, two = size([], layers=(0,), **heads), size([], layers=(0, 1), **heads)
    assert size([], layers=(0, 1, 2), **heads) - two == pytest.approx(two - one, abs=2)
    assert size([], queries="all", num_action_queries=10, **heads) > 9 * (two - one)


def test_episodes_and_replans_multiply():
    estimate = DiskEstimate(bytes_per_replan=1000, max_replans=10, num_episodes=3)
    assert estimate.total_bytes == 3 * (10_000 + EPISODE_OVERHEAD)
    assert DiskEstimate(1000, 10, 0).total_bytes == 0


@pytest.mark.parametrize(
    ("count", "text"),
    [
        (0, "0 B"),
        (1, "1 B"),
        (999, "999 B"),
        (1000, "1 kB"),
        (1234, "1.23 kB"),
        (999_400, "999 kB"),
        (999_900, "1 MB"),
        (12_340_000, "12.3 MB"),
        (13.2e9, "13.2 GB"),
        (4.56e12, "4.56 TB"),
    ],
)
def test_format_bytes(count, text):
    assert format_bytes(count) == text


def test_the_line_before_a_run(tmp_path, monkeypatch):
    estimate = DiskEstimate(1_000_000, 50, 20)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=2e9))
    line = describe(estimate, tmp_path / "not" / "yet" / "a.zarr")
    assert line == "Disk: at most 1.01 GB (20 episodes x up to 50 replans x 1 MB); mostly 201 MB to 503 MB; 2 GB free."
    exact = describe(dataclasses.replace(estimate, measured=True), tmp_path / "a.zarr")
    assert exact == "Disk: at most 1.01 GB (20 episodes x up to 50 replans x 1 MB, measured, + 300 kB each); 2 GB free."
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=5e8))
    assert "500 MB free. WARNING: that is more than the disk has room for" in describe(estimate, tmp_path)


def test_a_relative_path_that_does_not_exist(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert "free" in describe(DiskEstimate(1, 1, 1), Path("runs/a.zarr"))


SPEC = StoreSpec(
    tokens=large_tokens(40),
    tasks=(0,),
    episodes=1,
    layers=(0, 1, 2),
    num_layers=3,
    heads=(0, 1, 2, 3),
    denoise_steps=(0, 4, 9),
    contributions=True,
    plant_steps=small_steps,
)


def sample_of(spec: StoreSpec, replans: int) -> SampleOfReplans:
    start, records = episode_records(spec, 0, 0)
    steps = small_steps(spec, 0, 0, 5 * replans)
    return SampleOfReplans(root_attributes(spec), start, denoise_times(spec), records[:replans], steps)


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
