"""The command-line arguments of `vla-attention capture` and of the published scripts' commands."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from vla_attention.capture.effects.arguments import add_effect_options
from vla_attention.capture.engine.settings import RecordingSettings
from vla_attention.capture.environments.suites import ALL_SUITES, STANDARD_SUITES, SUITES, find_suite, list_tasks
from vla_attention.capture.interventions.arguments import InterventionSettings
from vla_attention.capture.policies.families import default_family, policy_families
from vla_attention.capture.policies.family import PolicyFamily, PublishedScript
from vla_attention.capture.replay.arguments import REPLAY_EXAMPLES, add_replay_arguments
from vla_attention.capture.rerun.arguments import RERUN_EXAMPLES, add_rerun_arguments
from vla_attention.capture.run.command import run_capture_of_family
from vla_attention.capture.run.run_settings import CaptureOutput, RunSettings
from vla_attention.schemas.command_line import OneSentenceParser
from vla_attention.schemas.errors import BadArgument, listing
from vla_attention.schemas.options import add_options, option
from vla_attention.schemas.stop_signals import Termination
from vla_attention.schemas.stores import verify_command
from vla_attention.schemas.stores.verify_command import VERIFY_HELP
from vla_attention.schemas.threads import use_threads

_FURTHER_EXAMPLES = """\
  vla-attention capture status runs/libero_10.zarr                     what is there, what is missing, who is writing
  vla-attention capture verify runs/libero_10.zarr               check everything; --repair moves damaged episodes aside
  vla-attention capture doctor                                         what this machine can do, and what is missing
"""
_EXCHANGE_EXAMPLES = """\
  vla-attention capture exchange pi --checkpoint pi05_cubes --task-suite cubes --task 0 1 2 3 4 5
  vla-attention capture exchange pi --checkpoint gs://openpi-assets/checkpoints/pi05_libero --task-suite libero_goal
"""
_DOCTOR_EXAMPLES = """\
  vla-attention capture doctor                                    this machine, for a run of the policy that is shipped
  vla-attention capture doctor pi --checkpoint gs://openpi-assets/checkpoints/pi05_libero --task-suite libero_10
"""


def build_parser(given: Sequence[str] = ()) -> argparse.ArgumentParser:
    """Return the parser of `vla-attention capture`. In parsed arguments, `command` is the function to call.

    given: what will be parsed; `rerun` takes the model options of the family whose store is among it.
    """
    families = policy_families()
    examples = "".join(family.examples for family in families)
    parser = OneSentenceParser(
        prog="vla-attention capture",
        description="Run a policy in simulation and record the attention rows of its action queries.",
        epilog=f"examples:\n{examples}{_FURTHER_EXAMPLES}",
    )
    commands = parser.add_subparsers(required=True, metavar="POLICY", parser_class=OneSentenceParser)

    def add(name: str, about: str, description: str, examples: str) -> argparse.ArgumentParser:
        epilog = f"examples:\n{examples}" if examples else None
        return commands.add_parser(name, help=about, description=description, epilog=epilog)

    for family in families:
        capture = add(family.name, family.title, family.description, family.examples + _FURTHER_EXAMPLES)
        _add_capture_arguments(capture, family)
        capture.set_defaults(command=run_capture_of_family, family=family)
    for name, (about, description, examples, add_arguments) in _COMMANDS.items():
        add_arguments(add(name, about, description, examples), given[1:] if name in given[:1] else ())
    return parser


@dataclass(frozen=True)
class ClusterSettings:
    """What the published scripts' commands are asked as jobs of a cluster."""

    stage: Literal["capture", "analyze", "both"] | None = option(
        "what to do (default: both; in an array job capture, as all of its tasks fill one store)",
        None,
        group="as a job of a cluster (see docs/my-cluster.md)",
    )
    array_index: int | None = option(
        "index in an array job: a task, counted through the suites of 'all'", None, least=0
    )
    max_requeues: int = option(
        "after SIGTERM put the SLURM job back into the queue, at most N times (default: %(default)s)", 0, least=0
    )
    from_environment: bool = option(
        "also read the variables of scripts/run_attention_ratio*.sh (CHECKPOINT, TASK_SUITE, LAYERS ...); see their "
        "heads",
        False,
    )


def build_evaluate_parser(family: PolicyFamily, script: PublishedScript) -> argparse.ArgumentParser:
    """Return the parser of a published script: the family's, with the script's defaults and cluster options."""
    parser = OneSentenceParser(
        prog=script.program,
        description=f"{family.description} Then analyse, with the arguments of the published script. All layers are "
        "recorded, so that other --layers need no second capture; an existing store is continued with what is missing.",
    )
    _add_capture_arguments(parser, family, script)
    add_options(parser, ClusterSettings)
    parser.set_defaults(family=family, checkpoint=script.checkpoint, task_suite="libero_10", resume=True)
    return parser


