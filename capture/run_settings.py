"""Settings of a capture, from command-line arguments.

Imports nothing heavy: mistakes in the arguments are reported before torch is loaded.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from vla_attention.capture.budget import Fixed, parse_budget
from vla_attention.capture.environments.base import Suite, check_task_id
from vla_attention.capture.environments.episode_protocol import EvaluationProtocol
from vla_attention.capture.environments.suites import find_suite
from vla_attention.capture.interventions.arguments import read_interventions
from vla_attention.capture.policies.family import PolicyFamily
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.interventions import Interventions
from vla_attention.schemas.precision import DEFAULT_MANTISSA_BITS, parse_precision
from vla_attention.schemas.stores.store_format import STORE_SUFFIX
from vla_attention.schemas.stores.store_place import check_place

if TYPE_CHECKING:
    from vla_attention.capture.store.store_writer import WriteMode


#: The denoise steps that are recorded unless others are asked for.
DEFAULT_STEPS = ("first", "last")


@dataclass(frozen=True)
class RecordingSettings:
    """What is recorded of each policy call; None means everything."""

    layers: tuple[int, ...] | None = None
    denoise_steps: tuple[str, ...] = DEFAULT_STEPS
    heads: tuple[int, ...] | None = None
    queries: str = "mean"
    mantissa_bits: int = DEFAULT_MANTISSA_BITS
    frames: bool = True
    contributions: bool = True


@dataclass(frozen=True)
class RunSettings:
    """Which episodes are run, and into which store.

    task_ids: None runs all tasks of the suite. protocol: the published evaluation that is followed; None takes that of
    the policy. seed, replan_steps, max_steps: None takes the protocol's number. array_task_ids: tasks that
    other processes of the same array job run; the store is expected to hold these too. verify: read every byte of the
    episodes that an existing store has, before they count as done. interventions: what is changed, with layer
    numbers as typed. allow_empty: leave a replan unchanged where a group of an intervention has no key. num_envs:
    simulators that run at a time; None takes as many as there are cores. budget: bytes of the store; what `fixed`
    leaves open of the recording is chosen to fit. None: no choice is made.
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
    budget: int | None = None
    fixed: Fixed = field(default_factory=Fixed)
    policy_batch: int | None = None


def run_settings(arguments: argparse.Namespace) -> RunSettings:
    """Return the settings of parsed arguments; checks everything that needs no policy."""
    suite = find_suite(arguments.task_suite)
    for task_id in arguments.task_id or ():
        check_task_id(suite, task_id)
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
        task_ids=None if arguments.task_id is None else tuple(sorted(set(arguments.task_id))),
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
        budget=None if arguments.budget is None else parse_budget(arguments.budget),
        fixed=Fixed(
            precision=arguments.precision is not None,
            denoise_steps=arguments.denoise_steps is not None,
            layers=arguments.layers is not None,
            heads=arguments.heads is not None,
        ),
        policy_batch=arguments.policy_batch,
    )


def recording_settings(arguments: argparse.Namespace) -> RecordingSettings:
    """Return what the options of `recording_arguments.py` say."""
    return RecordingSettings(
        layers=None if arguments.layers is None else tuple(arguments.layers),
        denoise_steps=DEFAULT_STEPS if arguments.denoise_steps is None else tuple(arguments.denoise_steps),
        heads=None if arguments.heads is None else tuple(arguments.heads),
        queries=arguments.queries,
        mantissa_bits=DEFAULT_MANTISSA_BITS if arguments.precision is None else parse_precision(arguments.precision),
        frames=not arguments.no_frames,
        contributions=arguments.contributions,
    )


def _protocol(arguments: argparse.Namespace) -> EvaluationProtocol | None:
    name = getattr(arguments, "protocol", None)  # a family with a single protocol has no such option
    return next((protocol for protocol in arguments.family.protocols if protocol.name == name), None)


def store_path(arguments: argparse.Namespace) -> Path:
    """Return the store's path: --store, else the name of family and suite, in --output-dir or `runs`."""
    if arguments.store is not None:
        return Path(arguments.store)
    family: PolicyFamily = arguments.family
    name = f"{family.store_prefix}{arguments.task_suite}{STORE_SUFFIX}"
    return (arguments.output_dir or Path("runs")) / name
