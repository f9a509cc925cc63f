"""`exchange` with an arm that always does one thing, whatever it is told, through the command and `language`."""

from __future__ import annotations

import polars as pl
import pytest

pytest.importorskip("robosuite")

import numpy as np

from examples.cubes_policy.experts import expert_action, read_state
from tests.kit.questions import question_about
from vla_attention.analyze.commands.language import language
from vla_attention.analyze.core.exchanged import words_by_kind
from vla_attention.capture.__main__ import main as capture
from vla_attention.capture.environments.base import Suite, Task
from vla_attention.capture.environments.cubes.environment import CubesEnvironment
from vla_attention.capture.policies.pi.policy import PiPolicy
from vla_attention.capture.run.exchange import exchanged_jobs
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.stores.reader import open_store

COMMAND = ["exchange", "pi", "--checkpoint", "untrained-tiny", "--task-suite", "cubes", "--num-envs", "1",
           "--replan-steps", "4", "--max-steps", "24", "--layers", "0"]  # fmt: skip


@pytest.mark.simulator
@pytest.mark.parametrize("tasks", [(0, 1), pytest.param((0, 1, 3), marks=pytest.mark.thorough)])
def test_an_arm_that_always_touches_the_red_cube(monkeypatch, tmp_path, tasks):
    tables: list[CubesEnvironment] = []
    reset = CubesEnvironment.reset

    def noted(self: CubesEnvironment, *given: int) -> None:
        tables[:] = [self]
        reset(self, *given)

    def act(self: PiPolicy, policy_input, noise_seed, recorders, editors=None):
        actions = own(self, policy_input, noise_seed, recorders, editors)
        simulator = tables[0].simulator
        return np.broadcast_to(expert_action("touch", read_state(simulator), 0, None), actions.shape).copy()

    own = PiPolicy.act
    monkeypatch.setattr(CubesEnvironment, "reset", noted)
    monkeypatch.setattr(PiPolicy, "act", act)
    store = tmp_path / "e.zarr"
    assert capture([*COMMAND, "--task", "0", "1", "--output", str(store)]) == 0
    assert capture([*COMMAND, "--task", *map(str, tasks), "--output", str(store), "--resume"]) == 0

    episodes = [one.attributes for one in open_store(store).episodes]
    assert {(one.task_id, one.scene_task_id) for one in episodes} == {(a, b) for a in tasks for b in tasks}
    of_scene = {one.scene_task_id: one.initial_state_digest for one in episodes}
    assert len({*of_scene.values()}) == len(tasks)
    assert all(one.initial_state_digest == of_scene[one.scene_task_id] for one in episodes)
    assert [one.success for one in episodes] == [one.task_id == 0 for one in episodes]
    assert all(one.prompts[0].instruction_text == one.instruction for one in episodes)
    for one in episodes:
        named = {thing.name for thing in one.objects if thing.of_interest}
        assert named == {"green_cube" if one.task_id == 1 else "red_cube"}

    found = language(question_about(store))
    rates = {row["sentence"]: row for row in found["exchange"].iter_rows(named=True)}
    assert rates["its own"]["did_told"] == pytest.approx(1 / len(tasks))
    other = rates["another task's"]
    cells = found["exchange_matrix"].filter(pl.col("task_id") == 1)
    told_1 = [(0, 0, 1), (1, 0, 0), (3, 0, 0)][: len(tasks)]
    assert cells.select("scene_task_id", "did_told", "did_scene").rows() == told_1
    if len(tasks) == 2:
        assert (other["right"], other["num_episodes"], other["scenes"]) == (1, 2, 1)
        return
    assert (other["right"], other["num_episodes"], other["scenes"]) == (2, 6, 2)
    # A mean over told tasks: 0 touched its red cube, 1 never its green one, 3 its red one in the scene of green. The
    # cube that is touched does not show whether 'touch' or 'lift' was heard of it.
    assert other["followed"] == pytest.approx(2 / 3)
    kinds = {row["kind"]: row for row in found["exchange_kinds"].iter_rows(named=True)}
    # 'touch' where 'lift' was told or was the scene's own: never lifted. Red where green was: never green.
    assert {kind: (row["right"], row["scenes"], row["num_episodes"]) for kind, row in kinds.items()} == {
        "verb": (2, 2, 4),
        "colour": (2, 2, 4),
    }


@pytest.mark.parametrize(
    ("sentence", "words"),
    [
        ("put the bowl on the plate", ("put", "bowl plate", "", "")),
        ("open the top drawer and put the bowl inside", ("open put", "drawer bowl", "", "top inside")),
        ("Push the red_cube to the left.", ("push", "cube", "red", "left")),
        ("", ("", "", "", "")),
    ],
)
def test_words_by_kind(sentence, words):
    assert [*words_by_kind(sentence).values()] == [frozenset(of_kind.split()) for of_kind in words]


SUITE = Suite("made_up", "libero", 5, 10, 50, 1e9)
TASKS = [Task("made_up", number, f"t{number}", f"do {number}", 50) for number in range(5)]


def test_every_told_task_in_every_scene_that_shares_it():
    jobs = exchanged_jobs(SUITE, [TASKS[:3], TASKS[3:4], TASKS[4:]], 2, 10, 18)
    assert len({job.name for job in jobs}) == 18
    assert {(job.task.task_id, *job.begins_as) for job in jobs} == {
        (told, scene, state) for told in range(3) for scene in range(3) for state in range(2)
    }


@pytest.mark.parametrize(("scenes", "most", "message"), [([TASKS[:3]], 17, "18 rollouts"), ([TASKS[:1]], 99, "share")])
def test_what_cannot_be_exchanged(scenes, most, message):
    with pytest.raises(BadArgument, match=message):
        exchanged_jobs(SUITE, scenes, 2, 10, most)
