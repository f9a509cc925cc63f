"""A base whose actions are known, and reruns whose changes are planted: what a comparison with the base must find."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tests.kit.stores import (
    PlantActions,
    StoreSpec,
    commit,
    denoise_times,
    episode_records,
    rerun_source,
    root_attributes,
    write_store,
)
from vla_attention.capture.store.replan_records import ReplanRecord
from vla_attention.capture.store.store_writer import open_run
from vla_attention.schemas.interventions import Interventions, KeyKnockout, NoiseChange, PromptChange

TASKS, EPISODES, REPLANS = (0, 1, 2), 2, 6
STEPS, DIMENSIONS = 5, 7
#: Standard deviations of the base's actions, planted; the last dimension is the gripper, which is -1 or 1.
SCALES = np.array([0.4, 0.2, 0.1, 0.05, 0.05, 0.02, 1.0])
VISUAL, READ = "role:image", "role:instruction | role:bos | role:template"

BASE = StoreSpec(
    tasks=TASKS, episodes=EPISODES, replans=REPLANS, frames=False, contributions=True, mantissa_bits=23,
)  # fmt: skip


@dataclass(frozen=True)
class PlantedRerun:
    """A condition and the size of its change: every action moves by normal numbers of `size` spreads."""

    interventions: Interventions
    size: float
    flips: float = 0.0


def knockout(name: str, selector: str, **options: object) -> Interventions:
    """Keys knocked out under a name."""
    return Interventions(name, keys=(KeyKnockout(selector, **options),))  # type: ignore[arg-type]


#: Conditions by name.
PLANTED = {
    "noise": PlantedRerun(Interventions("noise", noise=NoiseChange(1)), 0.1),
    "without_visual": PlantedRerun(knockout("without_visual", VISUAL), 1.2, 0.3),
    "only_visual": PlantedRerun(knockout("only_visual", VISUAL, keep=True), 0.5),
    "random_visual": PlantedRerun(knockout("random_visual", VISUAL, random_seed=0), 0.9),
    "without_linguistic": PlantedRerun(knockout("without_linguistic", READ), 0.4),
    "only_linguistic": PlantedRerun(knockout("only_linguistic", READ, keep=True), 1.1),
    "random_linguistic": PlantedRerun(knockout("random_linguistic", READ, random_seed=0), 0.15),
    "without_state": PlantedRerun(knockout("without_state", "role:state"), 0.1),
    "prompt_empty": PlantedRerun(Interventions("prompt_empty", prompt=PromptChange("empty")), 0.45),
}


def base_actions(task: int, episode: int, replans: int) -> NDArray[np.float64]:
    """Actions (replan, step, dimension) of the base."""
    generator = np.random.default_rng([7, task, episode])
    actions = generator.normal(size=(replans, STEPS, DIMENSIONS)) * SCALES
    actions[..., -1] = np.sign(actions[..., -1])
    return actions


def changed_actions(planted: PlantedRerun) -> PlantActions:
    """The base's actions with a condition's change; gripper commands flip in a share of the steps."""

    def plant(task: int, episode: int, replans: int) -> NDArray[np.float64]:
        generator = np.random.default_rng([len(planted.interventions.name), int(1000 * planted.size), task, episode])
        actions = base_actions(task, episode, replans)
        change = generator.normal(size=actions.shape) * SCALES * planted.size
        change[..., -1] = 0.0
        flipped = generator.random(actions.shape[:2]) < planted.flips
        actions[..., -1] *= np.where(flipped, -1.0, 1.0)
        return actions + change

    return plant


def write_base(folder: Path, **changes: object) -> Path:
    """The base's store, `base.zarr`."""
    return write_store(folder / "base.zarr", spec=replace(BASE, plant_actions=base_actions, **changes))  # type: ignore[arg-type]


def write_rerun(path: Path, base: Path, planted: PlantedRerun, **changes: object) -> Path:
    """A rerun of the base."""
    spec = replace(
        BASE,
        plant_actions=changed_actions(planted),
        interventions=planted.interventions,
        rerun_of=rerun_source(base),
        **changes,  # type: ignore[arg-type]
    )
    return write_store(path, spec=spec)


def write_with(
    path: Path, spec: StoreSpec, change: Callable[[int, int, int, ReplanRecord], ReplanRecord], **start: object
) -> Path:
    """A store in which (task, episode, replan, record) give the record that is written, and episodes other facts."""
    store = open_run(path, root_attributes(spec), "new", durable=False)
    for task, episode in spec.names:
        given, records = episode_records(spec, task, episode)
        with store.episode(replace(given, **start), denoise_times(spec)) as writer:  # type: ignore[arg-type]
            for replan, record in enumerate(records):
                writer.append(change(task, episode, replan, record))
            commit(writer, spec, task, episode)
    return path


def write_series(folder: Path, base: Path, names: tuple[str, ...] = tuple(PLANTED)) -> Path:
    """The reruns of those names in a folder; returns it."""
    for name in names:
        write_rerun(folder / f"{name}.zarr", base, PLANTED[name])
    return folder
