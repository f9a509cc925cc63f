"""Settings of a capture, from command-line arguments.

Imports nothing heavy: mistakes in the arguments are reported before torch is loaded.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from vla_attention.capture.engine.plan import RecordingSettings, recording_settings
from vla_attention.capture.environments.base import Suite, check_task_id
from vla_attention.capture.environments.episode_protocol import EvaluationProtocol
from vla_attention.capture.environments.suites import find_suite, list_tasks
from vla_attention.capture.interventions.arguments import read_interventions
from vla_attention.capture.machine import memory_left
from vla_attention.capture.policies.family import PolicyFamily
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.interventions import Interventions
from vla_attention.schemas.options import resolve_tasks
from vla_attention.schemas.stores.store_format import STORE_SUFFIX
from vla_attention.schemas.stores.store_place import check_place
from vla_attention.schemas.threads import available_cores

if TYPE_CHECKING:
    from vla_attention.capture.store.store_writer import WriteMode


#: The largest number of simulators that is taken without being asked for: one policy keeps few more busy.
MOST_BY_DEFAULT = 8
#: Memory of a simulator, for their number without being asked: in LIBERO 1.8 GB, of which the scene is most.
SIMULATOR_BYTES = 2e9


@dataclass(frozen=True)
class RunSettings:
    """Which episodes are run, and into which store.

    task_ids: None runs all tasks of the suite. protocol: the published evaluation that is followed; None takes that of
    the policy. seed, replan_steps, max_steps: None takes the protocol's number. array_task_ids: tasks that
    other processes of the same array job run; the store is expected to hold these too. verify: read every byte of the
    episodes that an existing store has, before they count as done. interventions: what is changed, with layer
    numbers as typed. allow_empty: leave a replan unchanged where a group of an intervention has no key. num_envs:
    simulators that run at a time; None takes as many as there are cores.
    """

    suite: Suite
    task_ids: tuple[int, ...] | None
    num_episodes: int
    protocol: EvaluationProtocol | None
    seed: int | None
    replan_steps: int | None
    max_steps: int | None
    store: Path
    mode: WriteMode
    libero_assets: Path | None
    recording: RecordingSettings
    array_task_ids: tuple[int, ...] = ()
    verify: bool = False
    interventions: Interventions = field(default_factory=Interventions)
    allow_empty: bool = False
    num_envs: int | None = None
    policy_batch: int | None = None


def run_settings(arguments: argparse.Namespace) -> RunSettings:
    """Return the settings of parsed arguments; checks everything that needs no policy."""
    suite = find_suite(arguments.task_suite)
    task_ids = None if arguments.task_id is None else _task_ids(suite, arguments.task_id)
    if arguments.num_episodes < 1:
        raise BadArgument(f"Cannot use --num-episodes {arguments.num_episodes}; expected at least 1.")
    if arguments.num_envs is not None and arguments.num_envs < 1:
        raise BadArgument(f"Cannot use --num-envs {arguments.num_envs}; expected at least 1.")
    if arguments.policy_batch is not None and arguments.policy_batch < 1:
        raise BadArgument(f"Cannot use --policy-batch {arguments.policy_batch}; expected at least 1.")
    if arguments.seed is not None and arguments.seed < 0:
        raise BadArgument(f"Cannot use --seed {arguments.seed}; expected 0 or more.")
    if arguments.verify and not arguments.resume:
        raise BadArgument("Cannot use --verify without --resume: a new store has no episodes that could be read.")
    store = store_path(arguments)
    check_place(store, "write a store at")
    return RunSettings(
        suite=suite,
        task_ids=task_ids,
        num_episodes=arguments.num_episodes,
        protocol=_protocol(arguments),
        seed=arguments.seed,
        replan_steps=arguments.replan_steps,
        max_steps=arguments.max_steps,
        store=store,
        verify=arguments.verify,
        mode="overwrite" if arguments.overwrite else "resume" if arguments.resume else "new",
        libero_assets=arguments.libero_assets,
        recording=recording_settings(arguments),
        interventions=read_interventions(arguments),
        allow_empty=arguments.allow_empty,
        num_envs=arguments.num_envs,
        policy_batch=arguments.policy_batch,
    )


def _task_ids(suite: Suite, chosen: Sequence[int | str]) -> tuple[int, ...]:
    """Return the tasks that were chosen by number or by instruction, ascending; the latter opens the suite."""
    named = any(isinstance(task, str) for task in chosen)
    instructions = {task.task_id: task.instruction for task in list_tasks(suite)} if named else {}
    task_ids = resolve_tasks(chosen, instructions, f"the suite {suite.name}")
    for task_id in task_ids:
        check_task_id(suite, task_id)
    return tuple(sorted(task_ids))


def _protocol(arguments: argparse.Namespace) -> EvaluationProtocol | None:
    name = getattr(arguments, "protocol", None)  # a family with a single protocol has no such option
    return next((protocol for protocol in arguments.family.protocols if protocol.name == name), None)


def store_path(arguments: argparse.Namespace) -> Path:
    """Return the store's path: --output, else the name of family and suite, in its folder or `runs`."""
    if arguments.store is not None:
        return Path(arguments.store)
    family: PolicyFamily = arguments.family
    name = f"{family.store_prefix}{arguments.task_suite}{STORE_SUFFIX}"
    return (arguments.output_dir or Path("runs")) / name


def default_policy_batch(device: str) -> int | None:
    """Return the largest batch without `--policy-batch`, None for the number of simulators.

    It is 1 on a processor, which does not gain by larger ones.
    """
    return 1 if device.startswith("cpu") else None


def default_num_envs() -> int:
    """Return the number of simulators without `--num-envs`: as many as there are cores, and as fit into memory."""
    return max(1, int(min(available_cores(), MOST_BY_DEFAULT, memory_left() / SIMULATOR_BYTES)))
