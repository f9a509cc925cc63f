"""The policy calls of a stored episode: what each was given, its noise, what it gave; and the same calls once more."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vla_attention.capture.engine.call import Caller, PolicyCall
from vla_attention.capture.interventions.changed_inputs import CallContext
from vla_attention.capture.policies.policy import GivenInputs, Policy
from vla_attention.capture.store.replan_records import RecordedSteps
from vla_attention.schemas.episode_steps import EXECUTED, GRIPPER, POSES
from vla_attention.schemas.errors import listing
from vla_attention.schemas.stores.reader import Store, StoredEpisode
from vla_attention.schemas.stores.store_format import EpisodeAttributes, StoreError


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
            shown=self.attributes.shown,
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

    def again(self, caller: Caller, replan: int, *, keep_actions: bool = False) -> PolicyCall:
        """Return a policy call to be made again, with what the caller changes.

        keep_actions: store the stored actions beside the new ones, to know the base by them.
        """
        context = self.context(replan, caller.changes.instructions)
        stored_seed, env_step = int(self.noise_seed[replan]), int(self.env_step[replan])
        changes = caller.changes.interventions
        return PolicyCall(
            caller.prepared(self.given(replan), context),
            stored_seed if changes.noise is None else caller.drawn_seed(changes.noise.seed, context),
            context,
            env_step,
            f"replan {replan} (environment step {env_step}) of the rerun of {self.episode.name}",
            dataset_actions=self.dataset_actions_of(replan),
            base_actions=self.actions[replan] if keep_actions else None,
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
