"""Typical first words that are none of ours, with what to type instead."""

from __future__ import annotations

from collections.abc import Sequence

from vla_attention.capture.policies.families import policy_families
from vla_attention.schemas.errors import BadArgument

#: Policies that are called from their user's own code.
_OWN_CODE = (
    "smolvla", "openvla", "openvla-oft", "act", "xvla", "x-vla", "gr00t", "groot", "evo1", "diffusion", "tinyvla",
)  # fmt: skip


def refuse_other_tools_words(words: Sequence[str]) -> None:
    """Raise `BadArgument` for a policy's name in the place of a command, and for --episodes."""
    first = words[0].casefold() if words else ""
    for family in policy_families():
        if first != family.name and first.replace(".", "") in family.kinds:
            command = f"vla-attention capture {family.name} --checkpoint PATH"
            raise BadArgument(f"There is no command '{words[0]}': use {command}.")
    if first in _OWN_CODE:
        raise BadArgument(
            f"There is no command '{words[0]}': a policy that no family knows is recorded from your own code, "
            "with va.record, or over a data set, with vla-attention capture replay DATASET --policy FILE.py "
            "(docs/my-policy.md)."
        )
    named = [word.partition("=")[0] for word in words]
    if first not in ("replay", "doctor", "tasks") and "--episodes" in named:
        raise BadArgument("There is no --episodes: --num-episodes N is how many of each task, --task which tasks.")
