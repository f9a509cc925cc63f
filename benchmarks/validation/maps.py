"""Whether a map of patches tells what moves the action, held against truths: the second part of docs/validation.md.

    python -m benchmarks.validation.maps POLICIES --work DIR --page docs/validation.md
    python -m benchmarks.validation.maps POLICIES --work DIR --reduced      two tasks and few calls: about a minute

POLICIES and DIR are those of `python -m benchmarks.validation`, whose rollouts are used where they are there. What is
in DIR already is not made again. Four maps of the patches of both cameras are made of a stored policy call: exact
knock-outs of every patch, the first order of `--effects map`, the attention of the action queries, and random blurred
masks, as one reads ISS (arXiv 2605.00321): each patch is blurred in the picture with `CHANCE`, and its score is the
mean change of the action with masks that blur it minus that of the others; scores below 0 count as 0.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.single_patches import sizes, without
from benchmarks.validation.__main__ import read_arguments, say
from benchmarks.validation.changes import BASE_CAMERA, NEXT_COLOUR, WRIST_CAMERA, known_changes
from benchmarks.validation.map_calls import MAPS, Call, Measured
from benchmarks.validation.map_tables import map_blocks
from benchmarks.validation.policies import SHIPPED, KnownPolicy, load_policy, read_policies, record, success
from benchmarks.validation.ranks import spearman
from benchmarks.validation.tables import fill_marks
from vla_attention.capture.environments.cubes.environment import MARK
from vla_attention.capture.environments.cubes.tasks import CUBE_TASKS, MARK_ONLY, MARKED, NAMED_COLOURS, NUM_BASE_TASKS
from vla_attention.capture.interventions.changed_inputs import changed_inputs
from vla_attention.schemas.command_line import run_command
from vla_attention.schemas.stores.reader import Store

Array = NDArray[np.float64]
#: The results that the page shows.
ROWS = Path(__file__).with_suffix(".json")
#: The parts of the patches that are hidden, or shown alone.
LEVELS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.4)
#: Other noise seeds of a call, and random orders.
SEEDS, ORDERS = 4, 3
#: A cube's patches are those that it covers by more than this; in many scenes it covers none by half.
LARGELY = 0.25
TOP = 0.1
#: What is recorded of rollouts for exact maps alone.
_LIGHT = ("--layers", "0", "--heads", "0", "--denoise", "last", "--no-contributions")


@dataclass(frozen=True)
class Suite:
    """Tasks under a change. moved: the columns of patches by which the agent picture is moved to the right."""

    title: str
    suite: str
    tasks: tuple[int, ...]
    episodes: int = 1
    options: tuple[str, ...] = ()
    moved: int = 0


_BASE, _YELLOW = tuple(range(NUM_BASE_TASKS)), tuple(i for i, t in enumerate(CUBE_TASKS) if t.num_cubes > 3)
_PUT_ON = tuple(i for i, task in enumerate(CUBE_TASKS) if task.verb == "put_on")
#: Where NMR is held against success, of the shipped policy.
CONDITIONS = (
    Suite("`cubes`, tasks 0 to 11", "cubes", _BASE),
    Suite("*lift* beside a yellow cube", "cubes", _YELLOW, 4),
    Suite("`cubes_harder`: put one cube on another", "cubes_harder", _PUT_ON, 2),
    Suite("agent picture moved by one patch", "cubes", _BASE, 1, ("--image", f"{BASE_CAMERA}=shifted:0,1"), 1),
    Suite("agent picture grey", "cubes", _BASE, 1, ("--image", f"{BASE_CAMERA}=blank")),
    Suite("an empty prompt", "cubes", _BASE, 1, ("--prompt", "empty")),
    Suite("agent picture moved by two patches", "cubes", _BASE, 1, ("--image", f"{BASE_CAMERA}=shifted:0,2"), 2),
    Suite("robot taken out of the wrist picture", "cubes", _BASE, 1, ("--image", f"{WRIST_CAMERA}=filled:robot")),
)


class Values:
    """Numbers by name and task; a task's is the mean over its calls."""

    def __init__(self) -> None:
        self._of: dict[str, dict[int, list[float]]] = {}

    def add(self, task: int, **numbers: float) -> None:
        """Add those of a call; what is not a number is left out."""
        for name, number in numbers.items():
            if np.isfinite(number):
                self._of.setdefault(name, {}).setdefault(task, []).append(float(number))

    def plain(self) -> dict[str, list[float]]:
        """Name -> (task,)."""
        return {name: [round(float(np.mean(one)), 5) for one in of.values()] for name, of in self._of.items()}


