"""One episode with a made-up environment, policy and store: which steps are taken, observed and stored."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from vla_attention.capture.engine import simulator_process
from vla_attention.capture.engine.call import Caller, record_of
from vla_attention.capture.engine.simulation import StopCheck
from vla_attention.capture.engine.simulators import Simulators, check_protocol, max_replans
from vla_attention.capture.engine.source import EpisodeJob, Outcome
from vla_attention.capture.environments.base import Departures, Moment, Observation, StepResult, Task
from vla_attention.capture.environments.episode_protocol import WAIT_ACTION, WAIT_STEPS
from vla_attention.capture.policies.policy import PolicyInput
from vla_attention.capture.store.replan_records import ReplanRecord
from vla_attention.schemas.episode_steps import Displaced, TaskGoal
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.groupings.vocabulary import SceneObject
from vla_attention.schemas.layout import PatchGrid, Prompt, Role, SiteLayout, Span
from vla_attention.schemas.libero_physics import MEND
from vla_attention.schemas.stores.store_format import PolicyCameraView, Protocol, Recording

LAYOUT = SiteLayout(
    "joint",
    (
        Span("base", "image", 0, 2, camera="base", grid=PatchGrid(2, 1, 4, 2)),
        Span("prompt", "text", 2, 4),
    ),
)
ROLES = np.array([Role.IMAGE, Role.IMAGE, Role.INSTRUCTION, Role.INSTRUCTION], dtype=np.uint8)
TASK = Task("made_up", 3, "lift", "lift the cube", 50)


class FakeEnvironment:
    """Counts steps; an observation's eef_pos is the number of the step after which it was made."""

    objects = (SceneObject("cube", "object", True), SceneObject("background", "background", False))
    initial_state_digest = "d" * 64

    def __init__(self, solved_after: int | None = None) -> None:
        self.solved_after = solved_after
        self.actions: list[np.ndarray] = []
        self.observed: list[int] = []

    def reset(self, initial_state_index: int, seed: int) -> None:
        self.start = (initial_state_index, seed)

    def missing_resets(self, initial_state_index: int, seed: int) -> int:
        return 0

    def step(self, action: np.ndarray, observe: bool) -> StepResult:
        self.actions.append(np.asarray(action))
        number = len(self.actions)
        observation = None
        if observe:
            self.observed.append(number)
            images = {"agentview": np.zeros((4, 2, 3), dtype=np.uint8)}
            observation = Observation(images, np.full(3, float(number)), np.zeros(4), np.zeros(2))
        return StepResult(number == self.solved_after, observation)

    def segmentation(self, camera: str) -> np.ndarray:
        assert camera == "agentview"
        return np.array([[0, 0], [0, 0], [1, 1], [1, 1]], dtype=np.int32)


class FakePolicy:
    """Gives chunks of four actions; action k of call r is filled with 10 r + k. Its rows are uniform."""

    sites = (LAYOUT,)
    action_horizon = 4
    cameras = (PolicyCameraView("base", "agentview", True, False),)

    def __init__(self) -> None:
        self.inputs: list[float] = []

    def denoise_times(self) -> np.ndarray:
        return np.array([1.0, 0.5])

    def replan_noise_seed(self, run_seed: int, task_id: int, episode_index: int, replan: int) -> int:
        return 1000 * run_seed + 100 * task_id + 10 * episode_index + replan

    def prepare(self, observation: Observation, instruction: str) -> PolicyInput:
        self.inputs.append(observation.eef_pos[0])
        prompt = Prompt(instruction, (), (0, len(instruction)))
        frames = {"base": np.zeros((4, 2, 3), dtype=np.uint8)}
        return PolicyInput(frames, {"joint": ROLES}, prompt, np.zeros(8), {})

    def act(
        self, policy_input: PolicyInput, noise_seed: int, recorders: dict[str, Any], editors: Any = None
    ) -> np.ndarray:
        for step in range(2):
            take = recorders["joint"].sink(0, step, slice(0, 1))
            if take is not None:
                take(torch.full((1, 2, 1, 4), 0.25))
        return (10.0 * (len(self.inputs) - 1) + np.arange(4.0))[:, None].repeat(7, axis=1)


