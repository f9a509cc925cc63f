"""The estimate printed before a run is never less than what the run then takes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.kit.stores import (
    StoreSpec,
    root_attributes,
    write_store,
)
from tests.kit.tokens import OBJECTS, small_prompt
from vla_attention.capture.store.disk_estimate import (
    estimate_disk,
    format_bytes,
)
from vla_attention.schemas.groupings.vocabulary import EpisodeTokens
from vla_attention.schemas.layout import PatchGrid, SiteLayout, Span


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


@pytest.mark.parametrize("bits", [1, 10, 23])
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


@pytest.mark.parametrize(("queries", "frames", "replans"), [("all", False, 2), ("mean", False, 9)])
def test_small_stores_stay_below_the_estimate(tmp_path, queries, frames, replans):
    spec = StoreSpec(queries=queries, frames=frames, replans=replans, tasks=(0,))
    path = write_store(tmp_path / "a.zarr", spec=spec)
    pictures = [12 * 16 * 3, 8 * 8 * 3]
    estimate = estimate_disk(root_attributes(spec).recording, (spec.layout,), pictures, replans, 2)
    assert size_of(path / "episodes") <= estimate.total_bytes


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


@pytest.mark.parametrize(
    ("count", "text"),
    [(999, "999 B"), (1234, "1.23 kB"), (12_340_000, "12.3 MB")],
)
def test_format_bytes(count, text):
    assert format_bytes(count) == text
