"""Effects of planted changes: their size, their floors, the attention beside them, and the command."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import polars as pl
import pytest

from tests.kit.reruns import (
    BASE,
    EPISODES,
    PLANTED,
    REPLANS,
    TASKS,
    PlantedRerun,
    base_actions,
    changed_actions,
    knockout,
    write_base,
    write_rerun,
    write_series,
)
from tests.kit.stores import expected_arrays, rerun_source, write_store
from vla_attention.analyze.__main__ import main
from vla_attention.analyze.effects.effect_study import study_effects
from vla_attention.analyze.effects.paired_replans import BaseEpisode
from vla_attention.analyze.effects.text import effects_sections
from vla_attention.analyze.measures.question_settings import AnalysisSettings
from vla_attention.analyze.show.answer import text_of
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.interventions import Interventions, KeyKnockout, NoiseChange, RerunSource
from vla_attention.schemas.layout import Role
from vla_attention.schemas.stores.store_format import StoreError, StoreNotFound


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("effects")
    write_series(folder / "series", write_base(folder))
    return folder


@pytest.fixture(scope="module")
def study(folder):
    return study_effects(folder / "base.zarr", [folder / "series"], AnalysisSettings())


def row_of(study, name, **where):
    scope = {"scope": "all", "phase": "all", **where}
    return study.summary.row(
        by_predicate=pl.all_horizontal(pl.col(key) == value for key, value in (scope | {"condition": name}).items()),
        named=True,
    )


def by_hand(name: str, task: int, episode: int) -> np.ndarray:
    """Effects (replan,) over the executed steps; the last chunk of an episode of odd number is one step shorter."""
    everything = [base_actions(t, e, REPLANS) for t in TASKS for e in range(EPISODES)]
    spread = np.concatenate([actions.reshape(-1, 7) for actions in everything]).std(axis=0)
    base = base_actions(task, episode, REPLANS)
    change = (changed_actions(PLANTED[name])(task, episode, REPLANS) - base) / spread
    steps = [5] * (REPLANS - 1) + [5 - episode % 2]
    return np.array([np.sqrt((change[i, :n] ** 2).mean()) for i, n in enumerate(steps)])


@pytest.mark.parametrize("name", ["noise", "without_visual", "prompt_empty"])
def test_effects_are_those_that_were_planted(study, name):
    for task, episode in ((0, 0), (2, 1)):
        found = study.episodes.filter(condition=name, task_id=task, episode_index=episode, phase="all")
        assert found["effect"].item() == pytest.approx(by_hand(name, task, episode).mean(), rel=1e-6)
    means = [np.mean([by_hand(name, task, episode).mean() for episode in range(EPISODES)]) for task in TASKS]
    row = row_of(study, name)
    assert row["effect"] == pytest.approx(np.mean(means), rel=1e-6)
    assert row["effect_low"] < row["effect"] < row["effect_high"]
    assert (row["num_tasks"], row["num_episodes"]) == (3, 6)
    assert row_of(study, name, scope="task", task_id=1)["effect"] == pytest.approx(means[1], rel=1e-6)


def test_thirds_are_means_over_their_replans(study):
    found = study.episodes.filter(condition="without_visual", task_id=1, episode_index=0)
    effects = by_hand("without_visual", 1, 0)  # six replans of five steps: two in each third
    for i, phase in enumerate(("first third", "middle third", "last third")):
        assert found.filter(phase=phase)["effect"].item() == pytest.approx(effects[2 * i : 2 * i + 2].mean(), rel=1e-6)


def test_floors_are_of_the_same_episodes(study):
    wanted = {name: study.episodes.filter(condition=name)["effect"].to_numpy() for name in PLANTED}
    for name, control in (("without_visual", "random_visual"), ("without_linguistic", "random_linguistic")):
        own = study.episodes.filter(condition=name)
        np.testing.assert_allclose(own["minus_noise"].to_numpy(), wanted[name] - wanted["noise"])
        np.testing.assert_allclose(own["minus_random"].to_numpy(), wanted[name] - wanted[control])
        row = row_of(study, name)
        assert row["over_noise"] == pytest.approx(row["effect"] / row_of(study, "noise")["effect"])
        assert row["minus_random_q"] < 0.05
    assert study.episodes.filter(condition="noise")["noise"].null_count() == 4 * 6
    assert study.episodes.filter(condition="only_visual")["random"].null_count() == 4 * 6
    # Planted: as large as the noise.
    assert row_of(study, "without_state")["minus_noise_q"] > 0.05


def test_several_noise_seeds_are_averaged(folder, tmp_path):
    base = folder / "base.zarr"
    for seed, size in ((5, 0.1), (6, 0.3)):
        planted = PlantedRerun(Interventions(f"seed{seed}", noise=NoiseChange(seed)), size)
        write_rerun(tmp_path / f"seed{seed}.zarr", base, planted)
    study = study_effects(base, [tmp_path, folder / "series" / "without_visual.zarr"], AnalysisSettings())
    floor = np.mean([row_of(study, name)["effect"] for name in ("seed5", "seed6")])
    assert row_of(study, "without_visual")["noise"] == pytest.approx(floor)


def test_attention_is_the_bases_in_the_same_replans(study):
    """`visual`, mass and lift from the raw rows; heads, layers and denoise steps are averaged first."""
    found = study.episodes.filter(condition="random_visual", task_id=1, episode_index=0)
    arrays = expected_arrays(replace(BASE, plant_actions=base_actions), 1, 0)
    rows = arrays["joint/rows"].mean(axis=(1, 2, 3, 4))
    roles = arrays["joint/key_role"]
    valid = ~np.isin(roles, [Role.MASKED_IMAGE, Role.PADDING, Role.NULL])
    mass = (rows * (roles == Role.IMAGE)).sum(axis=1)
    lift = mass / 16 / ((rows * valid).sum(axis=1) / valid.sum(axis=1))
    assert found.filter(phase="all")["mass"].item() == pytest.approx(mass.mean(), rel=1e-4)
    assert found.filter(phase="all")["lift"].item() == pytest.approx(lift.mean(), rel=1e-4)
    assert found.filter(phase="last third")["mass"].item() == pytest.approx(mass[4:].mean(), rel=1e-4)
    assert found.filter(phase="all")["norm"].item() > 0
    assert study.episodes.filter(condition="prompt_empty")["mass"].null_count() == 4 * 6


def test_attention_is_read_where_it_was_changed(folder, tmp_path):
    planted = PlantedRerun(
        knockout("without_late", "word:bowl | word:drawer | word:stove", layers=(2, 3), heads=(1,), denoise_steps=(9,)),
        0.3,
    )
    write_rerun(tmp_path / "late.zarr", folder / "base.zarr", planted)
    study = study_effects(folder / "base.zarr", [tmp_path / "late.zarr"], AnalysisSettings())
    arrays = expected_arrays(replace(BASE, plant_actions=base_actions), 0, 0)
    episode = study.question.selected[0]
    words = {i: word.keys for i, line in enumerate(episode.tokens.words) for word in line if word.text == "bowl"}
    rows = arrays["joint/rows"][:, 1, 1, 1, 0]  # layer 2 of the recorded 0 and 2, the last step, head 1
    mass = [row[list(words[which])].sum() for row, which in zip(rows, arrays["prompt_index"], strict=True)]
    found = study.episodes.filter(task_id=0, episode_index=0, phase="all")
    assert found["mass"].item() == pytest.approx(np.mean(mass), rel=1e-4)
    assert found["norm"].item() is None  # a word is a part of a segment


def test_nothing_changed_is_an_effect_of_zero(folder, tmp_path):
    spec = replace(BASE, plant_actions=base_actions, rerun_of=rerun_source(folder / "base.zarr"))
    write_store(tmp_path / "same.zarr", spec=spec)
    study = study_effects(folder / "base.zarr", [tmp_path / "same.zarr"], AnalysisSettings())
    assert study.episodes["effect"].unique().to_list() == [0.0]
    assert study.episodes["angle"].unique().to_list() == [0.0]
    assert row_of(study, "same")["effect_low"] is None
    assert "same" in text_of(effects_sections(study))


def test_the_units_do_not_change_with_the_selected_tasks(folder, study):
    two = [folder / "series" / f"{name}.zarr" for name in ("without_visual", "prompt_empty")]
    some = study_effects(folder / "base.zarr", two, AnalysisSettings(tasks=(1,)))
    np.testing.assert_array_equal(some.spread.spread, study.spread.spread)
    assert some.episodes["task_id"].unique().to_list() == [1]
    skipping = study_effects(folder / "base.zarr", two, AnalysisSettings(tasks=(1,), skip_corrupt=True))
    np.testing.assert_array_equal(skipping.spread.spread, study.spread.spread)
    only = study_effects(folder / "base.zarr", two, AnalysisSettings(), dimensions=(6,))
    row = row_of(only, "without_visual")
    assert row["effect"] < 2  # flips of a gripper of spread 1 change it by two spreads
    assert row_of(only, "prompt_empty")["effect"] == 0.0


def test_episodes_without_a_partner_are_named(folder, tmp_path):
    write_rerun(tmp_path / "part.zarr", folder / "base.zarr", PLANTED["prompt_empty"], tasks=(0, 5))
    study = study_effects(folder / "base.zarr", [tmp_path / "part.zarr"], AnalysisSettings())
    assert row_of(study, "prompt_empty")["num_episodes"] == 2
    (note,) = study.notes
    assert "lacks task001_episode000, task001_episode001" in note
    assert "has task005_episode000, task005_episode001, which the base lacks" in note
    assert "note: prompt_empty lacks" in text_of(effects_sections(study))


@pytest.mark.drawn
def test_the_command_prints_a_screen_and_writes_tables_and_pictures(folder, tmp_path, capsys):
    given = ["effects", str(folder / "base.zarr"), str(folder / "series"), "--output", str(tmp_path)]
    assert main(given) == 0
    printed = capsys.readouterr().out
    assert len(printed.splitlines()) <= 40
    assert "WITHOUT IT, AND WITH IT ALONE" in printed
    names = {path.name for path in tmp_path.iterdir()}
    assert {"effects.parquet", "effects.csv", "effects_summary.parquet", "effects_by_condition.png"} <= names
    assert {"attention_and_effect.png", "summary.txt"} <= names
    points = pl.read_csv(tmp_path / "effects_by_condition.csv")
    assert points.filter(row="visual")["point"].to_list() == ["without", "only", "random"]
    assert pl.read_csv(tmp_path / "attention_and_effect.csv")["group"].to_list() == ["visual", "linguistic", "state"]


def rollout(folder, name, success, **changes):
    spec = replace(
        BASE, plant_actions=base_actions, plant_success=success, interventions=PLANTED[name].interventions, **changes
    )
    return write_store(folder / f"{name}.zarr", spec=spec)


def test_rollouts_are_paired_by_initial_state(tmp_path, capsys):
    base = write_base(tmp_path, plant_success=lambda task, episode: True)
    other = rollout(tmp_path / "rollouts", "without_visual", lambda task, episode: task == 0, tasks=(0, 1))
    study = study_effects(base, [other], AnalysisSettings())
    row = study.rollouts.row(by_predicate=pl.col("scope") == "all", named=True)
    assert (row["num_episodes"], row["num_tasks"]) == (4, 2)
    assert (row["success_base"], row["success"], row["success_difference"]) == (1.0, 0.5, -0.5)
    assert row["steps_difference"] == 0.0
    assert study.rollouts.filter(scope="task", task_id=1)["success"].to_list() == [0.0]
    assert "no rollout from the initial states of task002_episode000" in study.notes[0]
    assert main(["effects", str(base), str(tmp_path / "rollouts"), "--output", str(tmp_path / "out")]) == 0
    assert "ROLLOUTS" in capsys.readouterr().out
    assert pl.read_parquet(tmp_path / "out" / "rollouts.parquet").height == 4


def test_what_does_not_fit_is_refused_in_one_sentence(folder, tmp_path):
    base = folder / "base.zarr"

    def refused(path, error=BadArgument, **settings):
        with pytest.raises(error) as raised:
            study_effects(base, [path], AnalysisSettings(**settings))
        return str(raised.value)

    alien = write_store(
        tmp_path / "alien.zarr",
        spec=replace(BASE, interventions=PLANTED["noise"].interventions, rerun_of=RerunSource("ab" * 32, "other.zarr")),
    )
    assert "is a rerun of 'other.zarr' (run abababababab), not of" in refused(alien)
    plain = write_store(tmp_path / "plain.zarr", spec=BASE)
    assert "is no rerun" in refused(plain)
    assert "is given as the base and as its rerun" in refused(base)
    message = refused(tmp_path)  # a folder: what does not fit is left out by name, and nothing is left
    assert "holds no rerun of" in message
    assert "alien.zarr is left out" in message
    (tmp_path / "empty").mkdir()
    assert "holds no store" in refused(tmp_path / "empty", StoreNotFound)
    assert "There is no store at" in refused(tmp_path / "missing.zarr", StoreNotFound)
    elsewhere = write_rerun(tmp_path / "elsewhere.zarr", base, PLANTED["noise"], tasks=(7,))
    assert "holds none of the 6 episodes of its base" in refused(elsewhere)
    shorter = write_rerun(tmp_path / "shorter.zarr", base, PLANTED["noise"], replans=2)
    assert "these are not the same replans" in refused(shorter, StoreError)
    recorded_again = write_rerun(tmp_path / "again.zarr", base, PLANTED["noise"], seed=5)
    assert "another prompt and another state of the robot than in its base" in refused(recorded_again, StoreError)
    with pytest.raises(BadArgument, match="There is no dimension 7 of the action"):
        study_effects(base, [folder / "series" / "noise.zarr"], AnalysisSettings(), dimensions=(7,))
    stranger = rollout(tmp_path / "s", "without_state", lambda *_: True, suite="goal")
    assert "is a rollout with another suite" in refused(stranger)
    late = write_store(
        tmp_path / "late.zarr",
        spec=replace(BASE, tasks=(9,), interventions=Interventions(keys=(KeyKnockout("role:image"),))),
    )
    assert "begins in the initial state of a selected episode" in refused(late)


def test_actions_that_never_change_have_no_unit(tmp_path):
    spec = replace(BASE, tasks=(0,), plant_actions=lambda task, episode, replans: np.ones((replans, 5, 7)))
    base = write_store(tmp_path / "still.zarr", spec=spec)
    rerun = write_rerun(tmp_path / "rerun.zarr", base, PLANTED["noise"], tasks=(0,))
    with pytest.raises(BadArgument, match="the actions are the same in every replan and step"):
        study_effects(base, [rerun], AnalysisSettings())


def test_replans_without_the_word_are_in_no_effect(folder, tmp_path):
    """'bowl' is in the instruction of task 0 only; a rerun need not hold the other tasks."""
    planted = PlantedRerun(knockout("without_bowl", "word:bowl"), 0.3)
    write_rerun(tmp_path / "a.zarr", folder / "base.zarr", planted)
    write_rerun(tmp_path / "b.zarr", folder / "base.zarr", planted, tasks=(0,))
    for name in ("a", "b"):
        study = study_effects(folder / "base.zarr", [tmp_path / f"{name}.zarr"], AnalysisSettings())
        assert study.episodes["task_id"].unique().to_list() == [0]
        assert row_of(study, "without_bowl")["num_episodes"] == EPISODES
        assert study.notes == ()


def test_only_executed_steps_count_where_the_base_stores_how_many(folder):
    [item, *_] = study_effects(
        folder / "base.zarr", [folder / "series" / "noise.zarr"], AnalysisSettings()
    ).question.selected

    def executed(**fields) -> list[int]:
        protocol = replace(item.store.attributes.protocol, **fields)
        attributes = replace(item.store.attributes, protocol=protocol)
        return BaseEpisode.of(replace(item, store=replace(item.store, attributes=attributes))).executed.tolist()

    assert item.store.attributes.protocol.replan_steps == 5
    assert executed() == [5] * REPLANS
    assert executed(replan_steps=2) == [2] * REPLANS
    # The frames between the calls of a replayed data set are no executed steps; nor is a number known that is 0.
    assert executed(name="dataset", replan_steps=2) == [5] * REPLANS
    assert executed(name="recorded", replan_steps=0) == [5] * REPLANS


def test_a_control_of_less_than_half_a_key_is_none(folder, tmp_path):
    """An object that covers 0.3 of a patch: its knockout is a knockout, and random keys are counted in whole ones."""
    selector = "object:robot & patch:base_0_rgb[0:1,0:1]"
    for name, options in (("without_robot", {}), ("random_robot", {"random_seed": 0})):
        write_rerun(
            tmp_path / f"{name}.zarr", folder / "base.zarr", PlantedRerun(knockout(name, selector, **options), 0.3)
        )
    found = study_effects(folder / "base.zarr", [tmp_path], AnalysisSettings()).episodes.filter(phase="all")
    keys = {row["episode_index"]: row for row in found.filter(condition="without_robot", task_id=0).to_dicts()}
    assert all(row["keys"] > 0 and row["num_replans"] == REPLANS for row in keys.values())
    controls = found.filter(condition="random_robot")
    assert controls["num_replans"].sum() < found.filter(condition="without_robot")["num_replans"].sum()
