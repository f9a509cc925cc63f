"""The published scripts' commands, `evaluate-attention-ratio` and its `-cosmos` form: capture, then analysis.

Each is `vla-capture FAMILY` with the published defaults, and differs in three ways. `--layers` are the layers to
*analyse*: all layers are recorded, so that an analysis of others needs no second capture. An existing store is
continued. One command may run several suites, or one task of an array job.
"""

from __future__ import annotations

import argparse
import copy
import os
import shlex
import shutil
import socket
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from vla_attention.capture.commands.command_line import run_capture_command
from vla_attention.capture.jobs.termination import Termination
from vla_attention.capture.policies.families import policy_families
from vla_attention.capture.policies.family import PolicyFamily, PublishedScript
from vla_attention.capture.run.command import run_analysis
from vla_attention.schemas.errors import BadArgument, listing, unknown_name
from vla_attention.schemas.layers import select_layers
from vla_attention.schemas.options import read_options
from vla_attention.schemas.threads import Threads, use_threads

if TYPE_CHECKING:
    from vla_attention.capture.commands.arguments import ClusterSettings
    from vla_attention.capture.run.run_settings import RunSettings

_FROM_ENVIRONMENT = "--from-environment"


def evaluate_attention_ratio(argv: Sequence[str] | None = None) -> int:
    """Run the console script `evaluate-attention-ratio`; returns the exit code."""
    return _main("evaluate-attention-ratio", argv)


def evaluate_attention_ratio_cosmos(argv: Sequence[str] | None = None) -> int:
    """Run the console script `evaluate-attention-ratio-cosmos`; returns the exit code."""
    return _main("evaluate-attention-ratio-cosmos", argv)


def _main(program: str, argv: Sequence[str] | None) -> int:
    given = sys.argv[1:] if argv is None else list(argv)
    family, script = _find_script(program)
    requeues = [0]

    def command(termination: Termination) -> int:
        from vla_attention.capture.commands.arguments import ClusterSettings, build_evaluate_parser

        arguments = build_evaluate_parser(family, script).parse_args(_with_environment(given, family))
        cluster = read_options(ClusterSettings, arguments)
        requeues[0] = cluster.max_requeues
        return _evaluate(arguments, cluster, script, termination)

    return run_capture_command(program, command, lambda: requeues[0])


def _find_script(program: str) -> tuple[PolicyFamily, PublishedScript]:
    for family in policy_families():
        if family.published is not None and family.published.program == program:
            return family, family.published
    raise LookupError(f"no policy family has the published script {program}")


def _with_environment(given: Sequence[str], family: PolicyFamily) -> list[str]:
    """Return the arguments, with those of the batch scripts' variables in place of `--from-environment`."""
    if _FROM_ENVIRONMENT not in given:
        return list(given)
    line = describe_job(os.environ, socket.gethostname())
    if line:
        print(line, flush=True)
    first = arguments_from_environment(os.environ, family)
    return [*first, *(argument for argument in given if argument != _FROM_ENVIRONMENT)]


@dataclass(frozen=True)
class _Job:
    """One suite of a command: its settings, and the folder of its results."""

    arguments: argparse.Namespace
    settings: RunSettings
    output: Path
    default_output: bool


def _evaluate(
    arguments: argparse.Namespace, cluster: ClusterSettings, script: PublishedScript, termination: Termination
) -> int:
    threads = use_threads(arguments.threads)

    from vla_attention.schemas.stores.store_place import check_writable

    jobs = _jobs(arguments, cluster.array_index)
    stage = cluster.stage or ("both" if cluster.array_index is None else "capture")
    if stage != "capture":
        for job in jobs:
            check_writable(job.output, "--output-dir")
    if stage != "analyze":
        _capture(arguments, jobs, threads, termination)
    if stage == "capture":
        return 0
    codes = [_analyze(job, script) for job in jobs]
    return next((code for code in codes if code), 0)


def _jobs(arguments: argparse.Namespace, array_index: int | None) -> list[_Job]:
    from vla_attention.capture.environments.suites import ALL_SUITES, STANDARD_SUITES, SUITES
    from vla_attention.capture.jobs.slurm import array_task_ids
    from vla_attention.capture.run.run_settings import run_settings

    existing = [*(suite.name for suite in SUITES), ALL_SUITES]
    if arguments.task_suite not in existing:
        raise unknown_name("task suite", arguments.task_suite, existing)
    several = arguments.task_suite == ALL_SUITES
    suites = STANDARD_SUITES if several else (arguments.task_suite,)
    if several and arguments.store is not None:
        raise BadArgument(
            f"Cannot put the suites of '{ALL_SUITES}' into one store, {arguments.store}: a store holds one suite; "
            "leave it out (each suite gets its own in --output-dir)."
        )
    task_ids: list[int] | None = arguments.task_id
    of_array: list[tuple[str, int]] = []
    if array_index is not None:
        suite, task_id = _task_of_array_index(arguments, array_index, suites)
        task_ids = [task_id]
        of_array = [place for index in array_task_ids() if (place := _place(index, suites)) is not None]
        suites = (suite,)
    jobs = []
    for suite in suites:
        one = copy.copy(arguments)
        one.task_suite, one.task_id = suite, task_ids
        given = arguments.output_dir
        if given is None:
            one.output_dir = Path("results") / f"attention_ratio_{arguments.family.store_prefix}{suite}"
        elif several:
            one.output_dir = given / suite
        settings = run_settings(one)
        settings = replace(
            settings,
            recording=replace(settings.recording, layers=None),
            array_task_ids=tuple(number for name, number in of_array if name == suite),
        )
        jobs.append(_Job(one, settings, one.output_dir, given is None))
    return jobs


