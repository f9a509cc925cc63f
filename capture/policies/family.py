"""What a policy family brings: its command-line arguments, how a policy is built, parity cases, and its published script.

Each family has a module `family.py` with one `PolicyFamily`. Importing it must be cheap, because every command line does so: torch
and the model's code are imported inside `build` and the parity command.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from vla_attention.capture.policies.policy import Policy


@dataclass(frozen=True)
class ParityCases:
    """The cases of a family that `vla-capture parity CASE` runs.

    recognises: tells from the content of a case.json whether the case is of this family. run: takes the parsed arguments and the
    device, prints the differences, and returns the exit code. formats: the names that `--format` takes; empty when it is refused.
    default_limit: the largest difference that passes, for the help text of `--limit`; empty when that option is refused.
    """

    recognises: Callable[[Mapping[str, Any]], bool]
    run: Callable[[argparse.Namespace, str], int]
    formats: tuple[str, ...] = ()
    default_limit: str = ""


@dataclass(frozen=True)
class PublishedScript:
    """The published script whose command line a family keeps, with the defaults of that script.

    program: the console script. checkpoint, layers: what it loads and analyses by default. variables: environment variables of
    its batch script that no other family has, and the option that each one sets.
    """

    program: str
    checkpoint: str
    layers: tuple[int, ...]
    variables: Mapping[str, str] = field(default_factory=dict)


def no_arguments(arguments: argparse.Namespace) -> list[str]:
    """Return no arguments for the analysis: its own defaults fit."""
    return []


@dataclass(frozen=True)
class PolicyFamily:
    """One policy family on the command line.

    name: the command, as in `vla-capture NAME`. title, description, examples: of its help text. add_arguments: adds the options
    that choose and configure the model; one of them has to set `arguments.checkpoint`, another one `arguments.device`
    (see `model_arguments.py`). build: makes the policy from the parsed arguments, on a device.
    store_prefix: begins the names of its stores and results folders, so that runs of two families on one suite stay apart.
    untrained: checkpoints that come with the program and run without a GPU.
    replan_default, layers_note: parts of the help texts of `--replan-steps` and `--layers`.
    analysis_arguments: what an analysis that follows a capture is given, beside the store and the output folder.
    """

    name: str
    title: str
    description: str
    examples: str
    add_arguments: Callable[[argparse.ArgumentParser], None]
    build: Callable[[argparse.Namespace, str], Policy]
    store_prefix: str
    replan_default: str
    layers_note: str = ""
    untrained: tuple[str, ...] = ()
    analysis_arguments: Callable[[argparse.Namespace], list[str]] = no_arguments
    parity: ParityCases | None = None
    published: PublishedScript | None = None
