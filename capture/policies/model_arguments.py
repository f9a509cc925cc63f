"""The options of the `model` group that every family has."""

from __future__ import annotations

import argparse

from vla_attention.schemas.threads import add_threads

#: The two untrained policies that come with the program: a small one, and a smaller one for tests.
UNTRAINED = "untrained"
UNTRAINED_TINY = "untrained-tiny"
UNTRAINED_POLICIES = (UNTRAINED, UNTRAINED_TINY)
#: What `--threads` says of the policy.
POLICY_THREADS = "processor threads of the policy (default: OMP_NUM_THREADS, else the cores that this process may use)"


def add_model_arguments(
    parser: argparse.ArgumentParser,
    *,
    checkpoint: str,
    config_name: str,
    dtype_default: str,
    default: str = UNTRAINED,
    checkpoint_options: tuple[str, ...] = ("--checkpoint",),
) -> argparse._ArgumentGroup:
    """Add the group `model` with checkpoint, configuration, precision and device, and return the group.

    checkpoint, config_name: help texts of these options. default: of the first one. checkpoint_options: the spellings
    of the first one.
    """
    group = parser.add_argument_group("model")
    group.add_argument(
        *checkpoint_options,
        dest="checkpoint",
        default=default,
        metavar="PATH",
        help=f"{checkpoint}; '{UNTRAINED}' and '{UNTRAINED_TINY}' have random weights and come along (default: "
        "%(default)s)",
    )
    group.add_argument("--config-name", metavar="NAME", help=config_name)
    group.add_argument("--dtype", metavar="NAME", help=f"float32 or bfloat16 (default: {dtype_default})")
    group.add_argument("--device", default="auto", help="auto (default: a GPU if there is one), cpu, cuda, cuda:1 ...")
    add_threads(group, POLICY_THREADS)
    return group
