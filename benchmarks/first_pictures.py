"""What a suite looks like at the first policy call, from every stored initial state: a LeRobotDataset v3.0.

    OMP_NUM_THREADS=1 python -m benchmarks.first_pictures SUITE FOLDER [--states 50]

An episode is one initial state of one task, and has one frame: the pictures and the state that a capture with openpi's
protocol gets after its waiting steps. The pictures are upright, and left is left; a capture's are 256 pixels wide, and
here they are made smaller. There is no action. Episodes are in the order of tasks, then of states; `meta/episodes`
names both. Tasks of one sentence are one task here, as in every LeRobotDataset.

Each task is one file, and the data set is whole after each, so a run may be stopped. A task whose scene cannot be
simulated is named and left out. LIBERO's suites take the assets that `find_assets` finds.
"""

from __future__ import annotations

import argparse
import io
import json
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray
from PIL import Image

from vla_attention.capture.engine.simulation import Simulation
from vla_attention.capture.environments.base import EnvironmentSettings, Observation, Suite, Task, camera_frame
from vla_attention.capture.environments.episode_protocol import CAMERAS, CONTROL_FREQUENCY_HZ, OPENPI, WAIT_STEPS
from vla_attention.capture.environments.suites import check_installed, find_suite, list_tasks, make_environment
from vla_attention.capture.policies.pi.preprocess import libero_state, resize_with_pad
from vla_attention.schemas.command_line import run_command
from vla_attention.schemas.errors import BadArgument, UserError
from vla_attention.schemas.progress_bar import progress_bar
from vla_attention.schemas.stores.store_format import Protocol

#: Height and width of the pictures, in pixels.
SIZE = 128
#: Column -> camera of the simulator.
COLUMNS = dict(zip(("observation.images.agentview", "observation.images.wrist"), CAMERAS, strict=True))
STATE = ("x", "y", "z", "axis_angle_x", "axis_angle_y", "axis_angle_z", "finger_left", "finger_right")
INDICES = ("frame_index", "episode_index", "index", "task_index")
DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
SCHEMA: dict[str, Any] = {
    **dict.fromkeys(COLUMNS, pl.Struct({"bytes": pl.Binary, "path": pl.String})),
    "observation.state": pl.Array(pl.Float32, len(STATE)),
    "timestamp": pl.Float32,
    **dict.fromkeys(INDICES, pl.Int64),
}


def first_observations(suite: Suite, task: Task, num_states: int) -> Iterator[Observation]:
    """Give what the first policy call of each episode gets, in the order of the initial states."""
    protocol = Protocol(
        name=OPENPI.name,
        suite=suite.name,
        seed=OPENPI.default_seed,
        wait_steps=WAIT_STEPS,
        replan_steps=OPENPI.replan_steps or 1,
        max_steps=suite.max_steps,
        image_size=OPENPI.image_size,
    )
    environment = make_environment(suite, task.task_id, EnvironmentSettings(OPENPI))
    try:
        simulation = Simulation(environment, protocol, cameras=())
        for state in range(num_states):
            simulation.begin(state, f"state {state} of task {task.task_id} of {suite.name}")
            seen = simulation.wait().seen
            assert seen is not None  # the last waiting step is observed
            yield seen.observation
    finally:
        environment.close()


def shown(picture: NDArray[np.uint8]) -> bytes:
    """Return a camera's picture as a person sees the scene, in the size of the data set, as PNG."""
    buffer = io.BytesIO()
    Image.fromarray(resize_with_pad(np.ascontiguousarray(picture[::-1]), SIZE)).save(buffer, "PNG")
    return buffer.getvalue()


def row_of(observation: Observation, episode: int, sentence: int) -> dict[str, Any]:
    """Return the one row of an episode."""
    pictures = {
        column: {"bytes": shown(camera_frame(observation, camera)), "path": "frame-000000.png"}
        for column, camera in COLUMNS.items()
    }
    state = libero_state(observation.eef_pos, observation.eef_quat, observation.gripper_qpos)
    numbers = dict(zip(INDICES, (0, episode, episode, sentence), strict=True))
    return {**pictures, "observation.state": state.tolist(), "timestamp": 0.0, **numbers}


