"""The module of a policy class in what a caller hands over, and what configurations of LeRobot say."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import Any

from vla_attention.schemas.errors import BadArgument, listing

_PICTURE_PREFIX = re.compile(r"observation\.images?\.?")


class NotThisPolicy(BadArgument):
    """A layout asked for a policy of another class, or with settings that it does not cover."""


def find_policy(policy: object, classes: Sequence[str], layout: str) -> tuple[str, Any]:
    """Return the path of the first module of one of these classes, as the recorder names modules, and the module.

    The path is "" for the policy itself. Classes are compared by name, also those that a class is derived from.

    Raises:
        NotThisPolicy: there is none.
    """
    from vla_attention.capture.torch_policies.policy_modules import modules_of

    modules = modules_of(policy)
    for path, module in modules.items():
        if {base.__name__ for base in type(module).__mro__} & set(classes):
            return path, module
    raise NotThisPolicy(
        f"The layout '{layout}' is for {' or '.join(classes)}, but a {type(policy).__name__} was given, with modules "
        "of "
        f"{listing(sorted({type(module).__name__ for module in modules.values()}))}. Give the policy itself, or write "
        "a layout (docs/your-policy.md)."
    )


def inside(path: str, name: str) -> str:
    """Return the path of a module inside the module at `path`."""
    return f"{path}.{name}" if path else name


def rule_path(path: str, name: str) -> str:
    """Return a rule's regular expression: the path as it is, then `name`, which is a regular expression."""
    return re.escape(path + ".") + name if path else name


def camera_name(feature: str) -> str:
    """Return the camera of LeRobot's feature: `top` of `observation.images.top`, `image` of `observation.image`."""
    name = _PICTURE_PREFIX.sub("", feature, count=1)
    return re.sub(r"[^A-Za-z0-9_-]", "_", name) or "image"


def square(side_squared: int, what: str, layout: str) -> int:
    """Return the root of a number of patches.

    Raises:
        NotThisPolicy: it has none.
    """
    side = math.isqrt(side_squared)
    if side * side != side_squared:
        raise NotThisPolicy(f"The layout '{layout}' needs square {what}, but there are {side_squared} patches.")
    return side
