"""Command-line arguments of `vla-capture`, and their translation into settings."""

from __future__ import annotations

import argparse
from pathlib import Path

from vla_attention.capture.environments.base import EnvironmentSettings, check_task_id
from vla_attention.capture.environments.suites import ALL_SUITES, STANDARD_SUITES, SUITES, find_suite
from vla_attention.capture.settings import RecordingSettings, RunSettings
from vla_attention.schemas.command_line import OneSentenceParser
from vla_attention.schemas.errors import BadArgument, listing
from vla_attention.schemas.precision import DEFAULT_MANTISSA_BITS, parse_precision
from vla_attention.schemas.stores.store_format import STORE_SUFFIX

EMBEDDED = "embedded"
DUMMY = "dummy"

_EXAMPLES = """examples:
  vla-capture pi                                             embedded untrained policy, built-in tasks
  vla-capture pi --checkpoint ~/.cache/openpi/openpi-assets/checkpoints/pi05_libero \\
      --task-suite libero_10 --num-episodes 5 --output-dir results/attention_ratio
  vla-capture pi --checkpoint lerobot/pi05_libero_finetuned --tokenizer PATH --task-suite libero_10
  vla-capture pi --task-suite libero_10 --task-id 0 --num-episodes 1 --max-steps 40 --libero-assets PATH
  vla-capture status runs/libero_10.zarr                     what is there, what is missing, who is writing
  vla-capture parity CASE --format orbax                     our numbers against a reference's, on your own checkpoint
"""


#: Policy family -> (one word for a list, what the command does).
_FAMILIES = {
    "cosmos": (
        "Cosmos Policy",
        "Record a Cosmos Policy: self-attention over latent frames, cross-attention over text.",
    ),
    "pi": ("pi0 or pi0.5", "Record a pi0 or pi0.5 policy."),
}
#: What the published scripts load unless told otherwise.
PUBLISHED_CHECKPOINTS = {
    "pi": "~/.cache/openpi/openpi-assets/checkpoints/pi05_libero",
    "cosmos": "nvidia/Cosmos-Policy-LIBERO-Predict2-2B",
}
#: The layers that they analyse unless told otherwise.
PUBLISHED_LAYERS = (25, 26, 27)


