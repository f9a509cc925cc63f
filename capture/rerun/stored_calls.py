"""The policy calls of a stored episode: what each was given, its noise, what it gave; and making them again."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from vla_attention.capture.interventions.changed_inputs import CallContext, changed_inputs
from vla_attention.capture.interventions.run_changes import RunChanges
from vla_attention.capture.policies.policy import GivenInputs, Policy, PolicyInput
from vla_attention.capture.engine.call import RecordedCall, record_call
from vla_attention.capture.store.replan_records import RecordedSteps
from vla_attention.schemas.episode_steps import EXECUTED, GRIPPER, POSES
from vla_attention.schemas.errors import listing
from vla_attention.schemas.interventions import Interventions
from vla_attention.schemas.stores.reader import Store, StoredEpisode
from vla_attention.schemas.stores.store_format import EpisodeAttributes, Recording, StoreError


class StoreWithoutInputs(StoreError):
    """A store that lacks what the policy calls were given."""


@dataclass(frozen=True)
class StoredCalls:
    """The policy calls of one episode. Pictures are read call by call: black ones take little disk and much memory.

    coverage: camera -> (replan, patch, object).
    state: (replan, state dim). noise_seed, env_step, prompt_index: (replan,). actions: (replan, horizon, action dim).
    """

    episode: StoredEpisode
    coverage: Mapping[str, NDArray[np.float32]]
    state: NDArray[np.float64]
    noise_seed: NDArray[np.int64]
    env_step: NDArray[np.int32]
    prompt_index: NDArray[np.int32]
    actions: NDArray[np.float64]
    #: (replan, horizon, action dim) and (replan,): a data set's own actions, and how many there are; None for none.
    dataset_actions: tuple[NDArray[np.float64], NDArray[np.int64]] | None = None

    @property
    def attributes(self) -> EpisodeAttributes:
        """The episode's attributes."""
        return self.episode.attributes

    @property
    def num_replans(self) -> int:
        """Number of policy calls."""
        return self.attributes.num_replans

    def given(self, replan: int) -> GivenInputs:
        """Return what a policy call was given; `CorruptEpisode` when a picture is not the one that was sealed."""
        prompt = self.attributes.prompts[self.prompt_index[replan]]
        return GivenInputs(
            frames=self._pictures("frames", replan),
            camera_frames=self._pictures("camera_frames", replan),
            state=self.state[replan],
            instruction=prompt.instruction_text,
        )

    def _pictures(self, group: str, replan: int) -> dict[str, NDArray[np.uint8]]:
        """Camera -> (height, width, 3)."""
        return {camera: self.episode.read(f"{group}/{camera}", replan) for camera in _cameras(self.episode, group)}

    def context(self, replan: int, instructions: Mapping[int, str]) -> CallContext:
        """Return the place of a policy call and its scene. instructions: of the store's tasks."""
        return CallContext(
            task_id=self.attributes.task_id,
            episode_index=self.attributes.episode_index,
            replan=replan,
            instructions=instructions,
            objects=self.attributes.objects,
            coverage=self.coverage_of(replan),
        )

    def dataset_actions_of(self, replan: int) -> NDArray[np.float64] | None:
        """Return the actions (step, action dim) that the data set has from a replan on; None for none."""
        if self.dataset_actions is None:
            return None
        actions, counts = self.dataset_actions
        return actions[replan, : int(counts[replan])]

    @property
    def steps(self) -> RecordedSteps | None:
        """What the simulator told of every step; None where nobody told it. Read when asked for."""
        steps, read = self.attributes.steps, self.episode.read
        return None if steps is None else RecordedSteps(steps, read(POSES), read(GRIPPER), read(EXECUTED))

    def coverage_of(self, replan: int) -> dict[str, NDArray[np.float32]]:
        """Return how much of each patch each object covers, camera -> (patch, object)."""
        return {camera: coverage[replan] for camera, coverage in self.coverage.items()}


