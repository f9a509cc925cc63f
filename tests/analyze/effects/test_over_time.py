"""Recorded effects replan by replan and over time, against loops over the raw arrays."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest
import zarr

from tests.kit.planted_effects import FIRST, planted_effects
from tests.kit.stores import StoreSpec, write_store
from vla_attention.analyze.effects.effect_study import study_effects
from vla_attention.analyze.effects.over_time import effects_by_replan, effects_over_time
from vla_attention.analyze.measures.question_settings import AnalysisSettings

REPLANS = 4


def earlier(name: str, task: int, episode: int, replan: int) -> float:
    """Planted: words matter at the first replans, everything else always as much."""
    return 1.0 - 0.2 * replan if "word_" in name else 1.0


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    spec = StoreSpec(tasks=(0, 1, 2), episodes=2, replans=REPLANS, plant_effects=planted_effects(earlier))
    return write_store(tmp_path_factory.mktemp("over_time") / "a.zarr", spec=spec)


@pytest.fixture(scope="module")
def study(store):
    return study_effects(store, [], AnalysisSettings(intervals="these-tasks"))


def raw_effects(store, spread):
    """(episode, replan, condition's name) -> the effect, with loops over the raw arrays."""
    values = {}
    for name, group in zarr.open_group(store, mode="r")["episodes"].groups():
        effects = group.attrs["effects"]
        executed = [5] * (REPLANS - 1) + [group.attrs["num_steps"] - 5 * (REPLANS - 1)]
        for entry, (replan, condition) in enumerate(zip(effects["replan"], effects["condition"], strict=True)):
            change = group["effects/change"][entry] * np.array(effects["units"]) / spread
            named = effects["conditions"][condition]["name"]
            values[name, replan, named] = np.sqrt((change[: executed[replan]] ** 2).mean())
    return values


def test_every_measured_replan_has_the_effect_of_the_raw_arrays(store, study):
    table, raw = effects_by_replan(study), raw_effects(store, study.spread.spread)
    measured = {key: value for key, value in raw.items() if key[2] != "unchanged"}
    assert table.height == len(measured)
    for row in table.iter_rows(named=True):
        episode = f"task{row['task_id']:03d}_episode{row['episode_index']:03d}"
        assert row["effect"] == pytest.approx(measured[episode, row["replan"], row["condition"]], rel=1e-6)
    readers = table.filter(condition="without_visual_queries_all")["reader"].unique().to_list()
    assert readers == ["total"]
    assert table.filter(kind="noise")["reader"].null_count() == REPLANS * 6


def test_the_course_is_the_mean_of_each_part_of_the_time(study):
    by_replan = effects_by_replan(study).filter(condition=f"without_word_{FIRST}_queries_all")
    course = effects_over_time(study, REPLANS).filter(item=f"'{FIRST}'")
    # The last replan lasts shorter in odd episodes, so that a quarter of the time is not one replan there.
    even = by_replan.filter(pl.col("episode_index") == 0)
    assert len(course) == REPLANS
    assert course["num_episodes"].to_list() == [by_replan["task_id"].n_unique() * 2] * 4
    for number, value in enumerate(course["effect"]):
        of_replan = even.filter(replan=number)["effect"].mean()
        assert value == pytest.approx(of_replan, rel=0.1)
    assert course["effect"].is_sorted(descending=True)
    assert course["effect"][0] == pytest.approx(by_replan.filter(replan=0)["effect"].mean(), rel=1e-9)
