"""Recorded effects with planted sizes: means by hand, who reads an item, and floors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import polars as pl
import pytest

from tests.kit.planted_effects import FIRST, ITEMS, RANDOM, READERS, WORDS, planted_effects
from tests.kit.stores import StoreSpec, write_store
from tests.kit.tokens import INSTRUCTIONS
from vla_attention.analyze.effects.answer import mostly_one_dimension, word_lines
from vla_attention.analyze.effects.effect_study import study_effects
from vla_attention.analyze.effects.item_rows import item_rows, ratio_of_effects, ratios_by_family
from vla_attention.analyze.effects.over_time import shares_of_dimensions
from vla_attention.analyze.measures.question_settings import AnalysisSettings
from vla_attention.analyze.show.findings import findings
from vla_attention.analyze.show.numbers import format_number


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    spec = StoreSpec(tasks=(0, 1, 2), episodes=4, replans=4, plant_effects=planted_effects())
    return write_store(tmp_path_factory.mktemp("items") / "a.zarr", spec=spec)


@pytest.fixture(scope="module")
def study(store):
    return study_effects(store, [], AnalysisSettings(intervals="these-tasks"))


def test_the_effect_is_the_planted_size_in_units_of_the_spread(study):
    spread = study.spread
    assert spread.used.all()
    for name, (_, sizes) in ITEMS.items():
        (row,) = [row for row in item_rows(study) if row.by_reader["total"]["group"] == name]
        for reader, size in sizes.items():
            expected = np.sqrt(np.mean((3.0 * size / spread.spread) ** 2))
            assert row.effect(reader) == pytest.approx(expected, rel=1e-6), (name, reader)
        assert row.direct_share == pytest.approx(sizes["direct"] / sizes["total"], rel=1e-6)


@pytest.mark.parametrize(
    ("factor", "said"), [(0.01, ""), (18.2, "as much,"), (40.0, "more, by"), (14000.0, "more, by")]
)
def test_how_much_another_noise_seed_changes_is_said_with_its_size(tmp_path, factor, said):
    plant = planted_effects(lambda name, *_: factor if name == "noise" else 1.0)
    spec = StoreSpec(tasks=(0, 1), episodes=2, replans=3, plant_effects=plant)
    study = study_effects(write_store(tmp_path / "a.zarr", spec=spec), [], AnalysisSettings(intervals="these-tasks"))
    (row,) = study.summary.filter(scope="all", phase="all", condition="noise").to_dicts()
    line = word_lines(study, item_rows(study))[0]
    sentence = f"Another noise seed changes it {said} {format_number(row['effect'])}."
    assert (sentence in line) if said else ("Another noise seed" not in line)


def test_items_are_in_the_order_of_their_total_effects(study):
    names = [row.name for row in item_rows(study)]
    assert names[:3] == ["visual", "linguistic", f"'{WORDS[0]}'"]
    assert {row.kind for row in item_rows(study)} == {"role", "", "word"}


def test_words_count_in_the_episodes_that_have_them(study):
    rows = study.summary.filter(scope="all", phase="all")
    for word in WORDS:
        having = sum(word in text.split() for text in INSTRUCTIONS)
        (row,) = rows.filter(condition=f"without_word_{word}_queries_all").to_dicts()
        assert row["num_episodes"] == 4 * having


def test_the_ratio_of_effects_is_that_of_the_sides(study):
    ratio = ratio_of_effects(study)
    assert ratio["ratio"] == pytest.approx(2.0, rel=1e-6)
    assert ratio["num_episodes"] == 12


def test_each_word_has_the_random_keys_of_the_nearest_number_of_its_reader(study):
    rows = study.summary.filter(scope="all", phase="all", kind="without")
    floor = np.sqrt(np.mean((3.0 * RANDOM / study.spread.spread) ** 2))
    words = rows.filter(pl.col("condition").str.starts_with(f"without_word_{FIRST}"))
    assert words.height == len(READERS)
    assert words["random"].to_list() == pytest.approx([floor] * len(READERS), rel=1e-6)
    # A few random keys are no floor for a picture.
    assert rows.filter(pl.col("group") == "visual")["random"].to_list() == [None] * len(READERS)


def test_each_family_has_its_ratio_of_effects(tmp_path):
    factors = {0: 1.0, 1: 3.0, 2: 0.5}

    def scale(name, task, episode, replan):
        return factors[task] if "visual" in name else 1.0

    families = {0: "one", 1: "two", 2: "two"}
    spec = StoreSpec(tasks=(0, 1, 2), episodes=2, task_families=families, plant_effects=planted_effects(scale))
    path = write_store(tmp_path / "families.zarr", spec=spec)
    study = study_effects(path, [], AnalysisSettings(intervals="these-tasks"))
    rows = {row["family"]: row for row in ratios_by_family(study)}
    planted = ITEMS["visual"][1]["total"] / ITEMS["linguistic"][1]["total"]
    assert rows["one"]["ratio"] == pytest.approx(planted, rel=1e-6)
    assert rows["two"]["ratio"] == pytest.approx(planted * (3.0 + 0.5) / 2, rel=1e-6)
    assert (rows["one"]["num_tasks"], rows["two"]["num_tasks"]) == (1, 2)
    cells = study.analysis.episodes.cells.filter(layer="layers_avg")
    of_two = [cells.filter(task_id=task)["log_ratio_mean"].mean() for task in (1, 2)]
    assert rows["two"]["attention"] == pytest.approx(np.exp(np.mean(of_two)), rel=1e-9)


def in_one_dimension(task, episode, replan, tokens):
    """The effects of the first word are all in the gripper's dimension; those of others in every dimension."""
    given = planted_effects()(task, episode, replan, tokens)
    change = given.change.copy()
    for row, number in zip(change, given.measured, strict=True):
        if given.conditions[number].name.startswith(f"without_word_{FIRST}"):
            row[:, :-1] = 0.0
    return replace(given, change=change)


def test_an_effect_in_one_dimension_is_said_with_what_the_movement_does(tmp_path):
    path = write_store(tmp_path / "one.zarr", tasks=(0,), episodes=3, replans=3, plant_effects=in_one_dimension)
    study = study_effects(path, [], AnalysisSettings(intervals="these-tasks"))
    items = [item for item in item_rows(study) if item.name == f"'{FIRST}'"]
    np.testing.assert_allclose(shares_of_dimensions(study, items[0].strongest["condition"]), [0] * 6 + [1], atol=1e-9)
    said = mostly_one_dimension(study, items[0])
    assert "100% is dimension 6" in said
    assert "--dimensions 0 1 2 3 4 5" in said
    (other,) = [item for item in item_rows(study) if item.name == "visual"]
    squares = (1 / study.spread.spread) ** 2
    np.testing.assert_allclose(
        shares_of_dimensions(study, other.strongest["condition"]), squares / squares.sum(), rtol=1e-6
    )
    assert mostly_one_dimension(study, other) == ""


def test_items_that_cannot_be_tested_are_counted():
    said = findings([0.01, None, 0.2], ["a", "b", "c"], "item", "an effect")
    assert said == "Of the 2 of 3 items that can be tested, 1 shows an effect (q <= 0.05): a."
    assert findings([None], ["a"], "item", "an effect") == "None of 1 item can be tested."
