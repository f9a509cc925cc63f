"""`demonstrate`: what the experts do in the suite `cubes`, seen through the cameras of a policy, in several processes.

The expert's clean action is the label at every state that is visited. What is executed has noise, bursts of noise and
often a detour before the first label, so that a policy learns to come back. Each part of the demonstrations depends on
the seed and its own number only: parts are made by any number of processes, and those that exist are kept.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from examples.cubes_policy.dataset import INDEX_FILE, new_folder
from examples.cubes_policy.experts import CLOSED, OPEN, expert_action, move_to, read_state
from vla_attention.capture.engine.simulation import Simulation
from vla_attention.capture.environments.base import EnvironmentSettings, Observation
from vla_attention.capture.environments.cubes.environment import CubesEnvironment
from vla_attention.capture.environments.cubes.scene import TRAINING
from vla_attention.capture.environments.cubes.tasks import COLOURS, CUBE_TASKS, NUM_BASE_TASKS, CubeTask
from vla_attention.capture.environments.episode_protocol import CAMERAS, OPENPI, WAIT_STEPS
from vla_attention.capture.environments.suites import find_suite, list_tasks
from vla_attention.capture.policies.pi.preprocess import libero_state, resize_with_pad, turn
from vla_attention.schemas.checked_files import read_object
from vla_attention.schemas.command_line import format_bytes
from vla_attention.schemas.errors import BadArgument, UserError
from vla_attention.schemas.stores.store_format import Protocol

#: Height and width of the pictures, in pixels, and length of the action chunks.
PICTURE_SIZE, HORIZON = 64, 10
_MOST_EPISODES = 10**9


class NoDemonstration(UserError):
    """A part in which the expert solved no episode."""


@dataclass(frozen=True)
class DemonstrationSettings:
    """How demonstrations are made.

    episodes_per_part: episodes of one file. picture_every: steps between two samples. steps_after: labelled steps
    after success, and steps after which an episode counts as failed. noise: standard deviation of the noise of each
    pose delta, in units of the largest action. burst_*: share of episodes with bursts, their chance per step, their
    length in steps and their deviation. detour_*: share of episodes that begin with a detour, and its length in steps.
    four_cubes: share of scenes with the fourth cube, for instructions that name one cube. by_place, put_on: shares of
    episodes whose task names a place, or puts one cube on another.
    """

    seed: int = 0
    episodes_per_part: int = 20
    picture_every: int = 3
    steps_after: int = HORIZON
    max_steps: int = 170
    noise: float = 0.08
    burst_episodes: float = 0.8
    burst_chance: float = 0.06
    burst_steps: tuple[int, int] = (3, 8)
    burst_noise: float = 0.5
    detour_episodes: float = 0.6
    detour_steps: tuple[int, int] = (3, 21)
    four_cubes: float = 0.25
    by_place: float = 0.12
    put_on: float = 0.20


#: One sample, and all of a part: arrays by name, those of a part with a first axis (sample,).
Sample = dict[str, NDArray[Any]]
Arrays = dict[str, NDArray[Any]]


def part_path(folder: Path, part: int) -> Path:
    """Return the file of a part."""
    return folder / f"part_{part:04d}.npz"


class Demonstrator:
    """Makes demonstrations in two simulators: with three and with four cubes."""

    def __init__(self, settings: DemonstrationSettings) -> None:
        self.settings = settings
        #: as in a capture of `cubes`, but for the numbers that are given
        self._protocol = Protocol(
            name=OPENPI.name,
            suite="cubes_harder",
            seed=settings.seed,
            wait_steps=WAIT_STEPS,
            replan_steps=settings.picture_every,
            max_steps=settings.max_steps,
            image_size=OPENPI.image_size,
        )
        tasks = list_tasks(find_suite(self._protocol.suite))  # all tasks
        numbers = {task.num_cubes: number for number, task in enumerate(CUBE_TASKS)}
        self._environments = {
            cubes: CubesEnvironment(
                replace(tasks[number], num_initial_states=_MOST_EPISODES), EnvironmentSettings(), purpose=TRAINING
            )
            for cubes, number in sorted(numbers.items())
        }

    def close(self) -> None:
        """Free the simulators."""
        for environment in self._environments.values():
            environment.close()

    def episodes(self, part: int) -> Iterator[list[Sample]]:
        """Give the samples of each episode of a part; a failed one has none."""
        first = part * self.settings.episodes_per_part
        for episode in range(first, first + self.settings.episodes_per_part):
            yield list(self._episode(episode))

    def _draw_task(self, generator: np.random.Generator) -> tuple[int, CubeTask]:
        """Return the number of a task in the suite, whose instruction is given, and the task of the simulator."""
        settings = self.settings
        kind = generator.random()
        if kind < settings.put_on:
            pool = [n for n, task in enumerate(CUBE_TASKS) if task.verb == "put_on"]
        elif kind < settings.put_on + settings.by_place:
            pool = [n for n, task in enumerate(CUBE_TASKS) if task.target not in COLOURS]
        else:
            pool = list(range(NUM_BASE_TASKS))
        number = int(generator.choice(pool))
        task = CUBE_TASKS[number]
        if number < NUM_BASE_TASKS and generator.random() < settings.four_cubes:
            task = CubeTask(task.verb, task.target, num_cubes=len(COLOURS))
        return number, task

    def _episode(self, episode: int) -> Iterator[Sample]:
        settings = self.settings
        generator = np.random.default_rng([settings.seed, episode])
        number, task = self._draw_task(generator)
        environment = self._environments[task.num_cubes]
        environment.give_task(task)
        simulation = Simulation(environment, self._protocol, cameras=())
        simulation.begin(episode, f"episode {episode} of task {task.name}")
        waited = simulation.wait()
        noise = _Noise(settings, generator)
        detour = int(generator.integers(*settings.detour_steps, endpoint=True))
        detour = detour if generator.random() < settings.detour_episodes else 0
        phase = int(generator.integers(settings.picture_every))
        seen = waited.seen if phase == 0 and not detour else None
        table = environment.simulator
        aim = self._detour_aim(generator, table)
        for step in range(detour):
            action = noise.add(move_to(read_state(table), aim[:3], aim[3]))
            seen = simulation.advance(action[None], observe=step == detour - 1 and phase == 0).seen
        samples: list[Sample] = []
        clean: list[NDArray[np.float64]] = []
        end: int | None = None
        for step in range(settings.max_steps):
            action = expert_action(task.verb, read_state(table), table.target, table.destination)
            clean.append(action)
            if seen is not None and end is None:
                samples.append(_describe(environment, seen.observation, number, episode, step))
            observe = (step + 1) % settings.picture_every == phase and end is None
            result = simulation.advance(noise.add(action)[None], observe)
            seen = result.seen
            # Noise may have led to another cube before: a demonstration of a touch ends at the right cube all the same.
            done = table.target in table.touched_cubes() if task.verb == "touch" else result.success
            if done and end is None:
                end = step
            if end is not None and step - end >= settings.steps_after:
                break
        else:
            return
        for sample in samples:
            begin = int(sample["step"])
            sample["actions"] = np.array(clean[begin : begin + HORIZON], dtype=np.float32)
            yield sample

    def _detour_aim(self, generator: np.random.Generator, simulator: Any) -> NDArray[np.float64]:
        """Return a place (3,) over the table or near a cube, and whether the gripper is open or closed on the way."""
        if generator.random() < 0.5:
            place = generator.choice(simulator.cube_positions())
            place[2] += generator.uniform(0.03, 0.15)
        else:
            place = np.array([*generator.uniform([-0.15, -0.25], [0.15, 0.25]), generator.uniform(0.86, 1.05)])
        return np.array([*place, OPEN if generator.random() < 0.5 else CLOSED])


class _Noise:
    """Noise of executed actions: small at every step, and large with one direction during a burst."""

    def __init__(self, settings: DemonstrationSettings, generator: np.random.Generator) -> None:
        self._settings, self._generator = settings, generator
        self._bursts = generator.random() < settings.burst_episodes
        self._left = 0
        self._push = np.zeros(3)

    def add(self, action: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the action (7,) that is executed; noise is on the six pose deltas, a burst on the translation."""
        settings, generator = self._settings, self._generator
        if self._left == 0 and self._bursts and generator.random() < settings.burst_chance:
            self._left = int(generator.integers(*settings.burst_steps, endpoint=True))
            self._push = generator.normal(0.0, settings.burst_noise, 3)
        noisy = action.copy()
        noisy[:6] += generator.normal(0.0, settings.noise, 6) * [1.0, 1.0, 1.0, 0.3, 0.3, 0.3]
        if self._left:
            self._left -= 1
            noisy[:3] += self._push
        return np.clip(noisy, -1.0, 1.0)


