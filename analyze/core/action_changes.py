"""How far other actions are from those of a run, in units that a person sees. Pure functions on arrays.

An action has dimensions of several kinds, and a change of it is measured in several parts. Where the run's own steps
say how its commands move the hand (`hand_and_gripper`): centimetres between where the hand would end, degrees between
how it would be turned, and steps in which the gripper is told the opposite. Else in groups of dimensions that the user
names, in the policy's own normalised actions, or, where nobody knows these, in the spread of the run.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from msgspec import structs
from numpy.typing import NDArray

from vla_attention.analyze.core.estimate import Scale
from vla_attention.analyze.core.result import Column
from vla_attention.analyze.measures.selected import SelectedEpisode
from vla_attention.schemas.episode_steps import EXECUTED, HAND, POSES
from vla_attention.schemas.errors import BadArgument, listing
from vla_attention.schemas.interventions import Interventions
from vla_attention.schemas.stores.reader import Store, StoredEpisode
from vla_attention.schemas.stores.store_format import CALLERS_MODULES, CorruptEpisode

Array = NDArray[np.float64]

#: The dimensions of an action that move and turn the hand, along the axes of the world and around them, and that of the
#: gripper: a command above 0 closes it, one below 0 opens it, 0 leaves it as it is. Every suite of the capture side
#: drives robosuite's Panda arm and gripper.
TRANSLATION, ROTATION, GRIPPER = slice(0, 3), slice(3, 6), -1
#: A dimension with less spread than this part of the largest one is not driven by the policy. Division by its spread
#: would make what is left of it, rounding or noise of the denoising, as large as a real movement.
LEAST_SPREAD = 0.01
#: Centimetres and degrees are told where commands explain at least these parts of the movements of left-out episodes.
#: Arms turn little in most tasks, and what contacts and the controller add weighs more there.
_LEAST_EXPLAINED, _LEAST_TURNS = 0.8, 0.5
#: Smaller changes are rounding, in any unit: in float32 calls made again without a change stay below it, in bfloat16
#: they reach .02 to .05.
ROUNDING = 1e-3
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
        how: "end" is the length of the summed change over the executed steps; "mean" the root mean square change over
            executed steps and dimensions; "opposite" the share of the executed steps with the other sign.
    """

    name: str
    title: str
    said: str
    dimensions: NDArray[np.intp]
    scale: Array
    how: Literal["end", "mean", "opposite"] = "mean"

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


@dataclass(frozen=True)
class Fit:
    """How commands move the hand: moved = factor x command, least squares through 0.

    factor: per unit of a command. error: its standard error, jackknife over episodes. explained: part of the squared
    movements of left-out episodes that the others' factor explains, at most 1.
    """

    factor: float
    error: float
    explained: float


def units_of(stores: Sequence[Store], units: Sequence[str] = (), skip_corrupt: bool = False) -> ActionUnits:
    """What changes of the stores' actions are measured by: over all of their episodes, whichever are selected.

    units: groups of dimensions as the user names them, see `parse_units`. skip_corrupt: damaged episodes are left out.

    Raises:
        BadArgument: an episode holds no actions, they are the same everywhere, or the units do not fit them.
        CorruptEpisode: an episode is damaged.
    """
    episodes = [*readable_episodes(stores, skip_corrupt)]
    actions = [actions_of(*one) for one in episodes]
    size = actions[0].shape[-1] if actions else 0
    if units:
        return ActionUnits(tuple(parse_units(units, size)))
    ours = not any(store.attributes.protocol.of_other_loop for store in stores)
    if ours and (found := hand_and_gripper(_commands(episodes))) is not None:
        return found
    policy, data_set = stores[0].attributes.policy, stores[0].attributes.data_set
    if policy.checkpoint_format != CALLERS_MODULES:
        scales = [np.array(of.units) for _, one in episodes if (of := one.attributes.effects) is not None]
        if scales:
            scale = 1 / np.where(scales[0] == 0, 1.0, scales[0])
            names = () if data_set is None or len(data_set.action_names) != size else data_set.action_names
            return ActionUnits(tuple(parts_of_names(names, scale))) if names else _normalised(scale, ours)
    spread = action_spread(actions)
    if not spread.used.any():
        raise BadArgument(
            f"In {stores[0].path} the actions are the same in every replan and step, so a change has no unit; ask a "
            "store of a robot that moves."
        )
    return _of_spread(spread)


def readable_episodes(stores: Sequence[Store], skip_corrupt: bool) -> Iterator[tuple[Store, StoredEpisode]]:
    """All episodes of stores with policy calls, whichever are selected; without the damaged ones if asked."""
    for store in stores:
        for episode in store.episodes:
            try:
                if not episode.attributes.num_replans:
                    continue
                for name in ("actions", "dataset_actions"):
                    if episode.has(name):
                        episode.read(name)
            except CorruptEpisode:
                if not skip_corrupt:
                    raise
                continue
            yield store, episode


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


