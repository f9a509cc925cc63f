"""How far other actions are from those of a run, in units that a person sees. Pure functions on arrays.

An action has dimensions of several kinds, and a change of it is measured in several parts. Where the run's own steps
say how its commands move the hand (`hand_and_gripper`): centimetres between where the hand would end, degrees between
how it would be turned, and steps in which the gripper's command flips. Else in groups of dimensions that the user
names, in the policy's own normalised actions, or, where nobody knows these, in the spread of the run.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from msgspec import structs
from numpy.typing import NDArray

from vla_attention.analyze.core.estimate import Scale
from vla_attention.analyze.core.hand_movements import TRANSLATION, Commands, commands_of, fitted
from vla_attention.analyze.core.result import Column
from vla_attention.analyze.measures.selected import SelectedEpisode
from vla_attention.analyze.stores.selection import read_usable
from vla_attention.schemas.episode_steps import EXECUTED, POSES
from vla_attention.schemas.errors import BadArgument, listing
from vla_attention.schemas.interventions import Interventions
from vla_attention.schemas.stores.reader import Store, StoredEpisode
from vla_attention.schemas.stores.store_format import CALLERS_MODULES

Array = NDArray[np.float64]

#: Position of the gripper command in an action: above 0 it closes, below 0 it opens, 0 leaves it as it is. Every suite
#: of the capture side drives robosuite's Panda gripper.
GRIPPER = -1
#: A dimension with less spread than this part of the largest one is not driven by the policy. Division by its spread
#: would make what is left of it, rounding or noise of the denoising, as large as a real movement.
LEAST_SPREAD = 0.01
#: Centimetres and degrees are told where commands explain at least these parts of the movements of held-out episodes.
#: Arms turn little in most tasks, and what contacts and the controller add weighs more there.
_LEAST_EXPLAINED, _LEAST_TURNS = 0.8, 0.5
#: Smaller changes are rounding, in any unit: in float32 calls made again without a change stay below it, in bfloat16
#: they reach .02 to .05.
ROUNDING = 1e-3
#: The arrays that units are found from.
_REFERENCES = ("actions", "dataset_actions", POSES, EXECUTED)
#: The first part of all, by which items are ranked and tested: its column in every table.
EFFECT = "effect"


@dataclass(frozen=True)
class Part:
    """One thing that a change of actions is measured by.

    Attributes:
        name: its column; that of the first part is `EFFECT`.
        title: of columns and axes, with its unit.
        said: how a sentence has it, with {} for the number: "the hand ends {} cm elsewhere".
        dimensions: those of the action that it is of, (dimension,) whole numbers.
        scale: (dimension,) what a command of 1 is in the unit.
        unit: what stands behind the number, where it is short.
        how: "end" is the length of the summed change over the executed steps; "mean" the root mean square change over
            executed steps and dimensions; "opposite" the share of the executed steps with the other sign.
    """

    name: str
    title: str
    said: str
    dimensions: NDArray[np.intp]
    scale: Array
    how: Literal["end", "mean", "opposite"] = "mean"
    unit: str = ""

    def of(self, base: Array, other: Array, steps: NDArray[np.int64]) -> Array:
        """The change (replan,) from actions (replan, step, dimension) to others, over the first `steps` (replan,)."""
        one, two = base[..., self.dimensions], other[..., self.dimensions]
        counts = counted(steps, base.shape[1])
        if self.how == "opposite":
            flipped: Array = ((one * two < 0).any(axis=2) & counts).sum(axis=1) / steps
            return flipped
        change = (two - one) * self.scale * counts[..., None]
        if self.how == "end":
            return np.asarray(np.linalg.norm(change.sum(axis=1), axis=1))
        return np.asarray(np.sqrt((change**2).mean(axis=2).sum(axis=1) / steps))


@dataclass(frozen=True)
class ActionUnits:
    """What changes of a run's actions are measured by; `parts` are at least one. notes: where units come from."""

    parts: tuple[Part, ...]
    notes: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """The columns of the parts."""
        return tuple(part.name for part in self.parts)

    @property
    def title(self) -> str:
        """Title of the first part."""
        return self.parts[0].title

    def said(self, number: str) -> str:
        """The first part with a number, as in a sentence."""
        return self.parts[0].said.format(number)

    def short(self, value: float) -> str:
        """A value of the first part, with its unit where that is short: "0.79 cm"."""
        return f"{value:.2g} {self.parts[0].unit}".rstrip()

    def size(self, value: float, text: str = "") -> str:
        """The first part with a value, which is rounding below `ROUNDING`; text: the value, with an interval for it."""
        return self.said(text if text and value >= ROUNDING else small_size(value))

    @property
    def further_columns(self) -> list[Column]:
        """Columns of the parts behind the first."""
        return [
            Column(one.name, "percent" if one.how == "opposite" else "number", one.title, one.said.format("so many"))
            for one in self.parts[1:]
        ]

    @property
    def scales(self) -> dict[str, Scale]:
        """How the mean of each part is taken over episodes."""
        return {part.name: "share" if part.how == "opposite" else "positive" for part in self.parts}

    @property
    def centimetres(self) -> float | None:
        """How far a command of 1 moves the hand in a step; None where that is not known."""
        part = self.parts[0]
        return float(part.scale[0]) if part.how == "end" else None

    def changes(self, base: BaseEpisode, actions: Array) -> Array:
        """The change of every replan to other actions (replan, step, dimension), (replan, part)."""
        return np.stack([part.of(base.actions, actions, base.executed) for part in self.parts], axis=1)

    def chunk_change(self, base: BaseEpisode, actions: Array) -> Array:
        """The change (replan,) of the first part over whole chunks, whatever of them was executed."""
        return self.parts[0].of(base.actions, actions, np.full(len(actions), actions.shape[1]))


