"""Families of tasks from store to printed interval: which there are, what is said of them, and where none is known."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest
from scipy import stats

import vla_attention as va
from tests.kit.questions import question_about
from vla_attention.analyze.__main__ import main
from vla_attention.analyze.measures.question import ask
from vla_attention.analyze.measures.question_settings import AnalysisSettings
from vla_attention.analyze.measures.task_families import (
    MixedFamilies,
    alike_instructions,
    family_notes,
    unknown_families,
)
from vla_attention.analyze.ratios.analysis import analyse
from vla_attention.analyze.statistics.units import Estimand
from vla_attention.schemas.errors import UnknownName
from vla_attention.schemas.stores.reader import open_store
from vla_attention.testing.stores import write_store

#: Seven tasks in four families.
FAMILIES = {0: "put A on B", 1: "put A on B", 2: "open A", 3: "open A", 4: "turn on A", 5: "push A", 6: "put A on B"}


def asked(*stores, **settings):
    return ask([open_store(store) for store in stores], AnalysisSettings(**settings))


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return write_store(tmp_path_factory.mktemp("families") / "a.zarr", tasks=tuple(FAMILIES), task_families=FAMILIES)


def headline(path, **settings):
    return va.open(path).ratios(**settings).filter(scope="all", layer="layers_avg").row(0, named=True)


def test_the_interval_over_tasks_is_by_families(store):
    row = headline(store)
    episodes = va.open(store).ratios("episodes").filter(layer="layers_avg")
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


def test_tasks_can_be_counted_as_independent_and_the_text_says_what_that_assumes(store, tmp_path, capsys):
    row = headline(store, intervals="independent-tasks")
    bare = write_store(tmp_path / "bare.zarr", tasks=tuple(FAMILIES))
    without = headline(bare)
    for name in ("geometric_mean", "geometric_mean_low", "geometric_mean_high", "ratio_lift_low"):
        assert row[name] == without[name]
    assert without["num_families"] is None
    words = [str(store), "--no-plots", "--output", str(tmp_path / "out"), "--intervals", "independent-tasks"]
    assert main(words) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "Intervals assume that no two of the 7 tasks are related, though they are of 4 families" in said
    assert "as if no two of them were related" in said


def test_of_fewer_than_four_families_the_interval_is_about_these_tasks(store, tmp_path, capsys):
    these = headline(store, tasks=[0, 1, 2, 3, 4], intervals="these-tasks")
    few = headline(store, tasks=[0, 1, 2, 3, 4])
    assert few["num_families"] == 3
    assert few["intervals"] == "these-tasks"
    assert few["geometric_mean_low"] == these["geometric_mean_low"]
    words = ["words", str(store), "--no-plots", "--output", str(tmp_path / "out"), "--task", "0", "1", "2", "3", "4"]
    assert main(words) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert (
        "Intervals are about these tasks: the 5 tasks are of 3 families ('put A on B', 'open A', 'turn on A'), and "
        "fewer than 4 show nothing about tasks like these. --intervals independent-tasks counts" in said
    )
    assert "about these tasks (with one task" in said
    assert "tasks like these (with" not in said


def test_an_item_of_fewer_families_is_named(store, tmp_path, capsys):
    assert main(["words", str(store), "--no-plots", "--output", str(tmp_path / "out")]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "about tasks like these, by 4 families" in said
    assert "In tasks of fewer than 4 families, and so about these tasks: " in said
    summary = pl.read_parquet(tmp_path / "out" / "words_summary.parquet")
    assert summary.filter(item="the")["intervals"].item() == "tasks-like-these"
    assert set(summary.filter(item="drawer")["intervals"]) == {"these-tasks"}


def test_one_run_may_know_what_another_does_not(tmp_path):
    """Episodes that were captured before families were stored are of the family that the later ones name."""
    path = write_store(tmp_path / "a.zarr", tasks=(0, 2), episodes=1)
    assert question_about(path).units.families is None
    write_store(path, mode="resume", tasks=(0, 2), episodes=2, task_families=FAMILIES)
    question = question_about(path)
    assert dict(question.sampling.families) == {("made_up", 0): "put A on B", ("made_up", 2): "open A"}
    assert question.sampling.units(pl.DataFrame({"suite": 2 * ["made_up"], "task_id": [0, 2]})).num_families == 2


def test_a_task_of_two_families_is_an_error_that_names_both(tmp_path):
    path = write_store(tmp_path / "a.zarr", tasks=(0, 2), episodes=1, task_families=FAMILIES)
    write_store(path, mode="resume", tasks=(0, 2), episodes=2, task_families={0: "put A on B", 2: "close A"})
    of_both = r"task 2 of made_up are of the task families 'open A' and 'close A' .*task002_episode001.*one family\."
    with pytest.raises(MixedFamilies, match=of_both):
        asked(path)
    asked(path, intervals=Estimand.THESE_TASKS)
    asked(path, tasks=(0,))


def test_the_families_of_several_suites_are_counted_together(store, tmp_path):
    other = write_store(tmp_path / "b.zarr", suite="other", tasks=(0, 1), task_families={0: "open A", 1: "fold A"})
    row = va.open([store, other]).ratios().filter(scope="combined", layer="layers_avg").row(0, named=True)
    assert (row["num_tasks"], row["num_families"]) == (9, 5)
    text = analyse(asked(store, other)).summary
    assert "In tasks of fewer than 4 families, and so about these tasks: other." in " ".join(text.split())


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
    found = alike_instructions(instructions)
    assert (found.number, found.examples) == (number, examples)


@pytest.mark.parametrize(
    "instructions", [[], [""], ["", ""], ["lift the red cube", "lift the red cube now", "push it"]]
)
def test_other_instructions_are_not(instructions):
    assert alike_instructions(instructions) is None


def test_a_store_without_families_warns_where_instructions_are_alike(tmp_path, capsys):
    alike = write_store(tmp_path / "alike.zarr", tasks=(0, 1, 2, 3))  # the fourth has the instruction of the first
    assert main([str(alike), "--no-plots", "--output", str(tmp_path / "out")]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "WARNING: Of 4 tasks no family is known, and 2 of their instructions differ in at most one word" in said
    assert main(["overlay", str(alike), "--no-plots", "--output", str(tmp_path / "out")]) == 0
    assert "WARNING: Of" not in capsys.readouterr().out  # it prints no interval
    for settings in ({"tasks": (0, 1, 2)}, {"intervals": "these-tasks"}, {"intervals": "independent-tasks"}):
        question = asked(alike, **settings)
        assert unknown_families(question.sampling, question.selected) == ""
    question = asked(alike, intervals="independent-tasks")
    assert family_notes(question.sampling, question.selected)[0].startswith(
        "Intervals assume that no two of the 4 tasks"
    )


def test_an_unknown_kind_of_intervals_names_all_three():
    with pytest.raises(UnknownName, match="tasks-like-these, independent-tasks, these-tasks"):
        AnalysisSettings(intervals="tasks")