def _task_of_array_index(arguments: argparse.Namespace, index: int, suites: Sequence[str]) -> tuple[str, int]:
    """Return suite and task of an array job's index; the indices run through the suites in order."""
    from vla_attention.capture.environments.suites import find_suite

    if arguments.task_id is not None:
        raise BadArgument(
            f"Cannot run task {listing(arguments.task_id)} and array index {index}: in an array the "
            "index is the task; give --task-id (TASK_ID) or --array, not both."
        )
    place = _place(index, suites)
    if place is not None:
        return place
    total = sum(find_suite(name).num_tasks for name in suites)
    raise BadArgument(
        f"Array index {index} is beyond the tasks of {arguments.task_suite}, which has {total}; "
        f"submit with --array=0-{total - 1}."
    )


def _place(index: int, suites: Sequence[str]) -> tuple[str, int] | None:
    """Return suite and task of an index, or None if there is none."""
    from vla_attention.capture.environments.suites import find_suite

    for name in suites:
        number = find_suite(name).num_tasks
        if 0 <= index < number:
            return name, index
        index -= number
    return None


def _capture(arguments: argparse.Namespace, jobs: Sequence[_Job], threads: Threads, termination: Termination) -> None:
    from vla_attention.capture.environments.drawing import check_simulator
    from vla_attention.schemas.stores.store_place import check_writable

    for job in jobs:
        check_writable(job.settings.store.parent, "--output")
    check_simulator(jobs[0].settings.suite, jobs[0].settings.libero_assets)

    from vla_attention.capture.engine.faults import EpisodesMissing
    from vla_attention.capture.engine.progress import say
    from vla_attention.capture.machine import load_torch
    from vla_attention.capture.run.capture_run import run_capture
    from vla_attention.schemas.stores.verify import DamagedEpisodesLeft

    say(threads.describe())
    device = load_torch(arguments.device, threads.number)
    policy = arguments.family.read(arguments).build(device)
    # A layer that does not exist is an error before the capture, not after it.
    select_layers(arguments.layers, policy.num_layers, policy.family)
    missing = []
    for job in jobs:
        if len(jobs) > 1:
            say(f"Suite {job.settings.suite.name}:")
        try:
            run_capture(job.settings, policy, device, termination)
        except (DamagedEpisodesLeft, EpisodesMissing) as error:
            missing.append(str(error))  # the other suites do not wait for a repair
    if missing:
        raise EpisodesMissing(" ".join(missing))


def _analyze(job: _Job, script: PublishedScript) -> int:
    from vla_attention.capture.engine.progress import say
    from vla_attention.capture.jobs.status import store_status
    from vla_attention.schemas.stores.root import read_root

    arguments, store = job.arguments, job.settings.store
    for line in store_status(store).lacking_lines():
        say(f"{store}: {line}")
    root = read_root(store)
    layers, typed = _layers(arguments.layers, script.layers, root.policy.num_layers, root.policy.family)
    more = [] if layers is None else ["--layers", *map(str, layers)]
    if arguments.task_id is not None:
        more += ["--tasks", *map(str, arguments.task_id)]
    if not (typed and job.default_output):
        return run_analysis(arguments, store, job.output, more)
    # In the published default folder, each group of layers keeps its results in a folder of its own. The default folder
    # itself has the results of the last group, under the published names.
    apart = job.output / f"layers_{'_'.join(map(str, layers or ()))}"
    code = run_analysis(arguments, store, apart, more)
    if code == 0:
        _publish(apart, job.output)
        say(f"The same files are in {job.output}; {apart} keeps them when other layers are analysed.")
    return code


def _layers(
    typed: Sequence[int] | None, published: Sequence[int], num_layers: int, model_family: str
) -> tuple[tuple[int, ...] | None, bool]:
    """Return the layers to analyse (None: all), and whether the user typed them."""
    from vla_attention.capture.engine.progress import say

    if typed is not None:
        return select_layers(typed, num_layers, model_family).labels, True
    try:
        return select_layers(published, num_layers, model_family).labels, False
    except BadArgument:
        default = " ".join(map(str, published))
        say(f"This policy has {num_layers} layers, and not the published default {default}: analysing all of them.")
        return None, False


