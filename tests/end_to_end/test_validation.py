"""`benchmarks/validation`: the reduced run on policies that were trained for a step, and its arithmetic."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

import benchmarks.validation.calls as validation_calls
from benchmarks.validation.__main__ import main
from benchmarks.validation.calls import changed_episodes, units_of
from benchmarks.validation.changes import without
from benchmarks.validation.numbers import NUMBERS
from benchmarks.validation.policies import load_policy
from benchmarks.validation.ranks import FAMILIES, spearman
from benchmarks.validation.tables import fill_page
from tests.kit.made_up_demonstrations import INSTRUCTIONS, write_demonstrations
from tests.kit.questions import question_about
from tests.kit.reruns import write_base
from vla_attention.analyze.core.recorded_effects import recorded_effects
from vla_attention.capture.__main__ import main as capture
from vla_attention.schemas.stores.reader import open_store

ROOT = Path(__file__).resolve().parents[2]


def quiet(line: str) -> None:
    """Say nothing."""


@pytest.mark.parametrize("seed", range(3))
def test_rank_correlation_is_that_of_scipy(seed):
    scipy_stats = pytest.importorskip("scipy.stats")
    generator = np.random.default_rng(seed)
    first, second = generator.integers(0, 6, (2, 12)).astype(float)  # with ties
    assert spearman(first, second) == pytest.approx(scipy_stats.spearmanr(first, second).statistic)


def test_units_leave_out_what_is_mostly_noise(tmp_path, monkeypatch):
    base, change = write_base(tmp_path), np.array([0.0, 0, 0, 9, 0, 0, 0])

    def calls_again(policy, calls, chosen, changes, instructions):
        return (calls.actions[chosen] + change)[None]

    monkeypatch.setattr(validation_calls, "_make", calls_again)
    found = units_of(None, open_store(base), tmp_path / "units", quiet)
    assert found.left_out == (3,)
    actions = np.concatenate([episode.read("actions").reshape(-1, 7) for episode in open_store(base).episodes])
    np.testing.assert_allclose(found.spread, actions.std(axis=0))


@pytest.fixture(scope="module")
def work(tmp_path_factory):
    """The reduced run about two policies that were trained for one step."""
    from examples.cubes_policy.dataset import read_demonstrations
    from examples.cubes_policy.export import export
    from examples.cubes_policy.training import TrainingSettings, train

    folder = tmp_path_factory.mktemp("validation")
    demonstrations = read_demonstrations(write_demonstrations(folder / "demonstrations"))
    for control in ("words", "redundant"):
        settings = TrainingSettings(steps=1, batch_size=2, control=control)
        train(demonstrations, INSTRUCTIONS, folder / control, settings, say=quiet)
        export(folder / control, folder / "policies" / f"{control}_0", f"{control}_0")
    given = [str(folder / "policies"), "--work", str(folder / "work"), "--reduced"]
    assert main(given) == 0
    return folder / "work"


@pytest.mark.simulator
@pytest.mark.thorough
def test_the_reduced_run_has_every_table_and_unchanged_calls_are_the_stored_ones(work, tmp_path):
    results = json.loads((work / "results.json").read_text())
    assert [policy["control"] for policy in results["policies"]] == ["shipped", "words", "redundant"]
    assert {policy["rerun_difference"] for policy in results["policies"]} == {0.0}
    without_mark = set(NUMBERS) - {"mark", "mark_filled"}
    found = [set(policy["numbers"]) for policy in results["policies"]]
    assert found == [without_mark, without_mark, set(NUMBERS)]
    assert {row["family"] for row in results["ranks"]} == set(FAMILIES)
    assert {row["policy"] for row in results["success"]} == {"shipped", "words_0", "redundant_0"}
    page = tmp_path / "page.md"
    shutil.copy(ROOT / "docs" / "validation.md", page)
    fill_page(page, results)
    assert len(page.read_text().splitlines()) > 100


@pytest.mark.simulator
@pytest.mark.thorough
def test_effects_are_those_that_a_rerun_records(work, tmp_path):
    base = open_store(work / "words_0" / "base.zarr")
    store = tmp_path / "effects.zarr"
    assert capture(["rerun", str(base.path), "--effects", "text", "--output", str(store)]) == 0
    found = recorded_effects(question_about(store), attention=False)
    assert found is not None
    table = found.episodes().filter(condition="without_instruction")
    policy = load_policy(base.path)
    changes = {"words": without("role:instruction", "action")}
    ours = changed_episodes(policy, base, lambda episode: changes, 99, tmp_path / "calls", quiet)
    expected = {row["task_id"]: row["effect"] for row in table.iter_rows(named=True)}
    for episode in ours:
        assert episode.effect("words", found.spread).mean() == pytest.approx(expected[episode.task_id], rel=1e-4)