def read_calls(episode: StoredEpisode) -> StoredCalls:
    """Read all but the pictures of an episode's calls; `CorruptEpisode` when bytes are not those that were sealed."""
    return StoredCalls(
        episode=episode,
        coverage={camera: episode.read(f"objects/{camera}") for camera in _cameras(episode, "objects")},
        state=episode.read("state"),
        noise_seed=episode.read("noise_seed"),
        env_step=episode.read("env_step"),
        prompt_index=episode.read("prompt_index"),
        actions=episode.read("actions"),
        dataset_actions=(episode.read("dataset_actions"), episode.read("dataset_action_count"))
        if episode.has("dataset_actions")
        else None,
    )


def _cameras(episode: StoredEpisode, group: str) -> list[str]:
    """The cameras that a group of arrays has."""
    return [name.removeprefix(f"{group}/") for name in episode.attributes.arrays if name.startswith(f"{group}/")]


def check_has_inputs(store: Store, policy: Policy) -> None:
    """Raise `StoreWithoutInputs` unless every episode has the pictures that the policy's input is made of."""
    # A picture that an intervention changed is the model's picture, to the bit.
    changed = {change.camera for change in store.attributes.interventions.images}
    for episode in store.episodes:
        arrays = episode.attributes.arrays
        unknown = [name for name in ("state", "noise_seed", "actions") if not episode.has(name)]
        if unknown:
            raise StoreWithoutInputs(
                f"Cannot rerun {store.path}: episode {episode.name} does not hold {listing(unknown)} of its policy "
                "calls, which a rerun needs to make them again."
            )
        missing = [camera.name for camera in policy.cameras if f"frames/{camera.name}" not in arrays]
        if missing:
            raise StoreWithoutInputs(
                f"Cannot rerun {store.path}: episode {episode.name} has no pictures of {listing(missing)}, which the "
                "policy needs; capture without --no-frames, or use the store that was copied with all parts."
            )
        if not policy.needs_camera_frames:
            continue
        inexact = [
            camera.name
            for camera in policy.cameras
            if camera.name not in changed and f"camera_frames/{camera.name}" not in arrays
        ]
        if inexact:
            raise StoreWithoutInputs(
                f"Cannot rerun {store.path}: this policy resizes pictures in floating point, and episode "
                f"{episode.name} has only the rounded ones of {listing(inexact)}; stores that were captured with this "
                "version also hold the cameras' own pictures."
            )


@dataclass(frozen=True)
class Repeater:
    """Makes stored policy calls again.

    interventions: what is changed, with block indices for layers. instructions: of the store's tasks, by task id.
    allow_empty: leave calls unchanged in which a group has no key, or an object is out of view.
    """

    policy: Policy
    recording: Recording
    interventions: Interventions = field(default_factory=Interventions)
    instructions: Mapping[int, str] = field(default_factory=dict)
    allow_empty: bool = False

    @cached_property
    def attention(self) -> RunChanges:
        """The changes of attention; it counts the calls without any."""
        return RunChanges(self.interventions, self.instructions, self.allow_empty)

    def prepare(self, calls: StoredCalls, replan: int) -> PolicyInput:
        """Return the model's input of a call."""
        given, policy = calls.given(replan), self.policy
        if self.interventions.changes_input:
            context = calls.context(replan, self.instructions)
            given = changed_inputs(given, self.interventions, policy.sites, context, allow_empty=self.allow_empty)
        return policy.prepare_again(given)

    def noise_seed(self, calls: StoredCalls, replan: int) -> int:
        """Return the seed of a call's noise."""
        noise, attributes = self.interventions.noise, calls.attributes
        if noise is None:
            return int(calls.noise_seed[replan])
        return self.policy.replan_noise_seed(noise.seed, attributes.task_id, attributes.episode_index, replan)

    def call(self, calls: StoredCalls, replan: int, policy_input: PolicyInput) -> RecordedCall:
        """Call the policy."""
        context = calls.context(replan, self.instructions)
        editors = self.attention.editors(self.policy.sites, policy_input, context)
        where = f"replan {replan} (environment step {calls.env_step[replan]}) of the rerun of {calls.episode.name}"
        return record_call(self.policy, policy_input, self.noise_seed(calls, replan), self.recording, where, editors)