class FakeStore:
    """Keeps the replans of its one episode."""

    def __init__(self, **changes: int) -> None:
        values = {
            "seed": 7,
            "wait_steps": WAIT_STEPS,
            "replan_steps": 3,
            "max_steps": 8,
            "name": "openpi",
            "image_size": 4,
        } | changes
        self.attributes = SimpleNamespace(
            protocol=Protocol(suite="made_up", **values),
            recording=Recording((0,), (0,), (1,), (0, 1), "mean", 1, 10, frames=False),
        )
        self.records: list[ReplanRecord] = []
        self.path = Path("runs/made_up.zarr")


def run_episode(
    monkeypatch: pytest.MonkeyPatch,
    environment: FakeEnvironment,
    store: FakeStore,
    policy: FakePolicy | None = None,
    *,
    index: int = 0,
    check: StopCheck = lambda: None,
) -> tuple[Outcome, SimpleNamespace]:
    """Run an episode in this process; also returns the `start` and (step, replans) after each call."""
    monkeypatch.setattr(simulator_process, "make_environment", lambda suite, task_id, settings: environment)
    caller = Caller(policy or FakePolicy(), store.attributes.recording)
    machine = {"host": "x", "mujoco": "3.8.1"}
    source = Simulators(None, None, store, caller, machine, check)  # type: ignore[arg-type]
    episode = source.open(EpisodeJob(TASK, index, 8, ""))
    done: list[int] = []
    while not isinstance(given := episode.poll(), Outcome):
        assert given is not None
        (made,) = caller.make([given])
        store.records.append(record_of(given, made.rows, made.actions, caller.recording, None, given.noise_seed))
        episode.advance(made.actions)
        done.append(episode.done)
    done.append(episode.done)
    return given, SimpleNamespace(start=episode.start, done=done[1:])


def test_waiting_steps_then_a_policy_call_for_every_chunk(monkeypatch) -> None:
    environment, policy, store = FakeEnvironment(), FakePolicy(), FakeStore()
    outcome, told = run_episode(monkeypatch, environment, store, policy, index=2)
    assert environment.start == (2, 7)
    np.testing.assert_array_equal(environment.actions[:WAIT_STEPS], [WAIT_ACTION] * WAIT_STEPS)
    # Three of the four actions of each chunk are executed, and only two of the last: max_steps is 8.
    assert [action[0] for action in environment.actions[WAIT_STEPS:]] == [0, 1, 2, 10, 11, 12, 20, 21]
    # Pictures are drawn only before a policy call, and the policy gets the newest.
    assert environment.observed == [WAIT_STEPS, WAIT_STEPS + 3, WAIT_STEPS + 6]
    assert policy.inputs == environment.observed
    assert [record.env_step for record in store.records] == [WAIT_STEPS, WAIT_STEPS + 3, WAIT_STEPS + 6]
    assert [record.noise_seed for record in store.records] == [7320, 7321, 7322]
    assert told.done == [3, 6, 8]
    assert outcome == Outcome(False, 8)
    assert (told.start.initial_state_index, told.start.initial_state_digest) == (2, "d" * 64)
    assert told.start.provenance == {"host": "x", "mujoco": "3.8.1"}


def test_a_solved_task_ends_the_episode(monkeypatch) -> None:
    environment, store = FakeEnvironment(solved_after=WAIT_STEPS + 2), FakeStore()
    assert run_episode(monkeypatch, environment, store)[0] == Outcome(True, 2)
    assert len(store.records) == 1


class WatchedEnvironment(FakeEnvironment):
    """Tells moments: the hand is as high as the number of steps; the cube is touched from the second on."""

    bodies = ("hand", "cube")
    goals = (TaskGoal(3, "lift", "lift the cube", ("up",), None), TaskGoal(4, "touch", "touch it", ("touch",), None))

    def moment(self) -> Moment:
        number = len(self.actions)
        poses = np.zeros((2, 7), np.float32)
        poses[:, 3], poses[0, 2] = 1, number
        touched = number >= WAIT_STEPS + 2
        return Moment(
            poses, np.zeros(2, np.float32), np.array([False, touched]), np.array([number == self.solved_after, touched])
        )

    def departures(self) -> Departures:
        assert len(self.actions) == WAIT_STEPS
        return Departures(("cube on plate",), (Displaced("cube", 0.54),))


