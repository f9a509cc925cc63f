"""Uniform attention has lift 1 wherever a query sees a key, whatever else each query, layer, head and replan sees."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from hypothesis import given
from hypothesis import strategies as st

import vla_attention as va
from tests.kit.questions import question_about
from tests.kit.raw_rows import FEW
from tests.kit.stores import StoreSpec, write_store
from tests.kit.strategies import episode_tokens
from tests.kit.uniform_cases import TABLE, tokens_of_case, write_case
from vla_attention.analyze.core.camera_maps import camera_names, episode_maps
from vla_attention.analyze.core.levels import levels_of
from vla_attention.analyze.core.sinks import SinkRule, search_sinks
from vla_attention.analyze.measures.masses import uniform_keys
from vla_attention.schemas.groupings.vocabulary import EpisodeTokens

#: Stored in float32.
CLOSE = 2e-6
#: The axis of a case's selection -> the analysis's setting.
SETTINGS = {"layer": "layers", "denoise": "denoise", "head": "heads"}
STORED = pytest.mark.parametrize("case", TABLE["stored"], ids=lambda case: case["name"])


@STORED
@pytest.mark.parametrize("uniform", [True, False], ids=["uniform rows", "other rows"])
def test_means_and_lifts_are_those_of_the_table(tmp_path, case, uniform):
    weights = [1.0] * 8 if uniform else case["weights"]
    run = va.open(write_case(tmp_path / "a.zarr", case, weights))
    for expected in case["expected"]:
        if "query" in expected["of"]:
            continue  # an analysis is of the mean over queries
        asked = {SETTINGS[axis]: number for axis, number in expected["of"].items()}
        question = run.ask(**asked)
        found = uniform_keys(question.selected[0], question.selection).mean(axis=(1, 2, 3))
        wanted = np.array(expected["uniform"])
        np.testing.assert_allclose(np.broadcast_to(found, wanted.shape), wanted, rtol=CLOSE, atol=1e-9)
        masses = levels_of(question).groups("replan").collect()
        for replan, lifts in enumerate(expected["lifts"]):
            shown = masses.filter(replan=replan)
            for group, lift in lifts.items():
                (value,) = shown.filter(group=group)["lift"].to_list()
                if lift is None:
                    assert value is None or np.isnan(value), group
                else:
                    assert value == pytest.approx(1.0 if uniform else lift, rel=CLOSE), group


def masks(draw: st.DrawFn, tokens: EpisodeTokens, lengths: tuple[int, ...]) -> np.ndarray:
    """Who sees what, (replan, layer, denoise, head, query, key); axes along which nothing changes have length 1.

    Keys that hold nothing may be seen, as Cosmos's null keys are; some keys may be seen by nobody.
    """
    shape = [length if draw(st.booleans()) else 1 for length in lengths]
    generator = np.random.default_rng(draw(st.integers(0, 2**16)))
    seen = generator.random((*shape, tokens.layout.num_keys)) < draw(st.sampled_from([0.3, 0.8]))
    seen[..., generator.random(tokens.layout.num_keys) < 0.2] = False
    # Every query sees a key that holds something, and the ratio of every replan is known.
    action, image, bos = (tokens.layout.span("actions").start, 0, tokens.layout.span("prompt").start)
    seen[..., [action, image, bos]] = True
    return seen


@FEW
@given(data=st.data())
def test_uniform_attention_has_lift_1_everywhere(data):
    tokens = data.draw(episode_tokens())
    spec = StoreSpec(tokens=tokens, tasks=(0,), episodes=1, queries=data.draw(st.sampled_from(["mean", "all"])))
    lengths = (tokens.num_replans, len(spec.layers), len(spec.denoise_steps), len(spec.heads), 3)
    seen = masks(data.draw, tokens, lengths)
    uniform = seen / seen.sum(axis=-1, keepdims=True)
    if spec.queries == "mean":
        uniform = uniform.mean(axis=4, keepdims=True)
    spec = replace(
        spec,
        mantissa_bits=23,
        plant_uniform=lambda _tokens, _cells: uniform,
        plant_rows=lambda _task, _episode, _tokens, rows: np.broadcast_to(uniform, rows.shape),
    )
    with tempfile.TemporaryDirectory() as folder:
        path = write_store(Path(folder) / "a.zarr", spec=spec)
        run = va.open(path)
        for per_head in (False, True):
            answer = run.analyze(per_head=per_head)
            for level in ("steps", "replans", "episodes", "tasks"):
                all_one(answer[f"{level}_groups"], "lift")
                ratios = answer[level]
                all_one(ratios, "ratio_lift")
                assert ratios["ratio_lift"].is_finite().all()
        words = run.words()["words_episodes"]
        all_one(words, "lift")
        cells = run.analyze(by=("layer", "head"))
        all_one(cells["by_groups"], "lift")
        np.testing.assert_allclose(cells["by"]["ratio_lift"].to_numpy(), 1.0, atol=1e-5)
        search = search_sinks(question_about(path), SinkRule(factor=1.0))
        assert search.sinks.is_empty()
        # Others take nothing at some replans, which their mean counts.
        always = np.flatnonzero(tokens.valid.all(axis=0)).tolist()
        all_one(search.keys.filter(pl.col("key").is_in(always)), "times_uniform")
        question = question_about(path)
        maps = episode_maps(question, question.selected[0], camera_names(question)).cameras.values()
        lifts = np.concatenate([one.lift.ravel() for one in maps])
        np.testing.assert_allclose(lifts[~np.isnan(lifts)], 1.0, rtol=CLOSE)
        # What nobody sees has none.
        means = uniform.mean(axis=(1, 2, 3, 4))
        seen_at = [picture.spread(means[:, picture.keys]) for picture in (one.picture for one in maps)]
        image = np.concatenate([cells.ravel() for cells in seen_at])
        assert np.isnan(lifts).sum() == (image == 0).sum() * (len(lifts) // len(image))


def all_one(table: pl.DataFrame, column: str) -> None:
    """Every value that there is is 1, and there are some."""
    values = table[column].drop_nulls().drop_nans().to_numpy()
    assert len(values)
    np.testing.assert_allclose(values, 1.0, rtol=CLOSE)


def test_a_group_that_no_query_sees_has_no_lift(tmp_path):
    (case,) = [case for case in TABLE["stored"] if case["name"] == "no query sees the pictures"]
    run = va.open(write_case(tmp_path / "a.zarr", case, case["weights"]))
    visual = run.analyze()["steps_groups"].filter(group="visual")
    assert set(visual["mass"]) == {0.0}
    assert visual["keys"].to_list() == [2.0] * visual.height
    assert visual["lift"].is_null().all() or visual["lift"].is_nan().all()
    assert tokens_of_case(case).valid[0, :2].all()


def test_layers_without_a_finite_ratio_are_in_neither_mean(tmp_path):
    """Where a layer sees no word, its ratio is infinite and left out; its uniform ratio must be, too."""
    (case,) = [case for case in TABLE["stored"] if case["name"] == "layers see pictures or words"]
    pictures, all_keys = [[["11000111"]]], [[["11110111"]]]
    for name, layers, expected in (
        ("one", [all_keys, pictures], [1.0, np.inf, 1.0]),
        ("none", [pictures], [np.inf] * 3),
    ):
        run = va.open(write_case(tmp_path / f"{name}.zarr", case | {"seen": [layers]}, [1.0] * 8))
        ratios = run.analyze()["replans"]
        assert ratios["layer"].to_list() == ["0", "1", "layers_avg"]
        assert ratios["uniform_ratio"].to_list() == pytest.approx(expected, rel=CLOSE), name
        if name == "one":
            assert ratios["ratio_lift"][2] == pytest.approx(1.0, rel=CLOSE)
