"""Settings of a capture. Imports nothing heavy: every `--help` needs them, and mistakes come before torch is loaded."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from vla_attention.capture.engine.settings import RecordingSettings, StoreOutput, recording_settings
from vla_attention.capture.environments.base import Suite, check_task_id
from vla_attention.capture.environments.episode_protocol import EvaluationProtocol
from vla_attention.capture.environments.suites import find_suite, list_tasks
from vla_attention.capture.interventions.arguments import read_interventions
from vla_attention.capture.machine import memory_left
from vla_attention.capture.policies.family import PolicyFamily
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.interventions import Interventions
from vla_attention.schemas.options import option, read_options, resolve_tasks, task_option
from vla_attention.schemas.threads import available_cores

#: The largest number of simulators that is taken without being asked for: one policy keeps few more busy.
MOST_BY_DEFAULT = 8


@dataclass(frozen=True)
class CaptureOutput(StoreOutput):
    """Where store and results of a capture go, and what is looked at in a store that is there."""

    save_viz: bool = option("analyse afterwards, with pictures of every episode", False)
    verify: bool = option(
        "with --resume: read every byte of the episodes that are there, instead of only seals, presence and sizes",
        False,
    )


@dataclass(frozen=True, kw_only=True)
class RunSettings:
    """Which episodes are run, and into which store.

    task_ids: None runs all tasks of the suite. protocol: the published evaluation that is followed; None takes that of
    the policy. seed, replan_steps, max_steps: None takes the protocol's number. array_task_ids: tasks that other
    processes of the same array job run; the store is expected to hold these too. interventions: what is changed, with
    layer numbers as typed. allow_empty: leave a replan unchanged where a group of an intervention has no key.
    most_rollouts: of an exchange (`exchange.py`), which tells every task in the scenes of the others; None: every task
    is told its own sentence.
    """

    suite: Suite = option("name of the suite", group="evaluation", name="task-suite", type=str, metavar="SUITE")
    task_ids: tuple[int, ...] | None = task_option("tasks of the suite")
    num_episodes: int = option("episodes per task (default: %(default)s)", 5, least=1)
    protocol: EvaluationProtocol | None = option(
        "the published evaluation to follow: picture size, steps and seeding, see docs/my-checkpoint.md (default: "
        "that of the checkpoint's format)",
        None,
        type=str,
    )
    seed: int | None = option("seed of the simulator and of all noise", None, least=0)
    replan_steps: int | None = option("actions executed per policy call", None, least=1)
    max_steps: int | None = option(
        "steps after waiting (default: the published number of suite and protocol)", None, least=1
    )
    num_envs: int | None = option(
        "simulators that run at a time, each in a process of its own; 1 simulates in the policy's process (default: "
        f"the cores that this process may use, at most {MOST_BY_DEFAULT}, and as many as fit into memory)",
        None,
        least=1,
    )
    policy_batch: int | None = option(
        "most policy calls of different simulators that are made as one batch; from 2 on, last bits of what is "
        "computed change (default: 1 on a processor, on a GPU the number of simulators)",
        None,
        least=1,
    )
    libero_assets: Path | None = option("LIBERO asset folder (or set VLA_LIBERO_ASSETS)", None)
    store: Path
    output: CaptureOutput
    recording: RecordingSettings
    interventions: Interventions
    allow_empty: bool = False
    array_task_ids: tuple[int, ...] = ()
    most_rollouts: int | None = None

    def instructions(self) -> tuple[str, ...]:
        """What the policy is told in the episodes."""
        # Here, as it needs numpy, which no --help needs.
        from vla_attention.capture.interventions.prompts import changed_instruction

        known, change = {task.task_id: task.instruction for task in list_tasks(self.suite)}, self.interventions.prompt
        told = [
            known[task]
            if change is None
            else changed_instruction(known[task], change, task_id=task, episode_index=episode, instructions=known)
            for task in self.task_ids or known
            for episode in range(1 if change is None else self.num_episodes)
        ]
        return tuple(dict.fromkeys(told))


def run_settings(given: argparse.Namespace) -> RunSettings:
    """Return the settings of parsed arguments; checks everything that needs no policy."""
    family: PolicyFamily = given.family
    output = read_options(CaptureOutput, given)
    if output.verify and not output.resume:
        raise BadArgument("Cannot use --verify without --resume: a new store has no episodes that could be read.")
    interventions, exchanged = read_interventions(given), hasattr(given, "most_rollouts")
    if exchanged and interventions.prompt is not None:
        raise BadArgument("Cannot use --prompt in an exchange: every task is told in the scenes of the others already.")
    suite = find_suite(given.task_suite)
    name = getattr(given, "protocol", None)  # a family with a single protocol has no such option
    return read_options(
        RunSettings,
        given,
        suite=suite,
        task_ids=None if given.task_id is None else _task_ids(suite, given.task_id),
        protocol=next((protocol for protocol in family.protocols if protocol.name == name), None),
        store=output.place(f"{family.store_prefix}{suite.name}{'_exchange' * exchanged}"),
        output=output,
        recording=recording_settings(given),
        interventions=interventions,
    )


def _task_ids(suite: Suite, chosen: Sequence[int | str]) -> tuple[int, ...]:
    """Return the tasks that were chosen by number or by instruction, ascending; the latter opens the suite."""
    named = any(isinstance(task, str) for task in chosen)
    instructions = {task.task_id: task.instruction for task in list_tasks(suite)} if named else {}
    task_ids = resolve_tasks(chosen, instructions, f"the suite {suite.name}")
    for task_id in task_ids:
        check_task_id(suite, task_id)
    return tuple(sorted(task_ids))


def default_num_envs(suite: Suite) -> int:
    """Return the number of simulators without `--num-envs`: as many as there are cores, and as fit into memory."""
    return max(1, int(min(available_cores(), MOST_BY_DEFAULT, memory_left() / suite.simulator_bytes)))