@dataclass(frozen=True)
class ExchangeSettings:
    """What an exchange is asked beside a capture."""

    most_rollouts: int = option(
        "most rollouts; more of them are an error before the first (default: %(default)s)",
        100,
        group="evaluation",
        name="rollouts",
        dest="most_rollouts",
        least=1,
    )


def _add_exchange_arguments(parser: argparse.ArgumentParser, given: Sequence[str]) -> None:
    """Add all options. given: what will be parsed; the policy among it decides the model's options."""
    family = _add_policy_argument(parser, given)
    _add_capture_arguments(parser, family)
    add_options(parser, ExchangeSettings)
    parser.set_defaults(command=run_capture_of_family, family=family, num_episodes=1)


def _add_policy_argument(parser: argparse.ArgumentParser, given: Sequence[str]) -> PolicyFamily:
    families, default = {family.name: family for family in policy_families()}, default_family()
    text = f"{', '.join(families)} (default: {default.name}), then the options of the run"
    parser.add_argument("policy", nargs="?", choices=[*families], default=default.name, metavar="POLICY", help=text)
    return next((families[word] for word in given if word in families), default)


def _add_capture_arguments(
    parser: argparse.ArgumentParser, family: PolicyFamily, script: PublishedScript | None = None
) -> None:
    """Add all options of a capture with one policy family; `script`: of a published script instead."""
    names, default = ", ".join(suite.name for suite in SUITES if not suite.perturbs), "a store in runs"
    names += ", libero_pro_{spatial,object,goal,10}_{lan,object,swap,task}"
    seeds = ", ".join(f"{protocol.default_seed} for {protocol.name}" for protocol in family.protocols)
    suites, layers, resumed = f"one of {names}", "block indices (default: all)", ""
    if script:
        suites = f"one of {names}, or {ALL_SUITES} for {listing(STANDARD_SUITES)}"
        layers = f"layers to analyse; all are recorded (default: {' '.join(map(str, script.layers))})"
        default, resumed = f"the folder results/attention_ratio_{family.store_prefix}SUITE", " (default)"
    protocols = [protocol.name for protocol in family.protocols]
    add_options(parser, family.settings)
    add_options(
        parser,
        RunSettings,
        suite={"help": f"{suites} (default: %(default)s)", "default": family.default_suite},
        protocol={"choices": protocols, "metavar": None} if len(protocols) > 1 else None,
        seed=f"{family.seed_of} (default: {seeds})",
        replan_steps=f"actions executed per policy call (default: {family.replan_default})",
    )
    add_options(parser, RecordingSettings, layers=layers + family.layers_note)
    add_effect_options(parser)
    add_options(parser, InterventionSettings)
    add_options(
        parser,
        CaptureOutput,
        store=f"the store, NAME.zarr, or a folder: for the store {family.store_prefix}SUITE.zarr and the results of an "
        f"analysis that runs afterwards; may be given twice, once for each (default: {default})",
        resume=f"continue an existing store with what is missing{resumed}",
    )


def _add_doctor_arguments(parser: argparse.ArgumentParser, given: Sequence[str]) -> None:
    """Add all options. given: what will be parsed; a policy among it decides the model's options."""
    family = _add_policy_argument(parser, given)
    _add_capture_arguments(parser, family)
    parser.set_defaults(command=_run_doctor, family=family)


def _run_doctor(arguments: argparse.Namespace, termination: Termination) -> int:
    threads = use_threads(arguments.threads)  # before torch is loaded

    from vla_attention.capture.run.doctor import run_doctor

    return run_doctor(arguments, threads)


def _add_status_arguments(parser: argparse.ArgumentParser, given: Sequence[str]) -> None:
    parser.add_argument("stores", nargs="+", type=Path, metavar="STORE", help="one or several NAME.zarr")
    parser.add_argument("--json", action="store_true", help="print everything as JSON")
    parser.add_argument(
        "--expected", type=int, metavar="N", help="episodes of each task (default: as the runs planned)"
    )
    parser.add_argument("--check", action="store_true", help="exit code 1 if an expected episode is missing or damaged")
    parser.add_argument("--verify", action="store_true", help=VERIFY_HELP)
    parser.set_defaults(command=_run_status)


def _run_status(arguments: argparse.Namespace, termination: Termination) -> int:
    from vla_attention.capture.jobs.status import print_status

    return print_status(arguments.stores, arguments.expected, arguments.json, arguments.check, arguments.verify)