def join_episodes(part: int, episodes: Sequence[list[Sample]], settings: DemonstrationSettings) -> Arrays:
    """Return the samples of a part as arrays; raises `NoDemonstration` if all of its episodes failed."""
    samples = [sample for episode in episodes for sample in episode]
    if not samples:
        raise NoDemonstration(
            f"Part {part} has no demonstration: the expert solved none of its {settings.episodes_per_part} "
            f"episodes with the seed {settings.seed}; give another --seed and another folder."
        )
    return {name: np.stack([sample[name] for sample in samples]) for name in samples[0]}


def _describe(environment: CubesEnvironment, observation: Observation, task: int, episode: int, step: int) -> Sample:
    simulator = environment.simulator
    cubes = np.full((len(COLOURS), 3), np.nan, dtype=np.float32)
    positions = simulator.cube_positions()
    cubes[: len(positions)] = positions
    destination = -1 if simulator.destination is None else simulator.destination
    return {
        "pictures": np.stack([resize_with_pad(turn(observation.images[camera]), PICTURE_SIZE) for camera in CAMERAS]),
        "state": libero_state(observation.eef_pos, observation.eef_quat, observation.gripper_qpos).astype(np.float32),
        "task": np.array(task, dtype=np.int16),
        "episode": np.array(episode, dtype=np.int32),
        "scene": np.array(episode, dtype=np.int32),
        "step": np.array(step, dtype=np.int16),
        "eef": observation.eef_pos.astype(np.float32),
        "cube_positions": cubes,
        "cube_pixels": np.stack([project(simulator.sim, camera, cubes) for camera in CAMERAS]),
        "target": np.array(simulator.target, dtype=np.int8),
        "destination": np.array(destination, dtype=np.int8),
    }


