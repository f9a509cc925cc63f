"""Recorded effects of two runs side by side: the differences of the two commands, and a planted word."""

from __future__ import annotations

from dataclasses import replace

import pytest

from tests.kit.planted_effects import FIRST, ITEMS, planted_effects
from tests.kit.questions import question_about
from vla_attention.analyze.commands.effects import effects
from vla_attention.analyze.compare.comparison import compare
from vla_attention.analyze.compare.runs import open_runs, parse_runs
from vla_attention.analyze.compare.text import comparison_sections
from vla_attention.analyze.measures.question_settings import AnalysisSettings
from vla_attention.analyze.show.answer import text_of
from vla_attention.testing.stores import StoreSpec, write_store

SETTINGS = AnalysisSettings(intervals="these-tasks")
SPEC = StoreSpec(tasks=(0, 1, 2), episodes=4, replans=2)


def jitter(run: int, factor: float):
    """Planted: the first word matters `factor` times as much; every episode differs a little, in each run."""

    def scale(name: str, task: int, episode: int, replan: int) -> float:
        own = 1.0 + 0.02 * ((task + episode * (1 + run)) % 3)
        return own * (factor if f"word_{FIRST}_queries_all" in name else 1.0)

    return scale


@pytest.fixture(scope="module")
def stores(tmp_path_factory):
    folder = tmp_path_factory.mktemp("effects_of_runs")
    specs = {
        "base": replace(SPEC, plant_effects=planted_effects(jitter(0, 1.0))),
        "other": replace(SPEC, plant_effects=planted_effects(jitter(1, 1.5)), policy="tuned"),
        "plain": replace(SPEC, policy="tuned"),
        "elsewhere": replace(SPEC, plant_effects=planted_effects(jitter(1, 1.5)), seed=5),
    }
    return {name: write_store(folder / f"{name}.zarr", spec=spec) for name, spec in specs.items()}


def compared(stores, *names, allowed=()):
    return compare(open_runs(parse_runs([str(stores[name]) for name in names]), SETTINGS, allowed), allowed)


def test_the_differences_are_those_of_the_two_commands(stores):
    comparison = compared(stores, "base", "other")
    tables = [
        effects(question_about(stores[name], intervals="these-tasks"))["effects_items"] for name in ("base", "other")
    ]
    rows = comparison.effects.filter(scope="all")
    assert rows.height == 2 * len(ITEMS)
    for row in rows.iter_rows(named=True):
        sides = [table.filter(item=row["item"])[row["reader"]].item() for table in tables]
        assert [row["mean_first"], row["mean_other"]] == pytest.approx(sides, rel=1e-9)
        assert row["difference"] == pytest.approx(sides[1] - sides[0], rel=1e-6, abs=1e-9)
        assert row["paired"]


@pytest.mark.thorough
def test_the_planted_word_is_named_and_nothing_else(stores):
    comparison = compared(stores, "base", "other")
    shown = comparison.effects.filter(scope="all").sort("q", nulls_last=True)
    assert (shown["item"][0], shown["reader"][0]) == (f"'{FIRST}'", "total")
    text = text_of(comparison_sections(comparison))
    assert f"'{FIRST}'" in text.split("EFFECTS  without it")[1].splitlines()[2]
