"""Where LIBERO's objects stand at the first policy call, under one MuJoCo and another, in all stored initial states.

    export OMP_NUM_THREADS=1 ASSETS=FOLDER                        of LIBERO's assets; nothing is drawn
    python -m benchmarks.validation.libero_physics measure DIR    with the installed MuJoCo
    make .mujoco/3.8.1
    PYTHONPATH=.mujoco/3.8.1 python -m benchmarks.validation.libero_physics measure DIR
    python -m benchmarks.validation.libero_physics tell DIR       into the page and the package

`measure` goes on where it was ended; a task takes half a minute, and `SUITE:TASK,...` names some. `tell` writes the
table of `docs/validation.md`, its rows beside this file, and `capture/environments/libero_beginnings.npz`, with which
captures compare; a task that DIR has not under both versions stays as it was.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.validation.tables import fill_marks, markdown
from vla_attention.capture.environments.base import EnvironmentSettings, Task
from vla_attention.capture.environments.episode_protocol import OPENPI, WAIT_ACTION, WAIT_STEPS
from vla_attention.capture.environments.libero import LiberoEnvironment, parent_of_region, read_task_file, task_file
from vla_attention.capture.environments.libero_beginnings import ELSEWHERE_M, FILE, PARTS
from vla_attention.capture.environments.suites import SUITES, find_suite, list_tasks
from vla_attention.schemas.command_line import run_command
from vla_attention.schemas.libero_physics import PUBLISHED_MUJOCO

PAGE, ROWS = Path("docs/validation.md"), Path(__file__).with_suffix(".json")
#: The newest MuJoCo that hf-libero allows; objects come to rest as under it from 3.4 on.
OTHER_MUJOCO = "3.8.1"


class Undrawn(LiberoEnvironment):
    """A LIBERO environment without cameras. Its physics is the same to the bit."""

    def _simulator_options(self) -> dict[str, Any]:
        return super()._simulator_options() | {"use_camera_obs": False, "has_offscreen_renderer": False}

    def _reset_once(self, can_draw: bool = True) -> None:
        super()._reset_once(can_draw=False)

    def relations(self) -> list[tuple[str, ...]]:
        """What the task file says of the beginning that is of an object and another, or furniture; no tables."""
        movable, furniture = self._simulator.objects_dict, self._simulator.fixtures_dict
        things = [*movable, *(name for name in furniture if "table" not in name and name != "floor")]
        said = map(tuple, read_task_file(task_file(self.task))["initial_state"])
        return [one for one in said if len(one) == 3 and one[1] in movable and parent_of_region(one[2], things)]

    def holds(self, relation: Sequence[str]) -> bool:
        """Whether LIBERO's own predicate holds now."""
        return bool(self._simulator._eval_predicate(list(relation)))


def measure(task: Task, assets: Path, folder: Path, seed: int, num_states: int) -> None:
    """Write what holds, and where objects stand, after the waiting steps of every state; nothing where it is known."""
    path = folder / f"{task.suite}_{task.task_id}.npz"
    if path.exists():
        return
    environment = Undrawn(task, EnvironmentSettings(OPENPI, assets), [task])
    movable = [environment.bodies.index(name) for name in environment._simulator.objects_dict]
    relations = environment.relations()
    places, holds = [], []
    for state in range(num_states):
        environment.reset(state, seed)
        for _ in range(WAIT_STEPS):
            environment.step(np.array(WAIT_ACTION), observe=False)
        places.append(environment.moment().poses[movable, :3])
        holds.append([environment.holds(one) for one in relations])
    folder.mkdir(parents=True, exist_ok=True)
    partial = path.with_suffix(".partial.npz")
    np.savez_compressed(
        partial,
        places=np.array(places),
        holds=np.array(holds, dtype=bool).reshape(num_states, -1),
        relations=np.array([" ".join(one) for one in relations], dtype=str),
        objects=np.array([environment.bodies[number] for number in movable]),
    )
    partial.rename(path)
    environment.close()
    print(task.suite, task.task_id, flush=True)


def chosen(words: Sequence[str]) -> Iterator[Task]:
    """The tasks of `SUITE` or `SUITE:TASK,TASK`; without any those of the five standard suites."""
    for word in words or [suite.name for suite in SUITES if suite.kind == "libero" and not suite.perturbs]:
        name, _, numbers = word.partition(":")
        suite = find_suite(name)
        wanted = set(map(int, numbers.split(","))) if numbers else set(range(suite.num_tasks))
        yield from (task for task in list_tasks(suite) if task.task_id in wanted)


