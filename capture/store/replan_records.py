"""What a store is given of a replan and of an episode. Needs numpy only: stores can be written without torch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vla_attention.schemas.effects import CHANGE, CUT, MAP, PATCH_CHANGE, EffectItem, EffectMap
from vla_attention.schemas.episode_steps import EXECUTED, GRIPPER, POSES, EpisodeSteps
from vla_attention.schemas.groupings.vocabulary import SceneObject
from vla_attention.schemas.interventions import Interventions
from vla_attention.schemas.layout import Part, Prompt
from vla_attention.schemas.plumbing import Plumbing

#: The axes of chunks of actions.
CHUNK_AXES = ("replan", "horizon", "action_dim")


@dataclass(frozen=True)
class RecordedRows:
    """The rows of one site at one replan.

    rows: (layer, denoise, head, query, key) float32, the axes in the order of the plan.
    row_sum: (layer, denoise, head, query) float32, summed over keys in float64 from the rows as computed.
    contribution: (layer, denoise, part, part) float32, or None when contributions are not recorded. Entry (i, j) is the
        inner product of what parts i and j of the keys add to the residual stream, averaged over the action queries;
        the last part is the block's whole attention update.
    uniform: what uniform attention gives in the place of each row, (layer, denoise, head, query, key) float32, see
        `schemas/groupings/key_counts.py`; an axis along which nothing changes may have length 1. None: every query sees
        every key whose role is none of `UNSEEN_ROLES`.
    """

    rows: NDArray[np.float32]
    row_sum: NDArray[np.float32]
    contribution: NDArray[np.float32] | None = None
    uniform: NDArray[np.float32] | None = None

    @classmethod
    def summed(
        cls,
        rows: NDArray[np.float32],
        contribution: NDArray[np.float32] | None = None,
        uniform: NDArray[np.float32] | None = None,
    ) -> RecordedRows:
        """Return recorded rows with their sums."""
        return cls(rows, rows.sum(axis=-1, dtype=np.float64).astype(np.float32), contribution, uniform)


@dataclass(frozen=True)
class ReplanMap:
    """Which patches move the actions of one replan, see `EffectMap`.

    form: what is the same at all replans of an episode; it is of none yet. sizes: (block,) float32. patches: the blocks
    of `change` (entry, horizon, action dim) float32, in the units of the effects. drawn: which of them were drawn at
    random.
    """

    form: EffectMap
    sizes: NDArray[np.float32]
    patches: tuple[int, ...]
    drawn: tuple[bool, ...]
    change: NDArray[np.float32]


@dataclass(frozen=True)
class ReplanEffects:
    """The effects of one replan.

    conditions, items: of the episode, the same at all its replans. units: see `EpisodeEffects`. measured: the numbers
    of the conditions that were measured, ascending. change: (measured, horizon, action dim) float32, actions under the
    condition minus actions, in `units`. cut: site -> (measured, key) float32, the weights of the keys that were cut.
    silent_blocks: see `EpisodeEffects`. map: None where none was made.
    """

    conditions: tuple[Interventions, ...]
    items: tuple[EffectItem, ...]
    units: tuple[float, ...]
    measured: tuple[int, ...]
    change: NDArray[np.float32]
    cut: Mapping[str, NDArray[np.float32]]
    silent_blocks: tuple[str, ...] = ()
    map: ReplanMap | None = None


@dataclass(frozen=True)
class ReplanRecord:
    """Everything stored about one replan.

    `rows` and `key_role` are per site. `state` is (state_dim,), `actions` (horizon, action_dim) as given to the
    environment, `frames` and `camera_frames` per policy camera (row, column, channel) uint8, `coverage` per policy
    camera (patch, object) float32. `dataset_actions` (steps, action_dim) are those that a data set has from this replan
    on, fewer at the end of its episode. `base_actions` (horizon, action_dim) are those that the base has for this call,
    in a rerun. What is None is not known; all replans of an episode know the same. `constant_cameras`: cameras of the
    simulator whose picture is of one colour. `effects`: None where they are not measured at this replan. `plumbing`: of
    the first call of a process. `shown`: camera -> the part of its frame that shows its picture, where that is not all.
    """

    env_step: int
    noise_seed: int | None
    rows: Mapping[str, RecordedRows]
    key_role: Mapping[str, NDArray[np.uint8]]
    prompt: Prompt
    state: NDArray[np.float64] | None
    actions: NDArray[np.float64] | None
    frames: Mapping[str, NDArray[np.uint8]] = field(default_factory=dict)
    camera_frames: Mapping[str, NDArray[np.uint8]] = field(default_factory=dict)
    coverage: Mapping[str, NDArray[np.float32]] = field(default_factory=dict)
    dataset_actions: NDArray[np.float64] | None = None
    base_actions: NDArray[np.float64] | None = None
    constant_cameras: frozenset[str] = frozenset()
    effects: ReplanEffects | None = None
    plumbing: Plumbing | None = None
    shown: Mapping[str, Part] = field(default_factory=dict)

    @property
    def arrays(self) -> dict[str, tuple[NDArray[Any], tuple[str, ...]]]:
        """Path in the episode -> values and names of their axes, the first of length 1; all but rows and roles.

        Those of effects have an entry for each condition that was measured.
        """
        chunk, pixels = CHUNK_AXES, ("replan", "row", "column", "channel")
        given: list[tuple[str, NDArray[Any] | None, tuple[str, ...]]] = [
            ("state", self.state, ("replan", "state_dim")),
            ("actions", self.actions, chunk),
            ("base_actions", self.base_actions, chunk),
            ("dataset_actions", self.dataset_actions, chunk),
            *((f"frames/{camera}", values, pixels) for camera, values in self.frames.items()),
            *((f"camera_frames/{camera}", values, pixels) for camera, values in self.camera_frames.items()),
            *((f"objects/{camera}", values, ("replan", "patch", "object")) for camera, values in self.coverage.items()),
        ]
        arrays = {name: (values[None], axes) for name, values, axes in given if values is not None}
        if self.effects is not None and self.effects.measured:
            arrays[CHANGE] = (self.effects.change, ("entry", "horizon", "action_dim"))
            arrays |= {f"{site}/{CUT}": (cut, ("entry", "key")) for site, cut in self.effects.cut.items()}
        if self.effects is not None and (map_of := self.effects.map) is not None:
            arrays[MAP] = (map_of.sizes[None], ("map_row", "block"))
            arrays[PATCH_CHANGE] = (map_of.change, ("map_entry", "horizon", "action_dim"))
        return arrays


@dataclass(frozen=True)
class RecordedSteps:
    """What a simulator told of every step of an episode.

    attributes: what the store says of the arrays. poses: (moment, body, 7), gripper: (moment, finger), actions: (step,
    action_dim), all float32.
    """

    attributes: EpisodeSteps
    poses: NDArray[np.float32]
    gripper: NDArray[np.float32]
    actions: NDArray[np.float32]

    @property
    def arrays(self) -> dict[str, tuple[NDArray[np.float32], tuple[str, ...]]]:
        """Path in the episode -> values and the names of their axes."""
        return {
            POSES: (self.poses, ("moment", "body", "pose")),
            GRIPPER: (self.gripper, ("moment", "finger")),
            EXECUTED: (self.actions, ("step", "action_dim")),
        }


@dataclass(frozen=True)
class EpisodeStart:
    """The fields of `EpisodeAttributes` that are known before the first replan."""

    task_id: int
    task_name: str
    instruction: str
    episode_index: int
    initial_state_index: int
    initial_state_digest: str
    objects: tuple[SceneObject, ...]
    provenance: dict[str, str]
    task_family: str = ""
    scene_task_id: int | None = None
