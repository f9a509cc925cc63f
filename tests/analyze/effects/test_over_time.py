"""Recorded effects replan by replan and over time, against loops over the raw arrays."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest
import zarr

from tests.kit.planted_effects import FIRST, planted_effects
from vla_attention.analyze.__main__ import main
from vla_attention.analyze.effects.effect_study import study_effects
from vla_attention.analyze.effects.over_time import NOISE, early_and_late, effects_by_replan, effects_over_time
from vla_attention.analyze.effects.plot_effects_over_time import plot_effects_over_time
from vla_attention.analyze.measures.question_settings import AnalysisSettings
from vla_attention.analyze.show.numbers import format_number
from vla_attention.testing.stores import StoreSpec, write_store

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


def test_noise_pictures_text_and_words_stand_beside_each_other(study):
    course = effects_over_time(study, 5)
    assert course["item"].unique(maintain_order=True).to_list()[:3] == ["visual", "linguistic", f"'{FIRST}'"]
    noise = course.filter(item=NOISE)["effect"]
    assert noise.max() == pytest.approx(noise.min(), rel=1e-6)


def test_the_sentence_has_the_first_and_the_last_third(study):
    rows = study.summary.filter(scope="all", condition=f"without_word_{FIRST}_queries_all")
    first, last = (rows.filter(phase=f"{name} third")["effect"].item() for name in ("first", "last"))
    assert f"'{FIRST}' {format_number(first)} and {format_number(last)}" in early_and_late(study)
    assert first > 1.5 * last


def test_time_shows_effects_beside_attention_and_writes_them(store, tmp_path, capsys):
    assert main(["time", str(store), "--bins", "4", "--output", str(tmp_path), "--intervals", "these-tasks"]) == 0
    printed = capsys.readouterr().out
    assert printed.index("OVER THE EPISODE'S TIME, 0 to 1") < printed.index("EFFECTS OVER THE EPISODE'S TIME")
    written = pl.read_parquet(tmp_path / "effects_over_time.parquet")
    study = study_effects(store, [], AnalysisSettings(intervals="these-tasks"))
    assert written["effect"].to_list() == effects_over_time(study, 4)["effect"].to_list()


def test_a_store_without_effects_has_no_such_section(tmp_path, capsys):
    plain = write_store(tmp_path / "plain.zarr", tasks=(0,), episodes=1)
    assert main(["time", str(plain), "--output", str(tmp_path / "out"), "--no-plots"]) == 0
    assert "EFFECTS" not in capsys.readouterr().out
    assert not (tmp_path / "out/effects_over_time.parquet").exists()


@pytest.mark.drawn
def test_the_picture_holds_every_item(study, tmp_path):
    from vla_attention.analyze.effects.over_time import EffectsOverTime

    course = effects_over_time(study, 4)
    files = plot_effects_over_time(EffectsOverTime(study, course), tmp_path)
    assert {file.suffix for file in files} >= {".png", ".csv"}
    assert pl.read_csv(tmp_path / "effects_over_time.csv").height == course.height