def row_of(task: Task, one: Any, other: Any) -> dict[str, Any]:
    """What differs in a task between two files of `measure`."""
    moved = np.linalg.norm(one["places"] - other["places"], axis=2)  # (state, object)
    farthest = np.median(moved, axis=0)
    relations = {
        "{1} {0} {2}".format(*words.split()): [
            int(one["holds"][:, i].sum()),
            int((one["holds"] & other["holds"])[:, i].sum()),
        ]
        for i, words in enumerate(one["relations"].tolist())
    }
    return {
        "suite": task.suite,
        "task": task.task_id,
        "states": len(moved),
        "states_elsewhere": int((moved > ELSEWHERE_M).any(axis=1).sum()),
        "objects_elsewhere_cm": {
            str(name): round(100 * float(distance), 1)
            for name, distance in zip(one["objects"], farthest, strict=True)
            if distance > ELSEWHERE_M
        },
        "relations": relations,
    }


def tables(rows: Sequence[dict[str, Any]]) -> str:
    """A row a suite, and a row for each task with an object elsewhere in most states, or a relation that is lost."""
    by_suite = []
    for suite in dict.fromkeys(row["suite"] for row in rows):
        own = [row for row in rows if row["suite"] == suite]
        elsewhere = [row for row in own if row["states_elsewhere"]]
        counts = [f"{sum(row[name] for row in own)}" for name in ("states_elsewhere", "states")]
        by_suite.append((suite, f"{len(elsewhere)} of {len(own)}", " of ".join(counts)))
    told = []
    for row in rows:
        lost = [
            f"{text}: {held} states, {left} of them" for text, (held, left) in row["relations"].items() if left < held
        ]
        moved = [f"{name} {distance:.1f} cm" for name, distance in row["objects_elsewhere_cm"].items()]
        if lost or moved:
            told.append(
                (
                    f"{row['suite']} {row['task']}",
                    f"{row['states_elsewhere']} of {row['states']}",
                    ", ".join(moved) or "-",
                    "; ".join(lost) or "-",
                )
            )
    far = f"{100 * ELSEWHERE_M:.0f} cm"
    return "\n\n".join(
        [
            markdown(("suite", f"tasks with an object more than {far} elsewhere", "states"), by_suite),
            markdown(
                (
                    "task",
                    "states",
                    "elsewhere by (median)",
                    f"what its file says: so with {PUBLISHED_MUJOCO}, still so with {OTHER_MUJOCO}",
                ),
                told,
            ),
        ]
    )


def tell(work: Path) -> None:
    """Write rows, page, and what the published evaluations begin with; tasks that are not in DIR stay as they are."""
    known = {(row["suite"], row["task"]): row for row in json.loads(ROWS.read_text(encoding="utf-8"))}
    with np.load(FILE) as before:
        kept = dict(before)
    rows = []
    for suite in SUITES:
        for task in list_tasks(suite) if suite.kind == "libero" else ():
            name = f"{suite.name}_{task.task_id}"
            one, other = (work / version / f"{name}.npz" for version in (PUBLISHED_MUJOCO, OTHER_MUJOCO))
            if one.exists() and other.exists():
                mine = dict(np.load(one))
                kept |= {f"{name}/{part}": mine[part] for part in PARTS}
                kept[f"{name}/places"] = np.round(1000 * mine["places"]).astype(np.int16)
                rows.append(row_of(task, mine, dict(np.load(other))))
            elif row := known.get((suite.name, task.task_id)):
                rows.append(row)
    np.savez_compressed(FILE, **kept)  # type: ignore[arg-type]  # numpy's own has a keyword that is no array
    ROWS.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    fill_marks(PAGE, {"libero physics": tables(rows)})


def _run() -> int:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.validation.libero_physics",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("what", choices=["measure", "tell"])
    parser.add_argument("work", type=Path, metavar="DIR")
    parser.add_argument("tasks", nargs="*", metavar="SUITE[:TASK,...]")
    parser.add_argument("--assets", type=Path, default=os.environ.get("ASSETS"))
    parser.add_argument("--seed", type=int, default=OPENPI.default_seed)
    parser.add_argument("--states", type=int, default=50)
    given = parser.parse_args()
    if given.what == "tell":
        tell(given.work)
        return 0
    import mujoco

    for task in chosen(given.tasks):
        measure(task, given.assets, given.work / mujoco.__version__, given.seed, given.states)
    return 0


if __name__ == "__main__":
    raise SystemExit(run_command("benchmarks.validation.libero_physics", _run, "what is in DIR is kept; run again."))