def project(simulation: Any, camera: str, points: NDArray[np.floating]) -> NDArray[np.float32]:
    """Return where points (point, 3) are in the model picture of a camera: (point, 2), row and column in [0, 1].

    NaN where a point is behind the camera or out of the picture. The model picture is upright and mirrored.
    """
    number = simulation.model.camera_name2id(camera)
    axes = np.array(simulation.data.cam_xmat[number]).reshape(3, 3)
    seen = (points - np.array(simulation.data.cam_xpos[number])) @ axes  # x to the right, y up, z against the view
    focal = 0.5 / np.tan(np.deg2rad(simulation.model.cam_fovy[number]) / 2)
    with np.errstate(divide="ignore", invalid="ignore"):
        places = np.stack([0.5 - focal * seen[:, 1] / -seen[:, 2], 0.5 - focal * seen[:, 0] / -seen[:, 2]], axis=1)
    inside = (seen[:, 2] < 0) & (places >= 0).all(axis=1) & (places <= 1).all(axis=1)
    return np.where(inside[:, None], places, np.nan).astype(np.float32)


def write_part(folder: Path, number: int, arrays: Arrays) -> None:
    """Write one part; a file under its final name is whole."""
    path = part_path(folder, number)
    partial = path.with_name(f".{path.name}.{os.getpid()}")
    with partial.open("wb") as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]
    partial.replace(path)


def settings_content(settings: DemonstrationSettings) -> dict[str, Any]:
    """Return what the demonstrations are, as plain JSON values."""
    return {"settings": asdict(settings), "cameras": list(CAMERAS), "colours": list(COLOURS)}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `demonstrate`."""
    parser.add_argument("demonstrations", type=Path, metavar="DEMONSTRATIONS", help="folder for the demonstrations")
    parser.add_argument(
        "--parts", type=int, default=75, metavar="N", help="files of 20 episodes and about 7 MB each (default: 75)"
    )
    parser.add_argument("--workers", type=int, default=2, metavar="N", help="processes (default: 2)")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="seed of the demonstrations (default: 0)")


def run(arguments: argparse.Namespace) -> int:
    """Record what is missing; returns the exit code."""
    folder: Path = arguments.demonstrations
    if arguments.parts < 1 or arguments.workers < 1:
        raise BadArgument(f"Cannot use --parts {arguments.parts} --workers {arguments.workers}; expected at least 1.")
    if arguments.seed < 0:
        raise BadArgument(f"--seed is {arguments.seed}; it must be at least 0.")
    settings = DemonstrationSettings(seed=arguments.seed)
    new_folder(folder, "demonstrations")
    _check_same(folder, settings)
    missing = [number for number in range(arguments.parts) if not part_path(folder, number).exists()]
    samples = 0
    # New processes: an OpenGL context does not survive a fork.
    context = multiprocessing.get_context("spawn")
    with (
        tqdm(total=arguments.parts, initial=arguments.parts - len(missing), unit="part", disable=None) as bar,
        ProcessPoolExecutor(arguments.workers, context) as pool,
    ):
        try:
            for done in as_completed([pool.submit(make_part, folder, settings, number) for number in missing]):
                samples += done.result()
                bar.update()
        except BaseException:  # Ctrl-C too
            pool.shutdown(wait=False, cancel_futures=True)
            for process in multiprocessing.active_children():  # the parts that they make are made again
                process.terminate()
            raise
    size = sum(file.stat().st_size for file in folder.glob("part_*.npz"))
    print(f"{samples} samples added; {folder} has {format_bytes(size)}.")
    print(f"Next: python -m examples.cubes_policy train {folder} OUTPUT")
    return 0


#: A process keeps its simulators for all of its parts.
_demonstrator = lru_cache(maxsize=1)(Demonstrator)


def make_part(folder: Path, settings: DemonstrationSettings, part: int) -> int:
    """Record a part; returns the number of its samples."""
    arrays = join_episodes(part, list(_demonstrator(settings).episodes(part)), settings)
    write_part(folder, part, arrays)
    return len(arrays["task"])


def _check_same(folder: Path, settings: DemonstrationSettings) -> None:
    """Write the settings into a new folder; raise `BadArgument` if the folder has those of other demonstrations."""
    path, content = folder / INDEX_FILE, settings_content(settings)
    if not path.exists():
        path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
        return
    if read_object(path, BadArgument) != json.loads(json.dumps(content)):
        raise BadArgument(
            f"'{folder}' has demonstrations with other settings than these (seed {settings.seed}); give the --seed of "
            f"its {INDEX_FILE}, or another folder."
        )
