"""`rates`: how often the episodes of a capture of cubes solved their tasks, and touched the named cube first.

They are made by `vla-attention capture pi --checkpoint FOLDER --task-suite cubes`; its `--image` and `--prompt` change
pictures or words.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterable
from pathlib import Path

from vla_attention.capture.environments.cubes.scene import find_target
from vla_attention.capture.environments.cubes.tasks import COLOURS, CUBE_TASKS
from vla_attention.schemas.episode_steps import HAND, POSES
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.stores.reader import StoredEpisode, open_store


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("store", type=Path, metavar="STORE", help="NAME.zarr of a capture in a suite of cubes")


def run(arguments: argparse.Namespace) -> int:
    """Print the rates; returns the exit code."""
    store = open_store(arguments.store)
    if not store.suite.startswith("cubes"):
        raise BadArgument(f"'{arguments.store}' is of the suite '{store.suite}'; expected one of cubes.")
    outcomes: dict[str, list[tuple[bool, bool]]] = {}
    for episode in store.episodes:
        outcome = (bool(episode.attributes.success), touched_named_first(episode))
        outcomes.setdefault(CUBE_TASKS[episode.attributes.task_id].name, []).append(outcome)
    if len(outcomes) > 1:
        outcomes["all"] = [outcome for task in outcomes.values() for outcome in task]
    print(f"{'task':<28}{'n':>5}  {'solved':<24}{'first touch named':<24}")
    for name, found in outcomes.items():
        print(f"{name:<28}{len(found):>5}  {_rate(one for one, _ in found):<24}{_rate(one for _, one in found):<24}")
    return 0


def touched_named_first(episode: StoredEpisode) -> bool:
    """Whether the first cube that the gripper touched is the named one; with another at one step, it is not."""
    steps = episode.attributes.steps
    if steps is None:
        raise BadArgument(f"StoredEpisode {episode.name} does not say what was touched; capture it with this version.")
    cubes = [f"{colour}_cube" for colour in COLOURS if f"{colour}_cube" in steps.bodies]
    places = episode.read(POSES)[0, [steps.bodies.index(cube) for cube in cubes], :2]
    named = cubes[find_target(CUBE_TASKS[episode.attributes.task_id].target, places)]
    moments = {body: moment for body, moment in zip(steps.bodies, steps.first_touch, strict=True) if moment is not None}
    others = [moment for body, moment in moments.items() if body not in (HAND, named)]
    return named in moments and moments[named] < min(others, default=math.inf)


def wilson_interval(successes: int, count: int) -> tuple[float, float]:
    """Return the 95 % interval of a rate (Wilson 1927)."""
    z = 1.959964
    rate, square = successes / count, z * z / count
    middle = (rate + square / 2) / (1 + square)
    half = z * math.sqrt(rate * (1 - rate) / count + square / (4 * count)) / (1 + square)
    return max(0.0, middle - half), min(1.0, middle + half)


def _rate(successes: Iterable[bool]) -> str:
    found = list(successes)
    low, high = wilson_interval(sum(found), len(found))
    return f"{sum(found) / len(found):.1%} [{low:.1%}, {high:.1%}]"
