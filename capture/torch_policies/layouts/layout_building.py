"""What layouts are made of: the module of a policy class, what configurations of LeRobot say, spans in order."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import Any

from vla_attention.capture.torch_policies.policy_layout import RecordedSite
from vla_attention.schemas.errors import BadArgument, listing
from vla_attention.schemas.layout import PatchGrid, SiteLayout, Span, SpanKind

_PICTURE_PREFIX = re.compile(r"observation\.images?\.?")


class NotThisPolicy(BadArgument):
    """A layout asked for a policy of another class, or with settings that it does not cover."""


def find_module(policy: object, classes: Sequence[str], layout: str) -> tuple[str, Any]:
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


class KeyOrder:
    """Collects a site's spans in the order of its keys."""

    def __init__(self) -> None:
        self.spans: list[Span] = []
        self.roles: dict[str, str] = {}

    @property
    def num_keys(self) -> int:
        """Number of keys so far."""
        return self.spans[-1].stop if self.spans else 0

    def add(self, name: str, kind: SpanKind, count: int, role: str) -> None:
        """Add `count` keys of one kind; none, no span."""
        if count:
            self.spans.append(Span(name, kind, self.num_keys, self.num_keys + count))
            self.roles[name] = role

    def add_picture(
        self, camera: str, rows: int, columns: int, height: int, width: int, role: str = "image", *, named: bool = True
    ) -> None:
        """Add a camera's patches, row by row; `named` False: of a picture that is no camera's (an empty view)."""
        start = self.num_keys
        grid = PatchGrid(rows, columns, height, width)
        stop = start + grid.num_patches
        self.spans.append(Span(camera, "image", start, stop, camera if named else None, grid if named else None))
        self.roles[camera] = role

    def add_growing(self, name: str, count: int, offset: int = 0) -> None:
        """Add the keys of generated tokens: action query q sees the first q + `offset`."""
        if count:
            start = self.num_keys
            self.spans.append(Span(name, "action", start, start + count, growing=True, growing_offset=offset))
            self.roles[name] = "action"

    def site(
        self,
        name: str,
        queries: tuple[int, int | None],
        *,
        layers: tuple[int, ...] = (),
        heads: int = 0,
        variable: str | None = None,
    ) -> RecordedSite:
        """Return the site with these spans; arguments as in `RecordedSite` and `SiteLayout`."""
        keys = SiteLayout(name, tuple(self.spans), layers=layers, heads=heads)
        return RecordedSite(keys, queries, dict(self.roles), variable)