def small_size(value: float) -> str:
    """A value, which is rounding below `ROUNDING`."""
    return f"{value:.2g}" if value >= ROUNDING else f"less than {ROUNDING:g}"


def units_of(stores: Sequence[Store], units: Sequence[str] = (), skip_corrupt: bool = False) -> ActionUnits:
    """What changes of the stores' actions are measured by: over all of their episodes, whichever are selected.

    units: groups of dimensions as the user names them, see `parse_units`. skip_corrupt: damaged episodes are left out.

    Raises:
        BadArgument: an episode holds no actions, they are the same everywhere, or the units do not fit them.
        CorruptEpisode: an episode is damaged.
    """
    actions, commands, scales = [], [], []
    for store, episode, arrays in readable_episodes(stores, skip_corrupt):
        # Where it holds none, this says so.
        actions.append(arrays["actions"] if "actions" in arrays else actions_of(store, episode))
        commands += [one] if (one := commands_of(episode, arrays)) is not None else []
        scales += [np.array(of.units)] if (of := episode.attributes.effects) is not None else []
    size = actions[0].shape[-1] if actions else 0
    if units:
        return ActionUnits(tuple(parse_units(units, size)))
    ours = not any(store.attributes.protocol.of_other_loop for store in stores)
    if ours and (found := hand_and_gripper(commands)) is not None:
        return found
    policy, data_set = stores[0].attributes.policy, stores[0].attributes.data_set
    if policy.checkpoint_format != CALLERS_MODULES and scales:
        scale = 1 / np.where(scales[0] == 0, 1.0, scales[0])
        names = () if data_set is None or len(data_set.action_names) != size else data_set.action_names
        return ActionUnits(tuple(parts_of_names(names, scale))) if names else _normalised(scale, ours)
    spread = action_spread(actions)
    if not spread.used.any():
        raise BadArgument(
            f"In {stores[0].path} the actions are the same in every call and step, so a change has no unit; ask a "
            "store of a robot that moves."
        )
    return in_spread(spread)


def readable_episodes(
    stores: Sequence[Store], skip_corrupt: bool
) -> Iterator[tuple[Store, StoredEpisode, Mapping[str, Array]]]:
    """`read_usable` of the arrays of `_REFERENCES`."""

    def references(episode: StoredEpisode) -> Mapping[str, Array]:
        return {name: episode.read(name).astype(np.float64) for name in _REFERENCES if episode.has(name)}

    return read_usable(stores, skip_corrupt, references)


def _normalised(scale: Array, ours: bool) -> ActionUnits:
    """In the policy's own normalised actions; the gripper of our simulators is apart."""
    said = "the action changes by {} in the policy's normalised units"
    every = np.arange(len(scale))
    arm = every[:GRIPPER] if ours else every
    parts = [Part(EFFECT, "change (normalised)", said, arm, scale[arm])]
    return ActionUnits((*parts, *([_gripper(len(scale))] if ours else [])))


