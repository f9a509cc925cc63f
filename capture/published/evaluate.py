"""`evaluate-attention-ratio` and `evaluate-attention-ratio-cosmos`: the published scripts' commands, as capture and then analysis.

They are `vla-capture pi` and `vla-capture cosmos` with the published defaults, and differ in three ways. `--layers` says what is
*analysed*: all layers are recorded, so that asking about others needs no second capture. An existing store is continued.
And one command may run several suites, or one task of an array job.
"""

from __future__ import annotations

import argparse
import copy
import os
import shutil
import socket
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from vla_attention.capture.command import check_writable, run_analysis, run_capture_command
from vla_attention.capture.jobs.termination import Termination
from vla_attention.schemas.errors import BadArgument, unknown_name
from vla_attention.schemas.layers import select_layers

if TYPE_CHECKING:
    from vla_attention.capture.settings import RunSettings

_FROM_ENVIRONMENT = "--from-environment"
_PROGRAMS = {"pi": "evaluate-attention-ratio", "cosmos": "evaluate-attention-ratio-cosmos"}


def main_pi(argv: Sequence[str] | None = None) -> int:
    """Run `evaluate-attention-ratio`."""
    return _main("pi", argv)


def main_cosmos(argv: Sequence[str] | None = None) -> int:
    """Run `evaluate-attention-ratio-cosmos`."""
    return _main("cosmos", argv)


def _main(family: str, argv: Sequence[str] | None) -> int:
    words = sys.argv[1:] if argv is None else list(argv)
    program, requeues = _PROGRAMS[family], [0]

    def command(termination: Termination) -> int:
        from vla_attention.capture.arguments import build_evaluate_parser

        arguments = build_evaluate_parser(program, family).parse_args(_with_environment(words, family))
        requeues[0] = arguments.max_requeues
        return _evaluate(arguments, termination)

    return run_capture_command(program, command, lambda: requeues[0])


def _with_environment(words: Sequence[str], family: str) -> list[str]:
    """The arguments; `--from-environment` stands for what the batch scripts' variables say."""
    if _FROM_ENVIRONMENT not in words:
        return list(words)
    from vla_attention.capture.arguments import PUBLISHED_CHECKPOINTS
    from vla_attention.capture.published.environment_variables import arguments_from_environment, describe_job

    line = describe_job(os.environ, socket.gethostname())
    if line:
        print(line, flush=True)
    first = arguments_from_environment(os.environ, family, PUBLISHED_CHECKPOINTS[family])
    return [*first, *(word for word in words if word != _FROM_ENVIRONMENT)]


@dataclass(frozen=True)
class _Job:
    """One suite of a command: its settings, and where its results go."""

    arguments: argparse.Namespace
    settings: RunSettings
    output: Path
    default_output: bool


def _evaluate(arguments: argparse.Namespace, termination: Termination) -> int:
    jobs = _jobs(arguments)
    stage = arguments.stage or ("both" if arguments.array_index is None else "capture")
    if stage != "capture":
        for job in jobs:
            check_writable(job.output, "--output-dir")
    if stage != "analyze":
        _capture(arguments, jobs, termination)
    if stage == "capture":
        return 0
    codes = [_analyze(job) for job in jobs]
    return next((code for code in codes if code), 0)


def _jobs(arguments: argparse.Namespace) -> list[_Job]:
    from vla_attention.capture.arguments import run_settings
    from vla_attention.capture.environments.suites import ALL_SUITES, STANDARD_SUITES, SUITES
    from vla_attention.capture.jobs.slurm import array_task_ids

    existing = [*(suite.name for suite in SUITES), ALL_SUITES]
    if arguments.task_suite not in existing:
        raise unknown_name("task suite", arguments.task_suite, existing)
    several = arguments.task_suite == ALL_SUITES
    suites = STANDARD_SUITES if several else (arguments.task_suite,)
    if several and arguments.store is not None:
        raise BadArgument(
            f"Cannot put the suites of '{ALL_SUITES}' into one store, {arguments.store}: a store holds one suite; leave --store out "
            "(each suite gets its own in --output-dir)."
        )
    task_id: int | None = arguments.task_id
    of_array: list[tuple[str, int]] = []
    if arguments.array_index is not None:
        suite, task_id = _task_of_array_index(arguments, suites)
        of_array = [place for index in array_task_ids() if (place := _place(index, suites)) is not None]
        suites = (suite,)
    jobs = []
    for suite in suites:
        one = copy.copy(arguments)
        one.task_suite, one.task_id = suite, task_id
        folder = "attention_ratio_" if arguments.policy == "pi" else f"attention_ratio_{arguments.policy}_"
        given = arguments.output_dir
        one.output_dir = Path("results") / f"{folder}{suite}" if given is None else given / suite if several else given
        settings = run_settings(one)
        settings = replace(
            settings,
            recording=replace(settings.recording, layers=None),
            array_task_ids=tuple(number for name, number in of_array if name == suite),
        )
        jobs.append(_Job(one, settings, one.output_dir, given is None))
    return jobs