def _of_spread(spread: ActionSpread) -> ActionUnits:
    said = "the action changes by {} standard deviations of the run's actions"
    used = np.flatnonzero(spread.used)
    left = [f"{i}" for i in spread.left_out]
    out = [f"Dimensions of the action that hardly vary are not compared: {listing(left, 20)}."] if left else []
    note = "A run with larger movements has larger standard deviations; --units NAME=DIMENSIONS:UNIT has the robot's."
    return ActionUnits((Part(EFFECT, "change (SD)", said, used, 1 / spread.spread[used]),), (note, *out))


def _gripper(size: int) -> Part:
    said = "the gripper is told the opposite in {} of the steps"
    return Part("gripper", "gripper", said, np.array([size - 1]), np.ones(1), "opposite")


@dataclass(frozen=True)
class Commands:
    """Of an episode, by replan: the executed commands summed up, and how the hand moved. Each (replan, 3).

    moved: metres. told: sum of the translations. turned: rotation vectors in radians, around the world's axes.
    told_turn: sum of the rotations.
    """

    moved: Array
    told: Array
    turned: Array
    told_turn: Array


def _commands(episodes: Sequence[tuple[Store, StoredEpisode]]) -> list[Commands]:
    found = []
    for _, episode in episodes:
        steps = episode.attributes.steps
        if steps is None or not (episode.has(POSES) and episode.has(EXECUTED)):
            continue
        executed, env_step = episode.read(EXECUTED).astype(np.float64), np.array(episode.attributes.env_step)
        starts = env_step - env_step[0]
        if executed.shape[1] != 7 or starts[-1] >= len(executed):
            continue
        hand = episode.read(POSES).astype(np.float64)[np.append(starts, len(executed)), steps.bodies.index(HAND)]
        sums = np.add.reduceat(executed, starts, axis=0)
        turned = rotation_vectors(hand[:, 3:])
        found.append(Commands(np.diff(hand[:, :3], axis=0), sums[:, TRANSLATION], turned, sums[:, ROTATION]))
    return found


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
    parts = [Part(EFFECT, "hand elsewhere (cm)", said, np.arange(3), np.full(3, 100 * moves.factor), "end")]
    note = (
        f"A command of 1 for a step moves the hand by {100 * moves.factor:.2f} ± {100 * moves.error:.2f} cm, which "
        f"explains {moves.explained:.0%} of the movements of left-out episodes"
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


def fitted(pairs: Sequence[tuple[Array, Array]]) -> Fit | None:
    """Fit what moved to what was told, each (replan, axis) by episode; None where nothing was told or moved.

    One episode is left out at a time; of a single episode one replan.
    """
    if len(pairs) == 1:
        pairs = [(told[None], moved[None]) for told, moved in zip(*pairs[0], strict=True)]
    sums = np.array([((told * moved).sum(), (told**2).sum(), (moved**2).sum()) for told, moved in pairs])
    both, told, moved = sums.sum(axis=0)
    others = sums.sum(axis=0) - sums
    if len(pairs) < 2 or told <= 0 or moved <= 0 or (others[:, 1] <= 0).any():
        return None
    factors = others[:, 0] / others[:, 1]
    left = (sums[:, 2] - 2 * factors * sums[:, 0] + factors**2 * sums[:, 1]).sum()
    n = len(pairs)
    error = np.sqrt((n - 1) / n * ((factors - factors.mean()) ** 2).sum())
    return Fit(float(both / told), float(error), float(1 - left / moved))


def rotation_vectors(quaternions: Array) -> Array:
    """From each orientation (moment, 4: w, x, y, z) to the next, axis x angle in radians, in the world (moment - 1, 3).

    Of unit quaternions, q_next x conjugate(q); the shorter way round.
    """
    w, v = quaternions[:, 0], quaternions[:, 1:]
    scalar = w[1:] * w[:-1] + (v[1:] * v[:-1]).sum(axis=1)
    vector = -w[1:, None] * v[:-1] + w[:-1, None] * v[1:] - np.cross(v[1:], v[:-1])
    vector = np.where(scalar[:, None] < 0, -vector, vector)
    length = np.linalg.norm(vector, axis=1)
    angle = 2 * np.arctan2(length, np.abs(scalar))
    with np.errstate(invalid="ignore", divide="ignore"):
        found: Array = np.where(length[:, None] > 0, vector / length[:, None], 0.0) * angle[:, None]
    return found


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