def parts_of_names(names: Sequence[str], scale: Array) -> Iterator[Part]:
    """Arms and grippers, left and right where the dimensions' names say so, in the policy's normalised actions."""
    groups: dict[str, list[int]] = {}
    for number, name in enumerate(names):
        words = re.split(r"[^a-z]+", name.casefold())
        side = next((f"{word}_" for word in words if word in ("left", "right")), "")
        what = "gripper" if any("gripper" in word for word in words) else "arm"
        groups.setdefault(side + what, []).append(number)
    for i, (name, members) in enumerate(groups.items()):
        column, said = f"change_{name}" if i else EFFECT, f"the {name.replace('_', ' ')} changes by {{}} (normalised)"
        dimensions = np.array(members)
        yield Part(column, f"{name.replace('_', ' ')} (normalised)", said, dimensions, scale[dimensions])


def in_spread(spread: ActionSpread) -> ActionUnits:
    """In standard deviations of a run's actions, over the dimensions that are used."""
    said = "the action changes by {} standard deviations of the run's actions"
    used = np.flatnonzero(spread.used)
    left = [f"{i}" for i in spread.left_out]
    out = [f"Dimensions of the action that hardly vary are not compared: {listing(left, 20)}."] if left else []
    note = "A run with larger movements has larger standard deviations; --units NAME=DIMENSIONS:UNIT has the robot's."
    return ActionUnits((Part(EFFECT, "change (SD)", said, used, 1 / spread.spread[used]),), (note, *out))


def _gripper(size: int) -> Part:
    said = "the gripper command flips in {} of the steps"
    return Part("gripper", "gripper", said, np.array([size - 1]), np.ones(1), "opposite")


def hand_and_gripper(commands: Sequence[Commands]) -> ActionUnits | None:
    """Centimetres, degrees and gripper, of the episodes of a run; None where commands do not tell how the hand moves.

    Degrees are left out where turns are not explained.
    """
    if not commands:
        return None
    moves = fitted([(one.told, one.moved) for one in commands])
    if moves is None or moves.explained < _LEAST_EXPLAINED:
        return None
    said = "the hand ends {} cm elsewhere"
    parts = [Part(EFFECT, "hand elsewhere (cm)", said, np.arange(3), np.full(3, 100 * moves.factor), "end", "cm")]
    note = (
        f"A command of 1 for a step moves the hand by {100 * moves.factor:.2f} ± {100 * moves.error:.2f} cm, which "
        f"explains {moves.explained:.0%} of the movements of held-out episodes"
    )
    turns = fitted([(one.told_turn, one.turned) for one in commands])
    if turns is not None and turns.explained >= _LEAST_TURNS:
        degrees = np.degrees(turns.factor)
        parts.append(
            Part(
                "turn",
                "turn (degrees)",
                "the hand is turned by {} degrees",
                np.arange(3, 6),
                np.full(3, degrees),
                "end",
            )
        )
        note += f"; it turns it by {degrees:.1f} ± {np.degrees(turns.error):.1f} degrees ({turns.explained:.0%})"
    return ActionUnits((*parts, _gripper(7)), (f"{note}.",))


def parse_units(texts: Sequence[str], size: int) -> Iterator[Part]:
    """Groups of dimensions as `--units` names them: NAME=FIRST-LAST[,...][:UNIT], of actions with `size` dimensions.

    Raises:
        BadArgument: what is written is no such group, names no dimension of the actions, or has a name twice.
    """
    names: list[str] = []
    for text in texts:
        name, is_group, rest = text.partition("=")
        numbers, _, unit = rest.partition(":")
        ends = [part.split("-") for part in numbers.split(",")]
        known = all(end.isdecimal() and len(end) < 6 for part in ends for end in part) and max(map(len, ends)) < 3
        if not (is_group and name.isidentifier() and name not in names and known):
            raise BadArgument(
                f"Cannot use --units '{text}'; expected NAME=DIMENSIONS:UNIT with a new name, as arm=0-5:rad or "
                "gripper=6."
            )
        dimensions = [number for part in ends for number in range(int(part[0]), int(part[-1]) + 1)]
        if not dimensions or max(dimensions) >= size:
            raise BadArgument(f"--units '{text}' names a dimension that the actions lack; they have 0 to {size - 1}.")
        names.append(name)
        said = f"{name} changes by {{}}{f' {unit}' if unit else ''}"
        column = f"change_{name}" if len(names) > 1 else EFFECT
        yield Part(column, f"{name} ({unit})" if unit else name, said, np.array(dimensions), np.ones(len(dimensions)))