def _task_of_array_index(arguments: argparse.Namespace, suites: Sequence[str]) -> tuple[str, int]:
    """The suite and task of an array job's index; the indices run through the suites in order."""
    from vla_attention.capture.environments.suites import find_suite

    if arguments.task_id is not None:
        raise BadArgument(
            f"Cannot run task {arguments.task_id} and array index {arguments.array_index}: in an array the index is the task; "
            "give --task-id (TASK_ID) or --array, not both."
        )
    place = _place(arguments.array_index, suites)
    if place is not None:
        return place
    total = sum(find_suite(name).num_tasks for name in suites)
    raise BadArgument(
        f"Array index {arguments.array_index} is beyond the tasks of {arguments.task_suite}, which has {total}; "
        f"submit with --array=0-{total - 1}."
    )


def _place(index: int, suites: Sequence[str]) -> tuple[str, int] | None:
    """Suite and task of an index; None when there is none."""
    from vla_attention.capture.environments.suites import find_suite

    for name in suites:
        number = find_suite(name).num_tasks
        if 0 <= index < number:
            return name, index
        index -= number
    return None


def _capture(arguments: argparse.Namespace, jobs: Sequence[_Job], termination: Termination) -> None:
    for job in jobs:
        check_writable(job.settings.store.parent, "--output-dir" if arguments.store is None else "--store")

    from vla_attention.capture.device import choose_device
    from vla_attention.capture.policy_choice import build_policy
    from vla_attention.capture.rollout.progress import say
    from vla_attention.capture.run import run_capture

    device = choose_device(arguments.device)
    policy = build_policy(arguments, device)
    # A layer that does not exist is found before the capture, not after it.
    select_layers(arguments.layers, policy.num_layers, policy.family)
    for job in jobs:
        if len(jobs) > 1:
            say(f"Suite {job.settings.suite.name}:")
        results = run_capture(job.settings, policy, device, termination)
        solved = sum(result.success for result in results)
        say(f"{len(results)} episodes added, {solved} solved. Store: {job.settings.store}")


def _analyze(job: _Job) -> int:
    from vla_attention.capture.jobs.status import store_status
    from vla_attention.capture.rollout.progress import say
    from vla_attention.schemas.stores.root import read_root

    arguments, store = job.arguments, job.settings.store
    for line in store_status(store).missing_lines():
        say(f"{store}: {line}")
    root = read_root(store)
    layers, typed = _layers(arguments, root.policy.num_layers, root.policy.family)
    more = [] if layers is None else ["--layers", *map(str, layers)]
    if arguments.task_id is not None:
        more += ["--tasks", str(arguments.task_id)]
    if not (typed and job.default_output):
        return run_analysis(arguments, store, job.output, more)
    # Several layer groups in turn, or at once, with the published default folder: each keeps its results, and the folder itself
    # has those of the last one, under the published names.
    apart = job.output / f"layers_{'_'.join(map(str, layers or ()))}"
    code = run_analysis(arguments, store, apart, more)
    if code == 0:
        _publish(apart, job.output)
        say(f"The same files are in {job.output}; {apart} keeps them when other layers are analysed.")
    return code


def _layers(arguments: argparse.Namespace, num_layers: int, family: str) -> tuple[tuple[int, ...] | None, bool]:
    """The layers to analyse (None: all), and whether the user typed them."""
    from vla_attention.capture.arguments import PUBLISHED_LAYERS
    from vla_attention.capture.rollout.progress import say

    if arguments.layers is not None:
        return select_layers(arguments.layers, num_layers, family).labels, True
    try:
        return select_layers(PUBLISHED_LAYERS, num_layers, family).labels, False
    except BadArgument:
        say(f"This policy has {num_layers} layers, and not the published default 25 26 27: analysing all of them.")
        return None, False


def _publish(source: Path, target: Path) -> None:
    """Copy every file of a folder into another, each appearing whole."""
    for file in sorted(path for path in source.rglob("*") if path.is_file()):
        place = target / file.relative_to(source)
        place.parent.mkdir(parents=True, exist_ok=True)
        temporary = place.with_name(f".{place.name}.{os.getpid()}.partial")
        shutil.copyfile(file, temporary)
        temporary.replace(place)
