"""Heads of random stores and groupings against the raw rows; which heads are ranked, and which are left out."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.kit.made_up_steps import flat
from tests.kit.questions import question_about
from tests.kit.raw_rows import FEW, leaky, raw_episodes, weights_of
from vla_attention.analyze.heads.head_measures import ranked_heads
from vla_attention.analyze.heads.head_study import HeadStudy, study_heads
from vla_attention.analyze.heads.row_metrics import RowOptions
from vla_attention.schemas.groupings.grouping import Grouping, Ratio
from vla_attention.testing.stores import StoreSpec, every_key_seen, write_store
from vla_attention.testing.strategies import episode_tokens, groupings
from vla_attention.testing.tokens import small_layout

LAYOUT = small_layout()
BOS = LAYOUT.span("prompt").start
SIDES = Grouping(
    "sides",
    {"seen": ("role:image",), "read": ("span:prompt",), "rest": ("*",)},
    Ratio(("seen",), ("read",)),
    allow_empty=("rest",),
)


def finite(values: list[float]) -> float | None:
    kept = [value for value in values if np.isfinite(value)]
    return float(np.mean(kept)) if kept else None


def close(found: float | None, expected: float | None, **tolerance: float) -> bool:
    return found is None if expected is None else found == pytest.approx(expected, **tolerance)


@FEW
@given(data=st.data())
def test_numbers_of_heads_equal_loops_over_raw_rows(data):
    tokens = data.draw(episode_tokens())
    grouping = data.draw(groupings(tokens))
    names = list(grouping.names)
    top = data.draw(st.lists(st.sampled_from(names), min_size=1, max_size=2, unique=True))
    left = [name for name in names if name not in top]
    ratio = Ratio(tuple(top), (data.draw(st.sampled_from(left)),)) if left and data.draw(st.booleans()) else None
    grouping = Grouping("random", grouping.groups, ratio, allow_empty=grouping.allow_empty)
    spec = StoreSpec(
        tokens=tokens,
        plant_rows=leaky,
        plant_uniform=every_key_seen,
        tasks=(0, 1),
        episodes=1,
        layer_labels=(0, 2, 4),
        heads=(0, 1, 3),
        queries=data.draw(st.sampled_from(["mean", "all"])),
        mantissa_bits=23,
    )
    with tempfile.TemporaryDirectory() as folder:
        path = write_store(Path(folder) / "a.zarr", spec=spec)
        question = question_about(path, grouping, heads=(3, 0))
        study = study_heads(question, RowOptions() if data.draw(st.booleans()) else None)
        raws = raw_episodes(path, spec)
    weights = weights_of(grouping, tokens)
    keys = weights.sum(axis=1)
    assert study.heads.cells.select("layer", "block", "head").rows() == [
        (label, label % 4, head) for label in (0, 2, 4) for head in (3, 0)
    ]
    shares: dict[tuple[int, int], list[list[float]]] = {}
    for row in flat(study.heads).iter_rows(named=True):
        layer, head = (0, 2, 4).index(row["layer"]), spec.heads.index(row["head"])
        per_episode: dict[str, list[float | None]] = {}
        above, below, left_out = [], [], 0
        for raw in raws:
            mass = np.stack(
                [
                    [
                        (raw.rows[replan, layer, :, head] * weights[replan, :, i]).sum(axis=-1).mean()
                        for i in range(len(names))
                    ]
                    for replan in range(tokens.num_replans)
                ]
            )
            even = [raw.held()[0][r, layer, :, head].sum(axis=-1).mean() / raw.valid[r].sum() for r in range(len(mass))]
            of: dict[str, list[float]] = {}
            for replan, own in enumerate(mass):
                for i, name in enumerate(names):
                    of.setdefault(f"{name}_fraction", []).append(own[i] / own.sum())
                    count = keys[replan, i]
                    of.setdefault(f"{name}_lift", []).append(own[i] / count / even[replan] if count > 0 else np.nan)
                if ratio is not None:
                    up = sum(own[names.index(name)] for name in ratio.numerator)
                    down = sum(own[names.index(name)] for name in ratio.denominator)
                    more = sum(keys[replan, names.index(name)] for name in ratio.numerator)
                    fewer = sum(keys[replan, names.index(name)] for name in ratio.denominator)
                    of.setdefault("numerator_fraction", []).append(up / own.sum())
                    of.setdefault("denominator_fraction", []).append(down / own.sum())
                    log2 = np.log2(up / down) if up > 0 and down > 0 else np.nan
                    left_out += not np.isfinite(log2)
                    of.setdefault("log2_ratio", []).append(log2)
                    of.setdefault("log2_lift", []).append(
                        log2 - np.log2(more / fewer) if more > 0 and fewer > 0 else np.nan
                    )
                    above.append(up)
                    below.append(down)
            for column, values in of.items():
                per_episode.setdefault(column, []).append(finite(values))
        for column, means in per_episode.items():
            expected = finite([np.nan if mean is None else mean for mean in means])
            assert close(row[column], expected, rel=2e-4, abs=2e-5), (column, row[column], expected)
        if ratio is not None:
            assert row["num_nonfinite"] == left_out
            if sum(below) > 0:
                assert row["ratio_of_means"] == pytest.approx(np.mean(above) / np.mean(below), rel=1e-4)
            else:
                assert row["ratio_of_means"] in ((None,) if sum(above) == 0 else (np.inf,))
            shares.setdefault((row["layer"], 0), []).append(per_episode["numerator_fraction"])  # type: ignore[arg-type]
    if ratio is not None:
        for row in study.dispersion.iter_rows(named=True):
            of_heads = np.array(shares[row["layer"], 0], dtype=float)  # (head, episode)
            assert row["num_heads"] == 2
            assert row["fraction_std"] == pytest.approx(np.mean(np.std(of_heads, axis=0)), abs=1e-5)


def planted(where: dict[tuple[int, int], tuple[slice, float]]):
    """Rows even over the valid keys; some (layer position, head) give the keys of a slice so many times as much."""

    def plant(task, episode, tokens, rows):
        even = np.broadcast_to(tokens.valid[:, None, None, None, None], rows.shape).astype(float)
        even *= np.exp(np.random.default_rng([task, episode]).normal(0, 0.02, rows.shape))
        for (layer, head), (keys, times) in where.items():
            even[:, layer, :, head, :, keys] *= times
        return even / even.sum(axis=-1, keepdims=True)

    return plant


def study_of(tmp_path: Path, grouping: Grouping | None = None, **spec) -> HeadStudy:
    return study_heads(question_about(write_store(tmp_path / "a.zarr", spec=StoreSpec(**spec)), grouping))


def test_planted_specialists_are_at_the_two_ends(tmp_path):
    plant = planted({(1, 2): (slice(0, 16), 40.0), (2, 0): (slice(BOS, BOS + 14), 40.0), (0, 1): (slice(0, 16), 3.0)})
    study = study_of(tmp_path, layers=(0, 1, 3), heads=(0, 1, 2), plant_rows=plant, episodes=3)
    order = ranked_heads(study.heads, study.question.grouping).select("block", "head").rows()
    assert order[:2] == [(1, 2), (0, 1)]
    assert order[-1] == (3, 0)
    assert len(order) == 9
    widest = study.dispersion.sort("log2_ratio_std", descending=True)["block"].to_list()
    assert set(widest[:2]) == {1, 3}


def test_heads_without_a_finite_ratio_are_ranked_at_the_ends_and_heads_without_mass_are_left_out(tmp_path):
    def plant(task, episode, tokens, rows):
        rows = planted({})(task, episode, tokens, rows)
        rows[:, 0, :, 0, :, BOS : BOS + 14] = 0.0  # only sees
        rows[:, 0, :, 1, :, :16] = 0.0  # only reads
        rows[:, 1, :, 0, :, : BOS + 14] = 0.0  # neither
        return rows / rows.sum(axis=-1, keepdims=True)

    study = study_of(tmp_path, SIDES, plant_rows=plant)
    ranked = ranked_heads(study.heads, SIDES)
    assert ranked.select("block", "head").rows() == [(0, 0), (2, 1), (0, 1)]
    sees, reads, nothing = (
        study.heads.cells.filter(block=b, head=h).row(0, named=True) for b, h in ((0, 0), (0, 1), (2, 0))
    )
    assert sees["log2_ratio"] is None
    assert sees["ratio_of_means"] == np.inf
    assert reads["ratio_of_means"] == 0.0
    assert nothing["ratio_of_means"] is None
    assert sees["num_nonfinite"] == reads["num_nonfinite"] == 2 * 2 * 3


def test_intervals_of_heads_hold_what_was_planted_and_not_the_uniform_value(tmp_path):
    plant = planted({(0, 0): (slice(0, 16), 8.0)})
    study = study_of(tmp_path, tasks=(0, 1, 2), episodes=3, plant_rows=plant, replans=2)
    row = study.heads.cells.filter(block=0, head=0).row(0, named=True)
    assert row["log2_lift_low"] < 3.0 < row["log2_lift_high"]
    assert row["log2_lift_low"] > 2.5
    assert row["num_tasks"] == 3
    assert row["num_episodes"] == 9
    assert study.heads.cells.filter(pl.col("log2_lift_episodes") != 9).is_empty()