def on(values: Array, *covers: Array) -> float:
    """The mean of a map on the patches that one of some things covers by more than `LARGELY`; NaN where none is."""
    chosen = np.max(covers, axis=0) > LARGELY
    return float(values[chosen].mean()) if chosen.any() else np.nan


def share(one: float, other: float) -> float:
    """One of two as a part of both."""
    return one / (one + other) if one + other else np.nan


def covered(call: Call) -> Array:
    """The part of each patch (patch,) that the named cubes and the robot cover."""
    found: Array = np.clip(np.sum([call.covers[name] for name in [*call.named, "robot"]], axis=0), 0.0, 1.0)
    return found


def nuisance(values: Array, call: Call) -> float:
    """NMR@10 (`analyze.core.patch_maps`): the part of the top tenth on neither the named cubes nor the robot."""
    chosen = np.argsort(-values, kind="stable")[: round(TOP * len(values))]
    return 1.0 - float((values * covered(call))[chosen].sum() / values[chosen].sum())


def on_mark(one: Array, call: Call, name: str, when: str = "") -> dict[str, float]:
    """The mark's part of a map, and whether the strongest patch is its, or one of the strongest tenth."""
    mark, order = call.covers[MARK] > 0, np.argsort(-one, kind="stable")
    found = {f"mark{when} {name}": one[mark].sum() / one.sum(), f"top{when} {name}": float(mark[order[0]])}
    return found | {f"tenth{when} {name}": float(mark[order[: round(TOP * len(one))]].any())}


def against_truths(measured: Measured, store: Store, replans: int) -> dict[str, list[float]]:
    """What the maps show of the mark, the wrist camera and the named cube, beside how far the action moves."""
    values = Values()
    for call in measured.calls(store, replans):
        task, known = call.context.task_id, known_changes(call.episode)
        truths = {"noise": measured.variant(call.given, call.seed + 1)}
        for name in known.keys() & {"wrist_blank", "mark_filled", "prompt_other_colour"}:
            given = changed_inputs(call.given, known[name], measured.policy.sites, call.context)
            truths[name] = measured.variant(given, call.seed)
        if MARK in call.covers:
            next_mark = measured.told_otherwise(call, NEXT_COLOUR[CUBE_TASKS[task].target], "mark")
            truths["other_mark"] = measured.variant(next_mark, call.seed)
        values.add(task, **dict(zip(truths, measured.changes(call, list(truths.values())), strict=True)))
        values.add(task, **{"nmr area": 1.0 - covered(call).mean()})
        for name, signed in measured.maps(call.given, call.seed).items():
            one = np.clip(signed, 0.0, None)
            named, other = (on(one, *(call.covers[cube] for cube in cubes)) for cubes in (call.named, call.others))
            values.add(task, **{f"wrist {name}": one[measured.wrist].sum() / one.sum()})
            values.add(task, **{f"named {name}": share(named, other), f"nmr {name}": nuisance(one, call)})
            if MARK in call.covers:
                values.add(task, **{"mark area": (call.covers[MARK] > 0).mean()}, **on_mark(one, call, name))
    return values.plain()