def _add_verify_arguments(parser: argparse.ArgumentParser, given: Sequence[str]) -> None:
    verify_command.add_verify_arguments(parser)
    parser.set_defaults(command=lambda arguments, termination: verify_command.run_verify_command(arguments))


def _add_tasks_arguments(parser: argparse.ArgumentParser, given: Sequence[str]) -> None:
    parser.add_argument("suite", metavar="SUITE", help="task suite")
    parser.add_argument("--array", action="store_true", help="only the range of ids, as sbatch --array takes it")
    parser.set_defaults(command=_run_tasks)


def _run_tasks(arguments: argparse.Namespace, termination: Termination) -> int:
    """Print a line per task, or with `--array` the range of task ids, which needs no simulator (login nodes)."""
    if arguments.array:
        names = STANDARD_SUITES if arguments.suite == ALL_SUITES else (arguments.suite,)
        print(f"0-{sum(find_suite(name).num_tasks for name in names) - 1}")
        return 0
    if arguments.suite == ALL_SUITES:
        raise BadArgument(f"'{ALL_SUITES}' is for --array only; name one suite.")
    for task in list_tasks(find_suite(arguments.suite)):
        print(f"{task.task_id:>3}  {task.instruction}")
    return 0


def _add_slurm_arguments(parser: argparse.ArgumentParser, given: Sequence[str]) -> None:
    parser.add_argument(
        "folder",
        nargs="?",
        type=Path,
        default=Path("scripts"),
        metavar="FOLDER",
        help="where to (default: %(default)s)",
    )
    parser.set_defaults(command=_run_slurm)


def _run_slurm(arguments: argparse.Namespace, termination: Termination) -> int:
    from vla_attention.capture.jobs.batch_scripts import write_batch_scripts

    return write_batch_scripts(arguments.folder)


#: Commands beside those of the policy families: what each is for, in a line and in sentences, examples, and what adds
#: its arguments to a parser, which may go by the words that will be parsed.
_COMMANDS: dict[str, tuple[str, str, str, Callable[[argparse.ArgumentParser, Sequence[str]], None]]] = {
    "exchange": (
        "put the robot into the scene of one task and tell it the sentence of another: does it do what it is told?",
        "Where tasks share a scene, begin with the initial state of one and tell the policy the sentence of another. "
        "Goals of all of them are watched; an episode ends when the told one is reached. Takes the options of a "
        "capture; --num-episodes is the number of initial states of each pair (default: 1), --task chooses the tasks. "
        "Any number of processes may fill one store with --resume. Then ask vla-attention language STORE.",
        _EXCHANGE_EXAMPLES,
        _add_exchange_arguments,
    ),
    "replay": (
        "make policy calls on the frames of a data set of a robot",
        "Feed the pictures, states and tasks of a LeRobotDataset (2.0, 2.1 or 3.0) to a policy, without a simulator, "
        "and record its attention into a store like any other, beside the data set's actions. See docs/my-data-set.md.",
        REPLAY_EXAMPLES,
        add_replay_arguments,
    ),
    "rerun": (
        "make the policy calls of a store again, unchanged or with interventions",
        "Give the policy of a store the same pictures, state, prompt and noise again, without a simulator. First the "
        "calls of one episode are made again unchanged, and their distance from the stored ones is printed. With "
        "interventions, or with --output, the calls of all episodes go into a store like any other.",
        RERUN_EXAMPLES,
        add_rerun_arguments,
    ),
    "status": (
        "what a store holds, what is missing, and who is writing",
        "Episodes committed and expected per task, success, size, last writer, what is missing, being written, or "
        "damaged and why. Reads only; works while captures run, and needs neither torch nor a GPU.",
        "",
        _add_status_arguments,
    ),
    "doctor": (
        "what this machine can do for a run, and what is missing for it",
        "Takes the options of a capture and prints a line for everything that it needs: memory, simulator and assets, "
        "drawing, disk, GPU, checkpoint, each with what to do. Loads no policy and runs no simulator. Exit code 1 when "
        "something is missing.",
        _DOCTOR_EXAMPLES,
        _add_doctor_arguments,
    ),
    "verify": (
        "read stores back and check every file, digest and row sum",
        verify_command.DESCRIPTION,
        verify_command.EXAMPLES.removeprefix("examples:\n").replace("NAME", "vla-attention capture"),
        _add_verify_arguments,
    ),
    "slurm": (
        "write the batch scripts of a SLURM cluster into a folder",
        "One job, or a job per task into one store and an analysis after them; their options are environment "
        "variables. See docs/my-cluster.md.",
        "",
        _add_slurm_arguments,
    ),
    "tasks": ("the tasks of a suite", "The tasks of a suite by their ids.", "", _add_tasks_arguments),
}