def test_what_is_told_of_every_step_is_stored(monkeypatch, capsys) -> None:
    environment = WatchedEnvironment(solved_after=WAIT_STEPS + 4)
    steps = run_episode(monkeypatch, environment, FakeStore())[0].steps
    assert steps is not None
    assert steps.poses[:, 0, 2].tolist() == [WAIT_STEPS + i for i in range(5)]
    # Three actions of the first chunk, and the one of the second that solved the task.
    assert steps.actions[:, 0].tolist() == [0, 1, 2, 10]
    assert (steps.poses.dtype, steps.actions.dtype, steps.gripper.shape) == (np.float32, np.float32, (5, 2))
    assert steps.attributes.bodies == ("hand", "cube")
    assert steps.attributes.first_touch == (None, 2)
    assert (steps.attributes.mujoco, steps.attributes.lost_relations) == ("3.8.1", ("cube on plate",))
    assert steps.attributes.displaced == (Displaced("cube", 0.54),)
    said = capsys.readouterr().out
    assert [said.count(part) for part in ("cube on plate", "cube by 54 cm", MEND)] == [1, 1, 1]
    assert [goal.first_held for goal in steps.attributes.goals] == [4, 2]


def test_a_replan_is_stored_with_its_rows_and_coverage(monkeypatch) -> None:
    store = FakeStore(max_steps=1)
    run_episode(monkeypatch, FakeEnvironment(), store)
    (record,) = store.records
    rows = record.rows["joint"]
    assert rows.rows.shape == (1, 1, 2, 1, 4)
    assert (rows.rows == 0.25).all()
    assert (rows.row_sum == 1).all()
    assert rows.contribution is None
    # The camera is upright: the model's first patch is the last one of the raw picture, which shows the background.
    assert record.coverage["base"].tolist() == [[0, 1], [1, 0]]
    assert record.frames == {}
    assert record.actions.shape == (4, 7)


@pytest.mark.parametrize(
    ("segmentation", "numbers"),
    [
        (np.zeros((2, 4), dtype=np.int32), r"\(2, 4\) .*int32; .* \(4, 2\)"),
        (np.full((4, 2), 2, dtype=np.int32), "2 to 2; .*2 objects, 0 to 1"),
    ],
)
def test_a_segmentation_that_does_not_fit_its_picture_is_refused(monkeypatch, segmentation, numbers) -> None:
    environment = FakeEnvironment()
    environment.segmentation = lambda camera: segmentation
    with pytest.raises(BadArgument, match=numbers) as caught:
        run_episode(monkeypatch, environment, FakeStore(), index=2)
    assert [
        name
        for name in ("replan 0", "step 10", "task003_episode002", "runs/made_up.zarr", "'agentview'")
        if name not in str(caught.value)
    ] == []


def test_the_check_is_made_before_every_step(monkeypatch) -> None:
    environment = FakeEnvironment()

    def stop_after_twelve_steps() -> None:
        if len(environment.actions) == 12:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_episode(monkeypatch, environment, FakeStore(), check=stop_after_twelve_steps)
    assert len(environment.actions) == 12


@pytest.mark.parametrize(("replan_steps", "max_steps", "numbers"), [(5, 8, "1 to 4"), (4, 0, " 1")])
def test_a_policy_must_be_able_to_follow_the_protocol(replan_steps: int, max_steps: int, numbers: str) -> None:
    protocol = Protocol(
        suite="made_up",
        seed=7,
        wait_steps=10,
        replan_steps=replan_steps,
        max_steps=max_steps,
        name="openpi",
        image_size=4,
    )
    with pytest.raises(BadArgument, match=numbers):
        check_protocol(protocol, FakePolicy())


def test_the_largest_number_of_replans() -> None:
    protocol = Protocol(
        suite="made_up", seed=7, wait_steps=10, replan_steps=5, max_steps=520, name="openpi", image_size=256
    )
    assert max_replans(protocol) == 104
