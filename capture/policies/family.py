"""The entry of a policy family: its options, how a policy is built, its published script.

Each family has a module `family.py` with one `PolicyFamily`. Importing it must be cheap, because every command line
does so: torch and the model's code are imported inside `build`.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, Any, Literal

from vla_attention.capture.environments.episode_protocol import OPENPI, EvaluationProtocol
from vla_attention.schemas.errors import BadArgument, listing
from vla_attention.schemas.options import option, read_options

if TYPE_CHECKING:
    from vla_attention.capture.policies.policy import Policy
    from vla_attention.schemas.stores.store_format import PolicyIdentity


#: The two untrained policies that come with the program: a small one, and a smaller one for tests.
UNTRAINED = "untrained"
UNTRAINED_TINY = "untrained-tiny"
UNTRAINED_POLICIES = (UNTRAINED, UNTRAINED_TINY)


def checkpoint_option(text: str, default: str = UNTRAINED, **more: Any) -> Any:
    """`--checkpoint`, the first field of a family's settings; text: what it takes besides the untrained policies."""
    untrained = f"'{UNTRAINED}' and '{UNTRAINED_TINY}' have random weights and are shipped"
    return option(f"{text}; {untrained} (default: %(default)s)", default, group="model", metavar="PATH", **more)


@dataclass(frozen=True)
class ModelSettings:
    """Which model is loaded, in which precision and where. A family's own class says what it takes as a checkpoint.

    instructions: what the policy will be told, as far as it is known; what it cannot read is an error of `build` before
    the weights are loaded.
    """

    checkpoint: str = checkpoint_option("checkpoint folder")
    config_name: str | None = option("name of the configuration", None)
    dtype: Literal["float32", "bfloat16"] | None = option("precision", None)
    device: str = option("auto (default: a GPU if there is one), cpu, cuda, cuda:1 ...", "auto", metavar="DEVICE")
    threads: int | None = option(
        "processor threads of the policy (default: OMP_NUM_THREADS, else the cores that this process may use)", None
    )

    instructions: tuple[str, ...] = ()

    def build(self, device: str) -> Policy:
        """Load the policy onto a device of torch."""
        raise NotImplementedError

    def check_files(self) -> None:
        """Raise what `build` would where a local checkpoint lacks files; loads nothing. Here nothing is known."""

    def refuse_for_untrained(self, *names: str) -> None:
        """Raise `BadArgument` if options that are for checkpoints were given for a policy that is shipped."""
        defaults = {one.name: one.default for one in fields(self)}
        given = [f"--{name.replace('_', '-')}" for name in names if getattr(self, name) != defaults[name]]
        if self.dtype == "bfloat16":
            given.append("--dtype bfloat16")
        if given:
            raise BadArgument(
                f"Cannot use {listing(given)} with the policy '{self.checkpoint}', which comes with the program, in "
                "float32; leave out what is for checkpoints only."
            )

    def analysis_arguments(self) -> list[str]:
        """Return further arguments of an analysis that follows the capture."""
        return []

    @staticmethod
    def of_store(identity: PolicyIdentity) -> dict[str, Any]:
        """Return the settings with which `build` makes the policy of a store again; the others have their defaults."""
        return {"checkpoint": identity.checkpoint}


@dataclass(frozen=True)
class PublishedScript:
    """The published script whose command line a family keeps, with the defaults of that script.

    program: the console script. checkpoint, layers: what it loads and analyses by default. variables: environment
    variables of its batch script that no other family has, each of which sets the option of its name.
    """

    program: str
    checkpoint: str
    layers: tuple[int, ...]
    variables: tuple[str, ...] = ()


@dataclass(frozen=True)
class PolicyFamily:
    """One policy family on the command line."""

    #: the command, as in `vla-attention capture NAME`
    name: str
    #: the family in a list and in messages
    title: str
    #: one sentence for the help text
    description: str
    #: lines of examples for the help text, each ending with a newline
    examples: str
    #: what is asked of the model, and what builds it
    settings: type[ModelSettings]
    #: First part of the names of stores and results folders. Two families on one suite need different ones.
    store_prefix: str
    #: the default of `--replan-steps`, for its help text
    replan_default: str
    #: the evaluations that `--protocol` offers; each policy has one of them as its default
    protocols: tuple[EvaluationProtocol, ...] = (OPENPI,)
    #: what `--seed` decides, for its help text
    seed_of: str = "seed of the simulator and of all noise"
    #: a note on further layer numbers, for the help text of `--layers`
    layers_note: str = ""
    #: checkpoints that come with the program and run without a GPU
    built_in: tuple[str, ...] = ()
    #: the default of `--task-suite`: the one that the default checkpoint is for
    default_suite: str = "robosuite"
    published: PublishedScript | None = None
    #: The suites that checkpoints were trained on and evaluated in, by the names that `--checkpoint` takes.
    trained_on: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    #: Whether the settings have a `robot_data` (`robot.py`), with which `build` gives a policy for data sets.
    reads_data_sets: bool = False
    #: The kinds of its policies, as stores name them (`PolicyIdentity.family`); empty for the family's name alone.
    kinds: tuple[str, ...] = ()

    def read(self, given: argparse.Namespace) -> ModelSettings:
        """Return the settings of the model that parsed arguments say."""
        return read_options(self.settings, given)
