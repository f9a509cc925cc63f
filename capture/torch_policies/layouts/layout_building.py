"""What layouts are made of: the module of a policy class, what configurations of LeRobot say, spans in order."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from itertools import groupby
from typing import Any, cast

from vla_attention.capture.torch_policies.policy_layout import (
    CallRule,
    CameraPicture,
    PictureFit,
    PolicyLayout,
    RecordedSite,
)
from vla_attention.schemas.errors import BadArgument, listing
from vla_attention.schemas.layout import PatchGrid, SiteLayout, Span, SpanKind

#: Releases that the layouts of LeRobot's policies were tried with.
LEROBOT: dict[str, tuple[str, ...]] = {"lerobot": ("0.4.", "0.5.", "0.6.")}
#: The same of those that came with 0.6.
LEROBOT_06: dict[str, tuple[str, ...]] = {"lerobot": ("0.6.",)}
_PICTURE_PREFIX = re.compile(r"observation\.images?\.?")


class NotThisPolicy(BadArgument):
    """A layout asked for a policy of another class, or with settings that it does not cover."""


class FoundModule:
    """The first module of some classes in a policy. Classes are compared by name, also those that one is derived from.

    Attributes:
        path: as the recorder names modules, "" for the policy itself.
        module: the module.

    Raises:
        NotThisPolicy: there is none.
    """

    def __init__(self, policy: object, classes: Sequence[str], layout: str) -> None:
        from vla_attention.capture.torch_policies.policy_modules import modules_of

        modules = modules_of(policy)
        for path, module in modules.items():
            if {base.__name__ for base in type(module).__mro__} & set(classes):
                self.path, self.module = path, cast(Any, module)
                return
        raise NotThisPolicy(
            f"The layout '{layout}' is for {' or '.join(classes)}, but a {type(policy).__name__} was given, with "
            f"modules of {listing(sorted({type(module).__name__ for module in modules.values()}))}. Give the policy "
            "itself, or write a layout (docs/my-policy.md)."
        )

    def inside(self, name: str) -> str:
        """Return the path of a module inside."""
        return f"{self.path}.{name}" if self.path else name

    def rule(self, modules: str, site: str | None = None, **others: Any) -> CallRule:
        """Return the rule of modules inside: a regular expression behind the path as it is; others as in `CallRule`."""
        return CallRule(re.escape(self.path + ".") + modules if self.path else modules, site, **others)


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

    def add(self, name: str, kind: SpanKind, count: int, role: str, **others: Any) -> None:
        """Add `count` keys of one kind; none, no span. others: as in `Span`."""
        if count:
            self.spans.append(Span(name, kind, self.num_keys, self.num_keys + count, **others))
            self.roles[name] = role

    def add_picture(self, camera: str, rows: int, columns: int, height: int, width: int) -> None:
        """Add a camera's patches, row by row."""
        grid = PatchGrid(rows, columns, height, width)
        self.add(camera, "image", grid.num_patches, "image", camera=camera, grid=grid)

    def site(
        self, name: str, queries: tuple[int, int | None], *, layers: tuple[int, ...] = (), variable: str | None = None
    ) -> RecordedSite:
        """Return the site with these spans; arguments as in `RecordedSite` and `SiteLayout`."""
        return RecordedSite(SiteLayout(name, tuple(self.spans), layers=layers), queries, dict(self.roles), variable)

    def layout(
        self,
        name: str,
        queries: tuple[int, int | None],
        blocks: tuple[int, int],
        rules: Sequence[CallRule],
        cameras: Sequence[str],
        fit: PictureFit = "stretch",
        **others: Any,
    ) -> PolicyLayout:
        """Return the layout of a policy with the one site `joint`, whose prompt may be shorter.

        blocks: how many, and heads of each. fit: of all cameras. others: as in `PolicyLayout`.
        """
        return PolicyLayout(
            name=name,
            sites=(self.site("joint", queries, variable="prompt"),),
            rules=tuple(rules),
            num_layers=blocks[0],
            num_heads=blocks[1],
            cameras=tuple(CameraPicture(camera, fit) for camera in cameras),
            **{"family": name, **others},
        )


def text_and_pictures(
    ids: Sequence[int], placeholder: int, cameras: Sequence[str], pictures: int | Sequence[PatchGrid], layout: str
) -> tuple[KeyOrder, list[str]]:
    """Return the keys of a vision-language model's tokens, and the names of its text spans in order.

    Args:
        ids: of one call without padding; placeholder: the id that stands for a patch.
        cameras: names of the pictures in order.
        pictures: their patches; or the sides in pixels of square ones.

    Raises:
        BadArgument: the ids do not hold one picture for each camera.
        NotThisPolicy: a picture is no square of patches.
    """
    runs = [(picture, len(list(run))) for picture, run in groupby(ids, lambda token: token == placeholder)]
    found = [count for picture, count in runs if picture]
    wanted = [] if isinstance(pictures, int) else [grid.num_patches for grid in pictures]
    if len(found) != len(cameras) or (wanted and wanted != found):
        expected = f"{listing(wanted)} for the cameras" if wanted else "one for each of the cameras"
        raise BadArgument(
            f"The ids of one call hold {len(found)} runs of placeholders for patches (id {placeholder}), of "
            f"{listing(found) or 'none'}; expected {expected} {list(cameras)}."
        )
    keys, texts, number = KeyOrder(), list[str](), 0
    for place, (picture, count) in enumerate(runs):
        if not picture:
            texts.append(f"template_{place}")
            keys.add(texts[-1], "text", count, "template")
            continue
        if isinstance(pictures, int):
            side = square(count, "pictures", layout)
            keys.add_picture(cameras[number], side, side, pictures, pictures)
        else:
            grid = pictures[number]
            keys.add_picture(cameras[number], grid.rows, grid.columns, grid.image_height, grid.image_width)
        number += 1
    return keys, texts


def prompt_with_pictures(
    ids: Sequence[int],
    placeholder: int,
    cameras: Sequence[str],
    pictures: int | Sequence[PatchGrid],
    longest: int,
    layout: str,
) -> tuple[KeyOrder, list[str]]:
    """Return the same where the text behind the last picture is the prompt, whose length changes: the last text span.

    longest: number of tokens of the longest prompt; 0: twice that of `ids`.

    Raises:
        BadArgument, NotThisPolicy: as above; or there is no text behind the last picture.
    """
    count = next((number for number, token in enumerate(reversed(ids)) if token == placeholder), len(ids))
    keys, texts = text_and_pictures(ids[: len(ids) - count], placeholder, cameras, pictures, layout)
    if not count:
        raise BadArgument(
            f"The ids of one call end with a placeholder for a patch (id {placeholder}); expected text behind it."
        )
    keys.add("prompt", "text", longest or 2 * count, "instruction")
    return keys, [*texts, "prompt"]


def qwen_pictures(image_grid_thw: Sequence[Sequence[int]], vision: Any) -> list[PatchGrid]:
    """Return the patches of Qwen 2.5 VL's pictures.

    image_grid_thw: frames, rows and columns of each picture before its patches are merged. vision: the configuration of
    its picture encoder.
    """
    merge, patch = vision.spatial_merge_size, vision.patch_size
    grids = [(int(rows), int(columns)) for _, rows, columns in image_grid_thw]
    return [PatchGrid(rows // merge, columns // merge, rows * patch, columns * patch) for rows, columns in grids]
