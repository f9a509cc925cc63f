"""Families of tasks from store to printed interval: which there are, what is said of them, and where none is known."""

from __future__ import annotations

import re

import numpy as np
import polars as pl
import pytest
from scipy import stats

import vla_attention as va
from tests.kit.stores import write_store
from vla_attention.analyze.__main__ import main
from vla_attention.analyze.measures.question import ask
from vla_attention.analyze.measures.question_settings import AnalysisSettings
from vla_attention.analyze.measures.task_families import (
    alike_instructions,
)
from vla_attention.schemas.stores.reader import open_store

#: Seven tasks in four families.
FAMILIES = {0: "put A on B", 1: "put A on B", 2: "open A", 3: "open A", 4: "turn on A", 5: "push A", 6: "put A on B"}


def asked(*stores, **settings):
    return ask([open_store(store) for store in stores], AnalysisSettings(**settings))


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return write_store(tmp_path_factory.mktemp("families") / "a.zarr", tasks=tuple(FAMILIES), task_families=FAMILIES)


def headline(path, **settings):
    return va.open(path).analyze(**settings)["tasks"].filter(scope="all", layer="layers_avg").row(0, named=True)


def test_the_interval_over_tasks_is_by_families(store):
    row = headline(store)
    episodes = va.open(store).analyze()["episodes"].filter(layer="layers_avg")
    means = (
        episodes.group_by("task_id").agg(pl.col("log_ratio_mean").mean()).sort("task_id")["log_ratio_mean"].to_numpy()
    )
    names = list(FAMILIES.values())
    sums = np.array(
        [sum(means[i] - means.mean() for i in range(7) if names[i] == name) for name in dict.fromkeys(names)]
    )
    size = np.array([3, 2, 1, 1])
    variance = (sums**2 / (7 * (7 - size))).sum()
    weights = size**2 / (7 * (7 - size))
    degrees = 1 / ((size**2).sum() / 49 + weights.sum() ** 2 - (weights**2).sum())
    reach = stats.t.ppf(0.975, degrees) * np.sqrt(variance)
    assert row["geometric_mean"] == pytest.approx(np.exp(means.mean()))
    assert row["geometric_mean_low"] == pytest.approx(np.exp(means.mean() - reach))
    assert row["geometric_mean_high"] == pytest.approx(np.exp(means.mean() + reach))
    assert (row["num_tasks"], row["num_families"], row["intervals"]) == (7, 4, "tasks-like-these")
    assert "about 90%" in va.open(store).words().notes[0]  # of four families


def test_of_fewer_than_four_families_the_interval_is_about_these_tasks(store, tmp_path, capsys):
    these = headline(store, tasks=[0, 1, 2, 3, 4], intervals="these-tasks")
    few = headline(store, tasks=[0, 1, 2, 3, 4])
    assert few["num_families"] == 3
    assert few["intervals"] == "these-tasks"
    assert few["geometric_mean_low"] == these["geometric_mean_low"]
    words = ["words", str(store), "--no-plots", "--output", str(tmp_path / "out"), "--task", "0", "1", "2", "3", "4"]
    assert main(words) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert re.search(r"\b5 tasks .*\b3 kinds", said)
    assert "tasks like these" not in said


def test_the_families_of_several_suites_are_counted_together(store, tmp_path):
    other = write_store(tmp_path / "b.zarr", suite="other", tasks=(0, 1), task_families={0: "open A", 1: "fold A"})
    row = va.open([store, other]).analyze()["tasks"].filter(scope="combined", layer="layers_avg").row(0, named=True)
    assert (row["num_tasks"], row["num_families"]) == (9, 5)


@pytest.mark.parametrize(
    ("instructions", "number", "examples"),
    [
        (
            ["lift the red cube", "Lift the blue cube", "open the drawer"],
            2,
            ("lift the red cube", "Lift the blue cube"),
        ),
        (["open it", "lift the cube", "lift the cube"], 2, ("lift the cube",)),
        (["put a on b", "put a on c", "put b on c", "put a under b"], 4, ("put a on b", "put a on c")),
    ],
)
def test_instructions_that_differ_in_a_word_are_alike(instructions, number, examples):
    assert alike_instructions(instructions) == (number, examples)


@pytest.mark.parametrize(
    "instructions", [[], [""], ["", ""], ["lift the red cube", "lift the red cube now", "push it"]]
)
def test_other_instructions_are_not(instructions):
    assert alike_instructions(instructions) == (0, ())