def told_otherwise(measured: Measured, store: Store, by: str) -> dict[str, list[float]]:
    """The same scene at the first policy call, told each colour: a cube's map when it is named, and when not.

    Numbers of each scene: of every map the part `share(named, not named)`, mean over the cubes, and how far the action
    moves when another is named.
    """
    values = Values()
    for call in measured.calls(store, 1):
        scene = call.context.episode_index
        told = {str(colour): measured.told_otherwise(call, colour, by) for colour in NAMED_COLOURS}
        maps = {colour: measured.maps(given, call.seed) for colour, given in told.items()}
        for colour, other in NEXT_COLOUR.items():
            base, moved = (measured.variant(told[each], call.seed) for each in (colour, other))
            values.add(scene, **{f"{by} moves": sizes(measured.policy, base, [moved], measured.steps)[0]})
            for name in MAPS:
                of = {each: on(np.clip(maps[each][name], 0.0, None), call.covers[f"{colour}_cube"]) for each in told}
                not_named = [of[each] for each in of if each != colour]
                values.add(scene, **{f"{by} told {name}": share(of[colour], float(np.mean(not_named)))})
                if by == "mark":
                    values.add(scene, **on_mark(np.clip(maps[colour][name], 0.0, None), call, name, " first"))
    return values.plain()


def curves(measured: Measured, store: Store, replans: int) -> dict[str, list[float]]:
    """How the action changes without the best patches of each map, or with them alone; and the maps of other seeds."""
    values, number = Values(), len(measured.patches)
    counts = [max(1, round(level * number)) for level in LEVELS]
    for call in measured.calls(store, replans):
        task, base = call.context.task_id, measured.variant(call.given, call.seed).policy_input
        maps = measured.maps(call.given, call.seed)
        seeds = [measured.maps(call.given, call.seed + k, k) for k in range(1, SEEDS + 1)]
        for name, one in maps.items():
            mean = np.mean([other[name] for other in seeds], axis=0)
            values.add(task, **{f"exact {name}": spearman(one, maps["exact"]), f"mean {name}": spearman(one, mean)})
            values.add(task, **{f"seed {name}": spearman(one, seeds[0][name])})
        generator = np.random.default_rng(call.seed)
        orders = [(name, np.argsort(-one, kind="stable")) for name, one in maps.items()]
        orders += [("random", generator.permutation(number)) for _ in range(ORDERS)]
        for name, order in orders:
            best = np.array([np.isin(np.arange(number), order[:count]) for count in counts])
            for way, hidden in {"deletion": best, "insertion": ~best}.items():
                keys = [without(measured.policy, base, call.seed, measured.patches[one]) for one in hidden]
                pixels = [measured.variant(measured.blurred(call.given, one), call.seed) for one in hidden]
                for how, variants in {"tokens": keys, "pixels": pixels}.items():
                    found = measured.changes(call, variants)
                    values.add(task, **{f"{way} {how} {name}": float(found.mean())})
                    values.add(task, **{f"{way} {how} {name} {i}": size for i, size in enumerate(found)})
    return values.plain()


def in_suite(measured: Measured, store: Store, replans: int, moved: int) -> dict[str, list[float]]:
    """NMR@10 of exact maps, and the pictures' part, by task: `nmr`, `area`; by episode: `episodes` and `solved`."""
    values, episodes = Values(), Values()
    for call in measured.calls(store, replans, moved):
        number = nuisance(measured.exact(call.given, call.seed), call)
        values.add(call.context.task_id, nmr=number, area=1.0 - covered(call).mean())
        place = 1000 * call.context.task_id + call.context.episode_index
        episodes.add(place, episodes=number, solved=float(bool(call.episode.attributes.success)))
    return values.plain() | episodes.plain()


@dataclass(frozen=True)
class Extent:
    """How much is measured. steps: of the rollouts in `cubes`; longest: those of the other suites."""

    tasks: tuple[int, ...] = _BASE
    replans: int = 2
    scenes: int = 12
    steps: int = 100
    longest: int = 150
    conditions: int = len(CONDITIONS)


