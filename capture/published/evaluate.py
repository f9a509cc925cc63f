"""The published scripts' commands, `evaluate-attention-ratio` and its `-cosmos` form: capture, then analysis.

Each is `capture FAMILY` with the published defaults, and differs in three ways. `--layers` are the layers to
*analyse*: all layers are recorded, so that an analysis of others needs no second capture. An existing store is
continued. One command may run several suites, or one task of an array job.
"""

from __future__ import annotations

import argparse
import copy
import os
import re
import shlex
import shutil
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from vla_attention.capture.commands.command_line import run_capture_command
from vla_attention.capture.policies.families import policy_families
from vla_attention.capture.policies.family import PolicyFamily
from vla_attention.capture.run.command import load_policy, run_analysis
from vla_attention.schemas.errors import BadArgument, listing, unknown_name
from vla_attention.schemas.layers import select_layers
from vla_attention.schemas.options import read_options
from vla_attention.schemas.stop_signals import Termination
from vla_attention.schemas.threads import Threads, use_threads

if TYPE_CHECKING:
    from vla_attention.capture.run.run_settings import RunSettings


def evaluate(program: str, argv: Sequence[str] | None = None) -> int:
    """Run the console script of this name; returns the exit code."""
    given = sys.argv[1:] if argv is None else list(argv)
    published = {one.published.program: (one, one.published) for one in policy_families() if one.published}
    family, script = published[program]

    def parse() -> argparse.Namespace:
        from vla_attention.capture.commands.arguments import build_evaluate_parser
        from vla_attention.schemas.stores.worker import this_worker

        words: list[str] = []
        if "--from-environment" in given:
            worker = this_worker()
            requeued = f", requeued {worker.restarts} times" if worker.restarts else ""
            if worker.slurm_job:
                print(f"Job {worker.job_name} on {worker.host}{requeued}.", flush=True)
            words = arguments_from_environment(os.environ, family)
        parser = build_evaluate_parser(family, script)
        parser.set_defaults(command=_capture_and_analyze)
        parsed: argparse.Namespace = parser.parse_args([*words, *given])
        return parsed

    return run_capture_command(program, parse)


def _capture_and_analyze(arguments: argparse.Namespace, termination: Termination) -> int:
    threads = use_threads(arguments.threads)

    from vla_attention.capture.commands.arguments import ClusterSettings
    from vla_attention.schemas.stores.store_place import check_writable

    cluster = read_options(ClusterSettings, arguments)
    suites = _plan_suites(arguments, cluster.array_index)
    stage = cluster.stage or ("both" if cluster.array_index is None else "capture")
    if stage != "capture":
        for output in suites:
            check_writable(output, "--output-dir")
    if stage != "analyze":
        _capture(arguments, list(suites.values()), threads, termination)
    if stage == "capture":
        return 0
    codes = [_analyze(arguments, settings, output) for output, settings in suites.items()]
    return next((code for code in codes if code), 0)


def _plan_suites(arguments: argparse.Namespace, index: int | None) -> dict[Path, RunSettings]:
    """Return the settings of each suite of the command, by the folder of its results.

    index: of an array job, which runs one task; the indices run through the tasks of all suites in order.
    """
    from vla_attention.capture.environments.suites import ALL_SUITES, STANDARD_SUITES, SUITES, find_suite
    from vla_attention.capture.jobs.slurm import array_task_ids
    from vla_attention.capture.run.run_settings import run_settings

    existing = [*(suite.name for suite in SUITES), ALL_SUITES]
    if arguments.task_suite not in existing:
        raise unknown_name("task suite", arguments.task_suite, existing)
    several, given = arguments.task_suite == ALL_SUITES, arguments.output_dir
    if several and arguments.store is not None:
        raise BadArgument(
            f"Cannot put the suites of '{ALL_SUITES}' into one store, {arguments.store}: a store holds one suite; "
            "leave it out (each suite gets its own in --output-dir)."
        )
    names = STANDARD_SUITES if several else (arguments.task_suite,)
    places = [(name, task_id) for name in names for task_id in range(find_suite(name).num_tasks)]
    task_ids, of_array = arguments.task_id, []
    if index is not None:
        if task_ids is not None:
            raise BadArgument(
                f"Cannot run task {listing(task_ids)} and array index {index}: in an array the "
                "index is the task; give --task-id (TASK_ID) or --array, not both."
            )
        if index >= len(places):
            raise BadArgument(
                f"Array index {index} is beyond the tasks of {arguments.task_suite}, which has {len(places)}; "
                f"submit with --array=0-{len(places) - 1}."
            )
        names, task_ids = (places[index][0],), [places[index][1]]
        of_array = [places[number] for number in array_task_ids() if number < len(places)]
    suites = {}
    for name in names:
        output = Path("results") / f"attention_ratio_{arguments.family.store_prefix}{name}" if given is None else given
        if several and given is not None:
            output = given / name
        one = copy.copy(arguments)
        one.task_suite, one.task_id, one.output_dir, one.layers = name, task_ids, output, None
        one.array_task_ids = [task_id for suite, task_id in of_array if suite == name]
        suites[output] = run_settings(one)
    return suites