def build_parser() -> argparse.ArgumentParser:
    """The parser of `vla-capture`."""
    parser = OneSentenceParser(
        prog="vla-capture",
        description="Run a policy in simulation and record the attention rows of its action queries.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    families = parser.add_subparsers(dest="policy", required=True, metavar="POLICY", parser_class=OneSentenceParser)
    for family, (title, description) in _FAMILIES.items():
        _add_capture_arguments(
            families.add_parser(
                family,
                help=title,
                description=description,
                epilog=_EXAMPLES,
                formatter_class=argparse.RawDescriptionHelpFormatter,
            ),
            family,
        )
    parity = families.add_parser(
        "parity",
        help="compare a pi model with what a reference implementation computed",
        description="Run a case folder (case.json, a checkpoint, inputs.npz, expected.npz) and print the largest differences. "
        "Exit code 0: all within the limit, 1: beyond it, 2: the case cannot be used.",
    )
    _add_parity_arguments(parity)
    status = families.add_parser(
        "status",
        help="what a store holds, what is missing, and who is writing",
        description="Episodes committed and expected per task, success, size, last writer, what is missing and what is being written. "
        "Reads only; works while captures run, and needs neither torch nor a GPU.",
    )
    _add_status_arguments(status)
    tasks = families.add_parser("tasks", help="the tasks of a suite", description="The tasks of a suite by their ids.")
    tasks.add_argument("suite", metavar="SUITE", help="task suite")
    tasks.add_argument("--array", action="store_true", help="only the range of ids, as sbatch --array takes it")
    return parser


def build_evaluate_parser(program: str, family: str) -> argparse.ArgumentParser:
    """The parser of `evaluate-attention-ratio` (family "pi") and `evaluate-attention-ratio-cosmos` ("cosmos")."""
    parser = OneSentenceParser(
        prog=program,
        description=f"{_FAMILIES[family][1]} Then analyse, with the arguments of the published script. All layers are recorded, so "
        "that other --layers need no second capture; an existing store is continued with what is missing.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    _add_capture_arguments(parser, family, evaluate=True)
    job = parser.add_argument_group("as a job of a cluster (see docs/cluster.md)")
    job.add_argument(
        "--stage",
        choices=("capture", "analyze", "both"),
        help="what to do (default: both; in an array job capture, as all of its tasks fill one store)",
    )
    job.add_argument(
        "--array-index",
        type=int,
        metavar="N",
        help="index in an array job: a task, counted through the suites of 'all'",
    )
    job.add_argument(
        "--max-requeues",
        type=int,
        default=0,
        metavar="N",
        help="after SIGTERM put the SLURM job back into the queue, at most N times (default: 0)",
    )
    job.add_argument(
        "--from-environment",
        action="store_true",
        help="also read the variables of scripts/run_attention_ratio*.sh (CHECKPOINT, TASK_SUITE, LAYERS ...); see their heads",
    )
    parser.set_defaults(
        policy=family, checkpoint=PUBLISHED_CHECKPOINTS[family], task_suite="libero_10", resume=True, store=None
    )
    return parser


def _add_capture_arguments(parser: argparse.ArgumentParser, family: str, evaluate: bool = False) -> None:
    """Everything that capturing with one policy family takes."""
    (_add_pi_arguments if family == "pi" else _add_cosmos_arguments)(parser)
    _add_run_arguments(parser, evaluate)
    _add_recording_arguments(parser, evaluate)
    _add_store_arguments(parser, evaluate)


def _add_status_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("stores", nargs="+", type=Path, metavar="STORE", help="one or several NAME.zarr")
    parser.add_argument("--json", action="store_true", help="print everything as JSON")
    parser.add_argument(
        "--expected",
        type=int,
        metavar="N",
        help="episodes expected per task (default: what the runs that filled the store planned)",
    )
    parser.add_argument("--check", action="store_true", help="exit code 1 when an expected episode is missing")


def _add_cosmos_arguments(parser: argparse.ArgumentParser) -> None:
    model = parser.add_argument_group("model")
    model.add_argument(
        "--ckpt-path",
        "--checkpoint",
        dest="checkpoint",
        default=EMBEDDED,
        metavar="PATH",
        help="checkpoint folder, ORG/NAME on the Hugging Face hub, or a file of weights; "
        f"'{EMBEDDED}' is a small untrained policy that comes with the tool, '{DUMMY}' a smaller one (default: %(default)s)",
    )
    model.add_argument("--config-name", metavar="NAME", help="the reference's name for the configuration")
    model.add_argument("--dataset-stats-path", metavar="PATH", help="statistics (default: the checkpoint's own)")
    model.add_argument(
        "--t5-text-embeddings-path", metavar="PATH", help="precomputed embeddings (default: the checkpoint's own)"
    )
    model.add_argument(
        "--t5-tokenizer", metavar="PATH", help="T5's spiece.model: makes words of the instruction selectable"
    )
    model.add_argument(
        "--t5-encoder", metavar="PATH", help="T5 model folder, for instructions without a precomputed embedding"
    )
    model.add_argument("--vae-path", metavar="PATH", help="image encoder's weights (default: the checkpoint's own)")
    model.add_argument("--num-denoising-steps-action", type=int, metavar="N", help="denoise steps (default: 5)")
    model.add_argument("--chunk-size", type=int, metavar="N", help="actions of a call (default: 16)")
    model.add_argument(
        "--num-open-loop-steps", type=int, metavar="N", help="actions executed per call (default: the chunk)"
    )
    model.add_argument("--dtype", metavar="NAME", help="float32 or bfloat16 (default: bfloat16 on a GPU)")
    model.add_argument("--device", default="auto", help="auto (default: a GPU if there is one), cpu, cuda, cuda:1 ...")
    frames = parser.add_argument_group("frames of the published proxy (the store keeps all of them)")
    frames.add_argument(
        "--query-frame", default="action", metavar="NAME", help="whose queries are recorded (default: action)"
    )
    frames.add_argument(
        "--visual-frame", default="curr_last", metavar="NAME", help="numerator frame (default: curr_last)"
    )
    frames.add_argument(
        "--text-frame", default="frame0", metavar="NAME", help="denominator frame (default: frame0, a blank one)"
    )
    frames.add_argument(
        "--prefer-S", dest="prefer_s", type=int, metavar="N", help="length that the analysed call must have"
    )
    frames.add_argument("--prefer-call", default="last", metavar="NAME", help="last (default) or first of those calls")


def _add_parity_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("case", type=Path, metavar="CASE", help="case folder")
    parser.add_argument(
        "--format", metavar="NAME", help="orbax, openpi or lerobot (default: every format that the case carries)"
    )
    parser.add_argument("--json", action="store_true", help="print the result as JSON")
    parser.add_argument(
        "--limit",
        type=float,
        metavar="X",
        help="largest difference that passes (default: 5e-5; 0.1 for bfloat16 cases)",
    )
    parser.add_argument("--device", default="cpu", help="auto, cpu (default), cuda, cuda:1 ...")


def _add_pi_arguments(parser: argparse.ArgumentParser) -> None:
    model = parser.add_argument_group("model")
    model.add_argument(
        "--checkpoint",
        default=EMBEDDED,
        metavar="PATH",
        help="checkpoint folder of openpi (JAX or PyTorch) or LeRobot, ORG/NAME on the Hugging Face hub, or gs://...; "
        f"'{EMBEDDED}' is a small untrained policy that comes with the tool, '{DUMMY}' a smaller one for trying things out "
        "(default: %(default)s)",
    )
    model.add_argument(
        "--checkpoint-format",
        metavar="NAME",
        help="openpi_torch, openpi_jax or lerobot (default: recognised from the files)",
    )
    model.add_argument(
        "--config-name", metavar="NAME", help="openpi's name for the configuration (pi05_libero, pi0_libero ...)"
    )
    model.add_argument(
        "--model-config",
        type=Path,
        metavar="PATH",
        help="JSON file with the sizes that a checkpoint does not state (default: a case.json beside the checkpoint, if any)",
    )
    model.add_argument(
        "--discrete-state-input", action="store_true", help="openpi's pi0.5 trained with the state in its prompt"
    )
    model.add_argument(
        "--dtype",
        metavar="NAME",
        help="float32 or bfloat16 (default: what a LeRobot checkpoint says, else float32)",
    )
    model.add_argument("--tokenizer", metavar="PATH", help="sentencepiece model of the policy's language model")
    model.add_argument("--paligemma-variant", metavar="NAME", help="checked against the checkpoint (gemma_2b ...)")
    model.add_argument(
        "--action-expert-variant", metavar="NAME", help="checked against the checkpoint (gemma_300m ...)"
    )
    model.add_argument("--device", default="auto", help="auto (default: a GPU if there is one), cpu, cuda, cuda:1 ...")
    model.add_argument("--num-image-tokens", type=int, metavar="N", help="checked against the policy's layout")


def _add_run_arguments(parser: argparse.ArgumentParser, evaluate: bool) -> None:
    run = parser.add_argument_group("evaluation")
    names = ", ".join(suite.name for suite in SUITES)
    which = f"one of {names} (default: robosuite)"
    if evaluate:
        which = f"one of {names}, or {ALL_SUITES} for {listing(STANDARD_SUITES)} (default: libero_10)"
    run.add_argument("--task-suite", default="robosuite", metavar="SUITE", help=which)
    run.add_argument("--task-id", type=int, metavar="N", help="a single task (default: all tasks of the suite)")
    run.add_argument("--num-episodes", type=int, default=5, metavar="N", help="episodes per task (default: 5)")
    run.add_argument("--seed", type=int, default=7, help="seed of the simulator and of all noise (default: 7)")
    run.add_argument(
        "--replan-steps",
        type=int,
        metavar="N",
        help="actions executed per policy call (default: 5 for openpi, n_action_steps for LeRobot)",
    )
    run.add_argument(
        "--max-steps", type=int, metavar="N", help="steps after waiting (default: the suite's published number)"
    )
    run.add_argument(
        "--libero-assets", type=Path, metavar="PATH", help="LIBERO asset folder (or set VLA_LIBERO_ASSETS)"
    )


def _add_recording_arguments(parser: argparse.ArgumentParser, evaluate: bool) -> None:
    attention = parser.add_argument_group("what is recorded")
    which = "layers to analyse; all are recorded (default: 25 26 27)" if evaluate else "block indices (default: all)"
    attention.add_argument(
        "--layers",
        type=int,
        nargs="+",
        metavar="N",
        help=f"{which}; for pi also the published scripts' numbers 18..35 (25 = block 7)",
    )
    attention.add_argument(
        "--denoise-steps",
        nargs="+",
        default=["first", "last"],
        metavar="STEP",
        help="numbers, first, last or all (default: first last)",
    )
    attention.add_argument("--heads", type=int, nargs="+", metavar="N", help="attention heads (default: all)")
    attention.add_argument(
        "--queries",
        default="mean",
        help="mean over the action queries (default), steps (one mean per action step), or all",
    )
    attention.add_argument(
        "--precision",
        default=str(DEFAULT_MANTISSA_BITS),
        metavar="BITS",
        help=f"mantissa bits kept of each probability, or 'exact' (default: {DEFAULT_MANTISSA_BITS}, "
        "which bounds the error of every ratio by 0.1 %%)",
    )
    attention.add_argument(
        "--contributions",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="also record what each part of the keys adds to the residual stream, value-weighted (default: yes)",
    )
    attention.add_argument("--no-frames", action="store_true", help="do not store the model's input images")


def _add_store_arguments(parser: argparse.ArgumentParser, evaluate: bool) -> None:
    output = parser.add_argument_group("output")
    output.add_argument(
        "--store",
        type=Path,
        metavar="NAME.zarr",
        help=f"store to write (default: {'in --output-dir' if evaluate else 'runs'}, SUITE.zarr or cosmos_SUITE.zarr)",
    )
    where = "default: results/attention_ratio_SUITE or results/attention_ratio_cosmos_SUITE"
    output.add_argument(
        "--output-dir",
        type=Path,
        metavar="PATH",
        help="folder for the store (unless --store is given) and for the results of "
        + (f"the analysis; {where}" if evaluate else "an analysis that runs afterwards"),
    )
    output.add_argument("--save-viz", action="store_true", help="analyse afterwards, with pictures of every episode")
    existing = output.add_mutually_exclusive_group()
    resume = "continue an existing store with what is missing" + (" (default)" if evaluate else "")
    existing.add_argument("--resume", action="store_true", help=resume)
    existing.add_argument("--overwrite", action="store_true", help="delete an existing store first")


def run_settings(arguments: argparse.Namespace) -> RunSettings:
    """Check the arguments that need no policy and turn them into settings."""
    suite = find_suite(arguments.task_suite)
    if arguments.task_id is not None:
        check_task_id(suite, arguments.task_id)
    if arguments.num_episodes < 1:
        raise BadArgument(f"Cannot use --num-episodes {arguments.num_episodes}; expected at least 1.")
    if arguments.seed < 0:
        raise BadArgument(f"Cannot use --seed {arguments.seed}; expected 0 or more.")
    return RunSettings(
        suite=suite,
        task_id=arguments.task_id,
        num_episodes=arguments.num_episodes,
        seed=arguments.seed,
        replan_steps=arguments.replan_steps,
        max_steps=suite.max_steps if arguments.max_steps is None else arguments.max_steps,
        store=store_path(arguments),
        mode="overwrite" if arguments.overwrite else "resume" if arguments.resume else "new",
        environment=EnvironmentSettings(libero_assets=arguments.libero_assets),
        recording=RecordingSettings(
            layers=None if arguments.layers is None else tuple(arguments.layers),
            denoise_steps=tuple(arguments.denoise_steps),
            heads=None if arguments.heads is None else tuple(arguments.heads),
            queries=arguments.queries,
            mantissa_bits=parse_precision(arguments.precision),
            frames=not arguments.no_frames,
            contributions=arguments.contributions,
        ),
    )


def store_path(arguments: argparse.Namespace) -> Path:
    """Where the store goes: --store, else a name made of the suite in --output-dir or `runs`."""
    if arguments.store is not None:
        return Path(arguments.store)
    # Runs of two policies on one suite must not meet in one store.
    prefix = "" if arguments.policy == "pi" else f"{arguments.policy}_"
    return (arguments.output_dir or Path("runs")) / f"{prefix}{arguments.task_suite}{STORE_SUFFIX}"