def run(policies: list[KnownPolicy], work: Path, extent: Extent) -> dict[str, Any]:
    """Roll out and measure; returns the results, which are plain JSON."""
    results: dict[str, Any] = {"policies": [], "suites": [], "curves": {}, "levels": LEVELS}
    for policy in policies:
        folder = work / policy.name
        say(f"{policy.name}: rollouts in {policy.suite}")
        store = record(policy, folder / "base.zarr", list(extent.tasks), extent.steps)
        first = record(policy, folder / "first.zarr", [_LIFT], 5, "--num-episodes", str(extent.scenes), *_LIGHT)
        measured = Measured(load_policy(Path(str(store.path))), store.attributes.protocol.replan_steps)
        numbers = _kept(folder / "maps.json", store, partial(against_truths, measured, store, extent.replans))
        for by in ("sentence", "mark")[: 2 if policy.suite in (MARKED, MARK_ONLY) else 1]:
            numbers |= _kept(folder / f"{by}.json", first, partial(told_otherwise, measured, first, by))
        facts = {"name": policy.name, "control": policy.control, "seed": policy.seed, "suite": policy.suite}
        results["policies"].append(facts | success(store) | {"numbers": numbers})
        if policy.control == SHIPPED:
            make = partial(curves, measured, store, extent.replans)
            results["curves"] = _kept(folder / "curves.json", store, make)
            results["suites"] = list(_suites(policy, measured, folder, extent))
    return results


#: *Lift the red cube*, in whose scenes the others are named as well.
_LIFT = next(i for i, task in enumerate(CUBE_TASKS) if task.verb == "lift")


def _suites(policy: KnownPolicy, measured: Measured, folder: Path, extent: Extent) -> Iterator[dict[str, Any]]:
    """Rows of the `CONDITIONS`."""
    for number, one in enumerate(CONDITIONS[: extent.conditions]):
        say(f"{policy.name}: {one.title}")
        tasks = list(extent.tasks if one.tasks == _BASE else one.tasks[: len(extent.tasks)])
        place = folder / f"suite_{number}.zarr"
        options = ["--task-suite", one.suite, "--num-episodes", str(one.episodes), *_LIGHT, *one.options]
        store = record(policy, place, tasks, extent.longest, *options)
        make = partial(in_suite, measured, store, extent.replans, one.moved)
        yield {"title": one.title} | success(store) | {"numbers": _kept(place.with_suffix(".json"), store, make)}


def _kept(path: Path, store: Store, make: Callable[[], dict[str, list[float]]]) -> dict[str, list[float]]:
    """What is in the file, if it is of this run and these episodes; else it is made."""
    of = [store.run, *(episode.name for episode in store.episodes)]
    if path.exists() and (kept := json.loads(path.read_text(encoding="utf-8")))["of"] == of:
        numbers: dict[str, list[float]] = kept["numbers"]
        return numbers
    began, numbers = time.monotonic(), make()
    path.write_text(json.dumps({"of": of, "numbers": numbers}), encoding="utf-8")
    say(f"{path}: {time.monotonic() - began:.0f} s")
    return numbers


def main(argv: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    os.environ.setdefault("MUJOCO_GL", "egl")
    program = "benchmarks.validation.maps"
    return run_command(program, lambda: _run(argv), "what is in the folder of --work is kept; run again.")


def _run(argv: list[str] | None) -> int:
    given = read_arguments(argv, "benchmarks.validation.maps", __doc__)
    policies = [KnownPolicy(SHIPPED, "pi05_cubes", "cubes", SHIPPED), *read_policies(given.policies)]
    results = run(policies, given.work, Extent((0, 4), 1, 1, 10, 10, 1) if given.reduced else Extent())
    text = json.dumps(results, indent=1) + "\n"
    (given.work / "maps.json").write_text(text, encoding="utf-8")
    if given.page is not None:
        fill_marks(given.page, map_blocks(results))
        ROWS.write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
