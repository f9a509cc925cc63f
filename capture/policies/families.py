"""The registry of policy families. A new family is a folder beside this file and one line in `FAMILY_MODULES`."""

from __future__ import annotations

from importlib import import_module

from vla_attention.capture.policies.family import PolicyFamily
from vla_attention.schemas.errors import look_up

#: Modules with a `FAMILY`. `--help` imports them, so they import neither torch nor numpy at the top.
FAMILY_MODULES = (
    "vla_attention.capture.policies.cosmos.family",
    "vla_attention.capture.policies.pi.family",
)


def policy_families() -> tuple[PolicyFamily, ...]:
    """Return every registered family, in the order of the help text."""
    return tuple(import_module(module).FAMILY for module in FAMILY_MODULES)


def default_family() -> PolicyFamily:
    """Return the family of the trained policy that is shipped."""
    return next(family for family in policy_families() if any(name in family.built_in for name in family.trained_on))


def family_of_kind(kind: str) -> PolicyFamily:
    """Return the family whose policies stores name `kind`; `UnknownName` lists the kinds of all families."""
    kinds = {known: family for family in policy_families() for known in family.kinds or (family.name,)}
    return look_up("kind of policy", kind, kinds)
