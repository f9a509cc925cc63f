"""The episodes of the published LIBERO evaluations, played by LIBERO's own environment and no code of this package.

One function per evaluation, with the calls of its source in their order: openpi's `examples/libero/main.py`, LeRobot's
`envs/libero.py` as `scripts/lerobot_eval.py` drives it with one environment, Cosmos Policy's `run_libero_eval.py`.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vla_attention.capture.environments.base import Task
from vla_attention.capture.environments.libero import load_initial_states
from vla_attention.capture.environments.libero_installation import load_libero, package_folder

WAIT = [0.0] * 6 + [-1.0]


@dataclass(frozen=True)
class PublishedEpisode:
    """What the first waiting steps of an episode show.

    body_pos, body_quat: (body, 3) and (body, 4), places of all bodies in the model: those without joints stand there.
    state: flattened state after the steps. images: camera -> picture after the last step.
    """

    body_pos: np.ndarray
    body_quat: np.ndarray
    state: np.ndarray
    images: dict[str, np.ndarray]


def openpi_loop(assets: Path, task: Task, episodes: int, seed: int = 7) -> list[PublishedEpisode]:
    """Seed once, then one reset per episode."""
    return list(_loop(assets, task, episodes, 256, first=lambda environment: environment.seed(seed)))


def lerobot_loop(assets: Path, task: Task, episodes: int, seed: int = 1000) -> list[PublishedEpisode]:
    """Reset once unseeded; seed every episode with the next number."""
    return list(
        _loop(
            assets,
            task,
            episodes,
            360,
            first=lambda environment: environment.reset(),
            before_reset=lambda environment, episode: environment.seed(seed + episode),
        )
    )


def cosmos_loop(assets: Path, task: Task, episodes: int) -> list[PublishedEpisode]:
    """Seed with 0 once, and in every step (deterministic mode)."""

    def before_step() -> None:
        np.random.seed(0)  # noqa: NPY002
        random.seed(0)

    first = lambda environment: environment.seed(0)  # noqa: E731
    return list(_loop(assets, task, episodes, 256, first=first, before_step=before_step))


def _loop(
    assets: Path,
    task: Task,
    episodes: int,
    image_size: int,
    first: Callable[[Any], Any],
    before_reset: Callable[[Any, int], None] = lambda environment, episode: None,
    before_step: Callable[[], None] = lambda: None,
) -> Iterator[PublishedEpisode]:
    load_libero(assets)
    from libero.libero.envs import OffScreenRenderEnv

    files = package_folder() / "bddl_files" / task.suite / f"{task.name}.bddl"
    states = load_initial_states(package_folder() / "init_files" / task.suite / f"{task.name}.pruned_init")
    environment = OffScreenRenderEnv(bddl_file_name=str(files), camera_heights=image_size, camera_widths=image_size)
    first(environment)
    for episode in range(episodes):
        before_reset(environment, episode)
        environment.reset()
        environment.set_init_state(states[episode])
        for _ in range(10):
            before_step()
            values = environment.step(WAIT)[0]
        model = environment.env.sim.model
        yield PublishedEpisode(
            model.body_pos.copy(),
            model.body_quat.copy(),
            environment.get_sim_state().copy(),
            {camera: values[f"{camera}_image"].copy() for camera in ("agentview", "robot0_eye_in_hand")},
        )
    environment.close()