def write_meta(folder: Path, sentences: Sequence[str], episodes: Sequence[dict[str, Any]]) -> None:
    """Write what the data set says of its columns, tasks and episodes so far."""
    picture = {"dtype": "image", "shape": [SIZE, SIZE, 3], "names": ["height", "width", "channels"]}
    features = {
        **dict.fromkeys(COLUMNS, picture),
        "observation.state": {"dtype": "float32", "shape": [len(STATE)], "names": {"motors": STATE}},
        "timestamp": {"dtype": "float32", "shape": [1], "names": None},
        **{name: {"dtype": "int64", "shape": [1], "names": None} for name in INDICES},
    }
    info = {
        "codebase_version": "v3.0",
        "robot_type": "panda",
        "total_episodes": len(episodes),
        "total_frames": len(episodes),
        "total_tasks": len(sentences),
        "chunks_size": 1000,
        "fps": CONTROL_FREQUENCY_HZ,
        "splits": {"train": f"0:{len(episodes)}"},
        "data_path": DATA_PATH,
        "video_path": None,
        "features": features,
    }
    places = folder / "meta" / "episodes" / "chunk-000" / "file-000.parquet"
    places.parent.mkdir(parents=True, exist_ok=True)
    pl.DataFrame(episodes).write_parquet(places)
    # pandas writes the table of tasks with the tasks as its index.
    tasks = pl.DataFrame({"task_index": range(len(sentences)), "__index_level_0__": sentences})
    tasks.write_parquet(folder / "meta" / "tasks.parquet")
    (folder / "meta" / "info.json").write_text(json.dumps(info, indent=4) + "\n", encoding="utf-8")


def write_suite(suite: Suite, folder: Path, num_states: int, advance: Callable[[int], object]) -> int:
    """Write the data set, a file for each task, and return the number of its episodes."""
    sentences: list[str] = []
    episodes: list[dict[str, Any]] = []
    for file, task in enumerate(list_tasks(suite)):
        # The sentence of a task that fails stays in the table: a row more, which no frame names.
        sentences += [task.instruction] if task.instruction not in sentences else []
        sentence, first, rows = sentences.index(task.instruction), len(episodes), list[dict[str, Any]]()
        try:
            for observation in first_observations(suite, task, min(num_states, task.num_initial_states)):
                rows.append(row_of(observation, first + len(rows), sentence))
                advance(1)
        except UserError as error:
            print(f"Task {task.task_id} ends after {len(rows)} states: {error}", file=sys.stderr, flush=True)
        if not rows:
            continue
        path = folder / DATA_PATH.format(chunk_index=0, file_index=file)
        path.parent.mkdir(parents=True, exist_ok=True)
        pl.DataFrame(rows, schema=SCHEMA).write_parquet(path)
        places = {"data/chunk_index": 0, "data/file_index": file}
        places |= {"meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0}
        for state in range(len(rows)):
            of_state = {"suite_task": task.task_id, "initial_state": state}
            at = {"episode_index": first + state, "tasks": [task.instruction], "length": 1}
            at |= {"dataset_from_index": first + state, "dataset_to_index": first + state + 1}
            episodes.append({**at, **of_state, **places})
        write_meta(folder, sentences, episodes)
    return len(episodes)


def _run() -> int:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.first_pictures",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("suite", metavar="SUITE")
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="of the data set; must not exist")
    parser.add_argument("--states", type=int, default=50, metavar="N", help="initial states of each task (default: 50)")
    given = parser.parse_args()
    suite = find_suite(given.suite)
    if given.states < 1:
        raise BadArgument(f"--states is {given.states}; it must be at least 1.")
    if given.folder.exists():
        raise BadArgument(f"'{given.folder}' exists; give a new folder.")
    check_installed(suite, None)
    began = time.perf_counter()
    total = suite.num_tasks * min(given.states, suite.initial_states_per_task)
    with progress_bar(total, "states") as advance:
        written = write_suite(suite, given.folder, given.states, advance)
    print(f"{suite.name}: {written} of {total} episodes in {time.perf_counter() - began:.0f} s", flush=True)
    return 0 if written == total else 1


if __name__ == "__main__":
    raise SystemExit(run_command("benchmarks.first_pictures", _run, "the tasks that are done make a data set."))
