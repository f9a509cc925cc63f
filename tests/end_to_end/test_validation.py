"""`benchmarks/validation`: the reduced run on policies that were trained for a step, and its arithmetic."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

import benchmarks.validation.calls as validation_calls
from benchmarks.validation import maps
from benchmarks.validation.__main__ import main
from benchmarks.validation.calls import changed_episodes, units_of
from benchmarks.validation.changes import BASE_CAMERA, without
from benchmarks.validation.map_calls import Measured, mask_scores, moved_cover
from benchmarks.validation.map_tables import map_blocks
from benchmarks.validation.numbers import NUMBERS
from benchmarks.validation.policies import load_policy
from benchmarks.validation.ranks import FAMILIES, spearman
from benchmarks.validation.tables import fill_marks, fill_page
from tests.kit.made_up_demonstrations import INSTRUCTIONS, write_demonstrations
from tests.kit.questions import question_about
from tests.kit.reruns import write_base
from vla_attention.analyze.core.recorded_effects import recorded_effects
from vla_attention.capture.__main__ import main as capture
from vla_attention.capture.environments.cubes.tasks import CUBE_TASKS
from vla_attention.capture.interventions.changed_inputs import shifted
from vla_attention.schemas.layout import PatchGrid
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


def test_over_all_masks_the_score_of_a_patch_is_what_it_adds():
    masks = np.array(list(np.ndindex((2,) * 4)), bool)
    added = np.array([0.5, 0.0, 2.0, 0.1])
    np.testing.assert_allclose(mask_scores(masks, masks @ added), added, atol=1e-12)


def test_what_objects_cover_moves_with_the_picture():
    cover = np.random.default_rng(0).integers(0, 2, (16, 3)).astype(np.float32)
    grid = PatchGrid(4, 4, 4, 4)
    picture = shifted(cover.reshape(4, 4, 3).astype(np.uint8), grid, 0, 1)
    np.testing.assert_array_equal(moved_cover(cover, grid, 1), picture.reshape(16, 3))


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
        (moved, *_) = found.units.parts
        effect = moved.of(episode.base, episode.actions["words"], episode.executed)
        assert effect.mean() == pytest.approx(expected[episode.task_id], rel=1e-4)


@pytest.mark.simulator
@pytest.mark.thorough
def test_the_reduced_run_about_maps_has_every_table(work, tmp_path):
    assert maps.main([str(work.parent / "policies"), "--work", str(work), "--reduced"]) == 0
    results = json.loads((work / "maps.json").read_text())
    assert [policy["control"] for policy in results["policies"]] == ["shipped", "words", "redundant"]
    assert ["mark exact" in policy["numbers"] for policy in results["policies"]] == [False, False, True]
    page = tmp_path / "page.md"
    shutil.copy(ROOT / "docs" / "validation.md", page)
    fill_marks(page, map_blocks(results))
    assert "random blurred masks" in page.read_text()


@pytest.mark.simulator
@pytest.mark.thorough
def test_the_mark_that_is_shown_again_is_the_one_that_was_shown(work):
    store = open_store(work / "redundant_0" / "base.zarr")
    measured = Measured(load_policy(store.path), 5)
    for call in measured.calls(store, 1):
        again = measured.told_otherwise(call, CUBE_TASKS[call.context.task_id].target, "mark")
        pictures = (one.frames[BASE_CAMERA].astype(int) for one in (again, call.given))
        # The simulator's picture was made smaller, which mixes the mark's edge; another mark differs by 180 and more.
        assert np.abs(np.subtract(*pictures)).max() < 90