def _publish(source: Path, target: Path) -> None:
    """Copy every file of a folder into another one; no reader sees a partial file."""
    for file in sorted(path for path in source.rglob("*") if path.is_file()):
        place = target / file.relative_to(source)
        place.parent.mkdir(parents=True, exist_ok=True)
        temporary = place.with_name(f".{place.name}.{os.getpid()}.partial")
        shutil.copyfile(file, temporary)
        temporary.replace(place)


#: Variables that are passed on as the option of their name, and what is expected of those that are numbers.
_VARIABLES = {
    **dict.fromkeys(("CONFIG_NAME", "TASK_SUITE", "OUTPUT_DIR", "STORE", "STAGE"), ""),
    **dict.fromkeys(("NUM_EPISODES", "SEED", "REPLAN_STEPS", "MAX_REQUEUES"), "a whole number"),
    "TASK_ID": "a whole number, or several separated by spaces",
    "LAYERS": 'layer numbers separated by spaces, as in LAYERS="25 26 27"',
}
_SEVERAL = ("TASK_ID", "LAYERS")
_SWITCH = {"1": True, "true": True, "yes": True, "": False, "0": False, "false": False, "no": False}


def arguments_from_environment(environment: Mapping[str, str], family: PolicyFamily) -> list[str]:
    """Return the arguments for the batch scripts' variables. An empty variable counts as not set.

    The heads of the scripts, `scripts/run_attention_ratio*.sh`, document the variables. Those of a single policy family
    are in its `PublishedScript`.

    Raises:
        BadArgument: a variable has a value that it cannot have, or belongs to another family's script.
    """
    given = {name: value.strip() for name, value in environment.items()}
    get = given.get
    arguments: list[str] = []
    for name, expected in _VARIABLES.items():
        text = given.get(name, "")
        words = text.split() if name in _SEVERAL else [text] if text else []
        if expected and not all(word.isdecimal() for word in words):
            raise BadArgument(f"{name} is '{text}'; expected {expected}.")
        arguments += [_option_of(name), *words] if words else []
    arguments += _family_arguments(given, family)
    save_viz = _SWITCH.get(get("SAVE_VIZ", "").lower())
    if save_viz is None:
        raise BadArgument(f"SAVE_VIZ is '{given['SAVE_VIZ']}'; expected 1 or 0.")
    if save_viz:
        arguments += ["--save-viz"]
    checkpoint = _checkpoint(given)
    if checkpoint:
        arguments += ["--checkpoint", checkpoint]
    in_slurm, stage = bool(get("SLURM_JOB_ID")), get("STAGE")
    if get("SLURM_ARRAY_TASK_ID") and stage != "analyze":
        arguments += ["--array-index", given["SLURM_ARRAY_TASK_ID"]]
    if get("DEVICE"):
        arguments += ["--device", given["DEVICE"]]
    elif in_slurm and stage != "analyze" and (not checkpoint or checkpoint not in family.built_in):
        # A job without a GPU fails at once, instead of running on the CPU until its time is over.
        arguments += ["--device", "cuda"]
    try:
        return [*arguments, *shlex.split(get("ARGS", ""))]
    except ValueError as error:
        raise BadArgument(f"ARGS is '{given['ARGS']}', which cannot be read as arguments: {error}.") from None


def describe_job(environment: Mapping[str, str], host: str) -> str:
    """Return the first line of a SLURM job's log; empty without SLURM."""
    job = environment.get("SLURM_JOB_ID")
    if not job:
        return ""
    array, index = environment.get("SLURM_ARRAY_JOB_ID"), environment.get("SLURM_ARRAY_TASK_ID")
    name = f"{array}_{index}" if array and index else job
    restarts = environment.get("SLURM_RESTART_COUNT", "0")
    return f"Job {name} on {host}" + (f", requeued {restarts} times." if restarts != "0" else ".")


def _family_arguments(given: Mapping[str, str], family: PolicyFamily) -> list[str]:
    """Return the options of the family's own variables; `BadArgument` for a variable of another family."""
    own = family.published.variables if family.published else ()
    for other in policy_families():
        for name in other.published.variables if other.published else ():
            if given.get(name) and name not in own:
                raise BadArgument(f"{name} is for {other.title}, and means nothing to {family.title}; unset it.")
    return [word for name in own if given.get(name) for word in (_option_of(name), given[name])]


def _option_of(variable: str) -> str:
    return "--output" if variable == "STORE" else f"--{variable.lower().replace('_', '-')}"


def _checkpoint(given: Mapping[str, str]) -> str:
    one, other = given.get("CHECKPOINT", ""), given.get("CKPT_PATH", "")
    if one and other and one != other:
        raise BadArgument(f"CHECKPOINT is '{one}' and CKPT_PATH is '{other}'; give one of them.")
    return one or other