def _capture(
    arguments: argparse.Namespace, suites: Sequence[RunSettings], threads: Threads, termination: Termination
) -> None:
    from vla_attention.schemas.stores.store_place import check_writable

    for settings in suites:
        check_writable(settings.store.parent, "--output")
    policy, device = load_policy(arguments, suites, threads)

    from vla_attention.capture.engine.faults import EpisodesMissing
    from vla_attention.capture.engine.progress import say
    from vla_attention.capture.run.capture_run import run_capture
    from vla_attention.schemas.stores.verify import DamagedEpisodesLeft

    # A layer that does not exist is an error before the capture, not after it.
    select_layers(arguments.layers, policy.num_layers, policy.family)
    missing = []
    for settings in suites:
        if len(suites) > 1:
            say(f"Suite {settings.suite.name}:")
        try:
            run_capture(settings, policy, device, termination)
        except (DamagedEpisodesLeft, EpisodesMissing) as error:
            missing.append(str(error))  # the other suites do not wait for a repair
    if missing:
        raise EpisodesMissing(" ".join(missing))


def _analyze(arguments: argparse.Namespace, settings: RunSettings, output: Path) -> int:
    from vla_attention.capture.engine.progress import say
    from vla_attention.capture.jobs.status import store_status
    from vla_attention.schemas.stores.root import read_root

    store, layers = settings.store, arguments.layers or arguments.family.published.layers
    for line in store_status(store).lacking_lines():
        say(f"{store}: {line}")
    policy, named = read_root(store).policy, list(map(str, layers))
    more = ["--layers", *named]
    try:
        select_layers(layers, policy.num_layers, policy.family)
    except BadArgument:
        if arguments.layers:
            raise
        published = f"the published default {' '.join(named)}"
        say(f"This policy has {policy.num_layers} layers, and not {published}: analysing all of them.")
        more = []
    if settings.task_ids is not None:
        more += ["--task", *map(str, settings.task_ids)]
    if not arguments.layers or arguments.output_dir is not None:
        return run_analysis(arguments, store, output, more)
    # In the published default folder, each group of layers keeps its results in a folder of its own. The default folder
    # itself has the results of the last group, under the published names.
    apart = output / f"layers_{'_'.join(named)}"
    code = run_analysis(arguments, store, apart, more)
    if code == 0:
        shutil.copytree(apart, output, copy_function=_copy_whole, dirs_exist_ok=True)
        say(f"The same files are in {output}; {apart} keeps them when other layers are analysed.")
    return code


def _copy_whole(source: str, target: str) -> None:
    """Copy a file; no reader sees a part of it."""
    temporary = Path(target).with_name(f".{Path(target).name}.{os.getpid()}.partial")
    shutil.copyfile(source, temporary)
    temporary.replace(target)


_ANY = ("CONFIG_NAME", "TASK_SUITE", "OUTPUT_DIR", "STORE", "STAGE", "CHECKPOINT", "CKPT_PATH", "DEVICE")
#: Variables that are passed on as an option. Of some, a pattern of the values, and what is expected in words.
_VARIABLES = {
    **dict.fromkeys((*_ANY, "SLURM_ARRAY_TASK_ID"), ("", "")),
    **dict.fromkeys(("NUM_EPISODES", "SEED", "REPLAN_STEPS", "MAX_REQUEUES"), (r"\d+", "a whole number")),
    "TASK_ID": (r"[\d\s]+", "a whole number, or several separated by spaces"),
    "LAYERS": (r"[\d\s]+", 'layer numbers separated by spaces, as in LAYERS="25 26 27"'),
    "SAVE_VIZ": ("1|true|yes|0|false|no", "1 or 0"),
}
#: The option of those that are not called like it.
_OPTIONS = {"STORE": "--output", "CKPT_PATH": "--checkpoint", "SLURM_ARRAY_TASK_ID": "--array-index"}


def arguments_from_environment(environment: Mapping[str, str], family: PolicyFamily) -> list[str]:
    """Return the arguments for the batch scripts' variables. An empty variable counts as not set.

    The heads of the scripts, `scripts/run_attention_ratio*.sh`, document the variables. Those of a single policy family
    are in its `PublishedScript`.

    Raises:
        BadArgument: a variable has a value that it cannot have, or belongs to another family's script.
    """
    given = {name: value.strip() for name, value in environment.items() if value.strip()}
    own = family.published.variables if family.published else ()
    for other in policy_families():
        for name in other.published.variables if other.published else ():
            if name in given and name not in own:
                raise BadArgument(f"{name} is for {other.title}, and means nothing to {family.title}; unset it.")
    options: dict[str, list[str]] = {}
    for name, (pattern, expected) in (_VARIABLES | dict.fromkeys(own, ("", ""))).items():
        if not (text := given.get(name, "")):
            continue
        if pattern and not re.fullmatch(pattern, text.lower()):
            raise BadArgument(f"{name} is '{text}'; expected {expected}.")
        words = text.split() if pattern else [text]
        if options.setdefault(_OPTIONS.get(name, f"--{name.lower().replace('_', '-')}"), words) != words:
            raise BadArgument(f"CHECKPOINT is '{given['CHECKPOINT']}' and {name} is '{text}'; give one of them.")
    if switch := options.pop("--save-viz", None):
        options |= {"--save-viz": []} if switch[0].lower() in ("1", "true", "yes") else {}
    if given.get("STAGE") == "analyze":
        options.pop("--array-index", None)
    elif "SLURM_JOB_ID" in given and options.get("--checkpoint", [""])[0] not in family.built_in:
        # A job without a GPU fails at once, instead of running on the CPU until its time is over.
        options.setdefault("--device", ["cuda"])
    arguments = [word for option, words in options.items() for word in (option, *words)]
    try:
        return [*arguments, *shlex.split(given.get("ARGS", ""))]
    except ValueError as error:
        raise BadArgument(f"ARGS is '{given['ARGS']}', which cannot be read as arguments: {error}.") from None