@dataclass(frozen=True)
class ActionSpread:
    """How far actions differ from each other: units of last resort.

    Attributes:
        spread: (dimension,) standard deviation over all replans and all steps of their chunks.
        used: (dimension,) bool, the dimensions that vary.
    """

    spread: Array
    used: NDArray[np.bool_]

    @property
    def left_out(self) -> tuple[int, ...]:
        """The dimensions that are not compared."""
        return tuple(int(i) for i in np.flatnonzero(~self.used))


def action_spread(actions: Sequence[Array]) -> ActionSpread:
    """The spread of a run's actions, each (replan, step, dimension); steps may differ in number.

    A dimension without spread (see `LEAST_SPREAD`) is not compared.
    """
    flat = np.concatenate([chunk.reshape(-1, chunk.shape[-1]) for chunk in actions])
    spread = flat.std(axis=0)
    return ActionSpread(spread, spread > LEAST_SPREAD * spread.max(initial=0.0))


def changes_noise_alone(interventions: Interventions) -> bool:
    """Whether another noise seed is all that was changed."""
    return interventions.noise is not None and structs.replace(interventions, name="", noise=None).is_none


def actions_of(store: Store, episode: StoredEpisode) -> Array:
    """The actions of an episode, (replan, step, dimension).

    Raises:
        BadArgument: it holds none.
    """
    if not episode.has("actions"):
        raise BadArgument(
            f"{episode.name} of {store.path} holds no actions, and an effect is a change of the actions; record the "
            "run with its actions."
        )
    return np.asarray(episode.read("actions"), np.float64)


@dataclass(frozen=True)
class BaseEpisode:
    """The actions of an episode that others are compared with.

    Attributes:
        item: the episode.
        actions: (replan, step, dimension).
        env_step: (replan,).
        starts: (replan,) policy steps before each replan.
        executed: (replan,) how many steps of each chunk were executed; all of them where that is not known.
        num_steps: policy steps of the episode.
    """

    item: SelectedEpisode
    actions: Array
    env_step: NDArray[np.int64]
    starts: NDArray[np.int64]
    executed: NDArray[np.int64]
    num_steps: int

    @classmethod
    def of(cls, item: SelectedEpisode) -> BaseEpisode:
        """Read an episode's actions."""
        actions = actions_of(item.store, item.episode)
        env_step = item.episode.read("env_step").astype(np.int64)
        starts, num_steps = item.timing(env_step)
        executed = np.full(len(starts), actions.shape[1])
        protocol = item.store.attributes.protocol
        # Of the caller's own loop it is not known where it gave no number, and a replayed data set executes none: there
        # `replan_steps` is the number of frames from one policy call to the next.
        if protocol.name != "dataset" and protocol.replan_steps > 0:
            until_next = np.diff(np.append(starts, num_steps))
            executed = np.minimum(executed, np.minimum(until_next, protocol.replan_steps))
        return cls(item, actions, env_step, starts, executed, num_steps)

    def at(self, replans: NDArray[np.int64]) -> BaseEpisode:
        """The same at some replans, which may repeat."""
        parts = {name: getattr(self, name)[replans] for name in ("actions", "env_step", "starts", "executed")}
        return replace(self, **parts)


def first_angle(base: Array, other: Array) -> Array:
    """Angle in degrees (replan,) between the translations of the first actions; NaN where one of them is zero."""
    with np.errstate(divide="ignore", invalid="ignore"):
        first, second = (
            part / np.linalg.norm(part, axis=1, keepdims=True)
            for part in (base[:, 0, TRANSLATION], other[:, 0, TRANSLATION])
        )
    # Kahan's formula: exact for small angles, where the arc cosine loses half of the digits.
    angle: Array = np.degrees(
        2 * np.arctan2(np.linalg.norm(first - second, axis=1), np.linalg.norm(first + second, axis=1))
    )
    return angle


def counted(steps: NDArray[np.int64], horizon: int) -> NDArray[np.bool_]:
    """Which steps count, (replan, horizon) bool: the first `steps` (replan,) of each chunk."""
    return np.arange(horizon)[None, :] < steps[:, None]
