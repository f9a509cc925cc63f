"""Token layout: what every key of a site is. No other module contains the position or number of any key.

A site's keys are divided into spans (a camera's patches, the prompt, the actions ...). A `SiteLayout` is the same for a
whole run. The role of each key and the prompt may change from replan to replan, because some policies write their state
into the prompt; they are stored beside the rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum
from typing import Literal

import numpy as np
from msgspec.structs import force_setattr, replace
from numpy.typing import NDArray

from vla_attention.schemas.errors import BadArgument, listing, unknown_name
from vla_attention.schemas.jsonable import Document, Number
from vla_attention.schemas.safe_text import check_name

SpanKind = Literal["image", "text", "state", "action", "latent"]
ROLE_DTYPE = np.uint8
#: What sums and quotients of fractions of a picture are off by, at most.
_ROUNDING = 1e-9
#: Groups and arrays of an episode beside those of its sites.
RESERVED_NAMES = frozenset(
    {
        *("actions", "base_actions", "camera_frames", "dataset_action_count", "dataset_actions", "denoise_time"),
        *("effects", "env_step", "frames", "noise_seed", "objects", "prompt_index", "seal", "state"),
        *("steps", "zarr.json"),
    }
)


class Role(IntEnum):
    """What one key is, at one replan. The numbers are the codes of `key_role` in the store and never change."""

    IMAGE = 1
    MASKED_IMAGE = 2
    BOS = 3
    TEMPLATE = 4
    INSTRUCTION = 5
    STATE = 6
    PADDING = 7
    ACTION = 8
    PROPRIO = 9
    BLANK = 10
    FUTURE = 11
    VALUE = 12
    TEXT = 13
    NULL = 14
    ABSENT = 15
    LEARNED = 16
    BORDER = 17

    @property
    def label(self) -> str:
        """The role's name as written in selectors and reports."""
        return self.name.lower()


#: Roles of keys that can never hold information: exact zeros of a mask, an inert null sink, or a key that does not
#: exist at this replan (a shorter prompt, fewer generated tokens).
INVALID_ROLES = (Role.MASKED_IMAGE, Role.PADDING, Role.NULL, Role.ABSENT)
#: Roles that a key of a span can have, by the span's kind; any key can be absent.
ROLES_OF_KIND: dict[SpanKind, tuple[Role, ...]] = {
    "image": (Role.IMAGE, Role.MASKED_IMAGE, Role.BORDER, Role.BLANK, Role.ABSENT),
    "text": (Role.BOS, Role.TEMPLATE, Role.INSTRUCTION, Role.STATE, Role.PADDING, Role.TEXT, Role.NULL, Role.ABSENT),
    "state": (Role.STATE, Role.LEARNED, Role.ABSENT),
    "action": (Role.ACTION, Role.ABSENT),
    "latent": (
        Role.IMAGE,
        Role.MASKED_IMAGE,
        Role.BORDER,
        Role.ACTION,
        Role.PROPRIO,
        Role.BLANK,
        Role.FUTURE,
        Role.VALUE,
        Role.ABSENT,
    ),
}


def kinds_and_roles() -> str:
    """Every kind of span with the roles that its keys can have, for messages; docs/my-policy.md has it, too."""
    kinds = [f"{kind} ({', '.join(role.label for role in roles)})" for kind, roles in ROLES_OF_KIND.items()]
    return f"Kinds of spans, with the roles that their keys can have: {', '.join(kinds)}"


def check_site_name(name: str) -> None:
    """Raise `BadArgument` unless a name can be a site's: one part of a path, and of no other group of an episode."""
    check_name("site", name)
    if name in RESERVED_NAMES:
        raise BadArgument(
            f"A site cannot be called '{name}': episodes have an array or a group of that name. Give it another name."
        )


def find_role(label: str) -> Role:
    """Look a role up by its label; the error names the nearest and all that exist."""
    for role in Role:
        if role.label == label.casefold():
            return role
    raise unknown_name("role", label, [role.label for role in Role])


#: (top, left, height, width) of a part of a picture, in fractions of the whole one.
Part = tuple[Number, Number, Number, Number]
WHOLE: Part = (0.0, 0.0, 1.0, 1.0)


class PatchGrid(Document, frozen=True):
    """How an image span's keys tile a camera's picture, or a part of it: row-major from the top left corner.

    `image_height`, `image_width`: pixels of the camera's whole picture. `part`: (top, left, height, width) of what the
    patches cover, in fractions of the whole picture: (0.5, 0, 0.5, 0.5) is the quarter at the bottom left.
    """

    rows: int
    columns: int
    image_height: int
    image_width: int
    part: Part = WHOLE

    def __post_init__(self) -> None:
        """Check that the grid and the picture have a size, and that the part lies in the picture."""
        if min(self.rows, self.columns, self.image_height, self.image_width) < 1:
            raise BadArgument(
                f"A patch grid has {self.rows} x {self.columns} patches of a picture of {self.image_height} x "
                f"{self.image_width} pixels; expected at least 1 of each."
            )
        wrong = BadArgument(
            f"A patch grid covers the part {self.part!r} of its picture; expected (top, left, height, width) in "
            "fractions of the whole picture, inside of it and at least a pixel large: (0, 0, 1, 1) is all of it."
        )
        try:
            top, left, height, width = part = tuple(map(float, self.part))
        except (TypeError, ValueError):
            raise wrong from None
        inside = min(part) >= 0 and max(top + height, left + width) <= 1 + _ROUNDING
        if not (inside and height * self.image_height >= 1 and width * self.image_width >= 1):
            raise wrong
        force_setattr(self, "part", part)  # a list or whole numbers are the same part

    @property
    def num_patches(self) -> int:
        """Number of keys that the grid covers."""
        return self.rows * self.columns

    @property
    def covers_all(self) -> bool:
        """Whether the grid covers the whole picture."""
        return self.part == (0, 0, 1, 1)

    def centres(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Where the centres of the rows (row,) and of the columns (column,) lie, in fractions of the whole picture."""
        top, left, height, width = self.part
        down, across = ((np.arange(count) + 0.5) / count for count in (self.rows, self.columns))
        return down * height + top, across * width + left

    def shares(self, rows: int, columns: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """How the patches lie on `rows` x `columns` even cells of the whole picture.

        Returns:
            Of every row of patches the share that lies in each row of cells (patch row, row), and the same of columns
            (patch column, column); both sum to 1 over the cells.
        """
        top, left, height, width = self.part
        return _shares(self.rows, top, height, rows), _shares(self.columns, left, width, columns)

    def shown(self, part: Part) -> NDArray[np.float64]:
        """How much of every patch lies in a part of the whole picture, (patch,), from 0 to 1."""
        down, across = (
            _shares(patches, (first - begins) / whole, length / whole, 1)[:, 0]
            for patches, first, length, begins, whole in zip(
                (self.rows, self.columns), self.part[:2], self.part[2:], part[:2], part[2:], strict=True
            )
        )
        return np.outer(down, across).ravel()

    def describe(self) -> str:
        """The grid in words."""
        part = ", ".join(f"{side:.4g}" for side in self.part)
        return f"{self.rows} x {self.columns} patches" + ("" if self.covers_all else f" of the part ({part})")


def _shares(patches: int, first: float, length: float, cells: int) -> NDArray[np.float64]:
    borders = (np.arange(cells + 1) / cells - first) * patches / length  # of the cells, in units of a patch
    whole = np.rint(borders)
    borders = np.where(np.abs(borders - whole) < 1000 * _ROUNDING, whole, borders)
    patch = np.arange(patches)[:, None]
    inside = np.minimum(borders[1:], patch + 1) - np.maximum(borders[:-1], patch)
    shares: NDArray[np.float64] = np.clip(inside, 0.0, None)
    return shares


class Span(Document, frozen=True):
    """A run of neighbouring keys [start, stop) of one kind.

    `camera`: all spans that name a camera are the camera: tiles, a thumbnail, frames of other times, and keys without
    a `grid`, such as a pooled token, which lie nowhere in the picture.

    `growing`: the keys of tokens that are generated one after another. Action query q sees the first
    `q + growing_offset` of them; the others do not exist yet. Tokens that are not generated at a replan have the role
    `absent`, and each makes the action queries of that replan one fewer.
    """

    name: str
    kind: SpanKind
    start: int
    stop: int
    camera: str | None = None
    grid: PatchGrid | None = None
    growing: bool = False
    growing_offset: int = 0

    def __post_init__(self) -> None:
        """Check the names, which are parts of paths in a store, and the offset."""
        check_name("span", self.name)
        if self.growing_offset < 0 or (self.growing_offset and not self.growing):
            raise BadArgument(
                f"Span '{self.name}' has the growing offset {self.growing_offset}; expected 0 or more, and 0 unless "
                "the span is growing."
            )
        if self.camera is not None:
            check_name("camera", self.camera)

    @property
    def num_keys(self) -> int:
        """Number of keys in the span."""
        return self.stop - self.start


class SiteLayout(Document, frozen=True):
    """The spans of one softmax family, in key order, without gaps.

    `name`: any that `check_site_name` accepts. `joint`: prefix and suffix keys together (pi). `self` and `cross`: the
    query's own tokens, and the text or prefix.

    `layers`: the blocks that have this site; empty where all recorded blocks have it. `heads`: its number of heads, and
    `num_action_queries`: its number of action queries; 0 where they are those of the policy and of the recording.

    Raises `BadArgument` when spans leave a gap, overlap, share a name, or a grid does not match its span's length, or
    grids of one camera are of pictures of different sizes.
    """

    name: str
    spans: tuple[Span, ...]
    layers: tuple[int, ...] = ()
    heads: int = 0
    num_action_queries: int = 0

    def __post_init__(self) -> None:
        """Check the name and the numbers, and that the spans tile [0, num_keys)."""
        check_site_name(self.name)
        self._check_numbers()
        if not self.spans:
            raise BadArgument(f"Site '{self.name}' has no spans; expected at least one.")
        position = 0
        seen: set[str] = set()
        for span in self.spans:
            if span.start != position or span.stop <= span.start:
                raise BadArgument(
                    f"Span '{span.name}' of site '{self.name}' covers keys {span.start}..{span.stop}, but the next "
                    f"free key is {position}: spans must follow each other without gap or overlap."
                )
            if span.name in seen:
                raise BadArgument(f"Site '{self.name}' has two spans named '{span.name}': names must be unique.")
            if span.grid is not None and span.grid.num_patches != span.num_keys:
                raise BadArgument(
                    f"Span '{span.name}' has {span.num_keys} keys, but its grid of {span.grid.rows} x "
                    f"{span.grid.columns} patches covers {span.grid.num_patches}."
                )
            seen.add(span.name)
            position = span.stop
        for camera, grids in self._grids.items():
            _check_picture_sizes(camera, grids)

    def _check_numbers(self) -> None:
        if list(self.layers) != sorted(set(self.layers)) or min(self.layers, default=0) < 0:
            raise BadArgument(
                f"Site '{self.name}' has the layers {listing(self.layers, 40)}; expected different block indices from "
                "0 up, in ascending order."
            )
        if self.heads < 0 or self.num_action_queries < 0:
            raise BadArgument(
                f"Site '{self.name}' has {self.heads} heads and {self.num_action_queries} action queries; expected 0 "
                "(those of the policy) or more."
            )
        growing = [span.name for span in self.spans if span.growing]
        if len(growing) > 1:
            raise BadArgument(f"Site '{self.name}' has the growing spans {listing(growing)}; expected at most one.")

    @property
    def num_keys(self) -> int:
        """Number of keys of the site."""
        return self.spans[-1].stop if self.spans else 0

    @property
    def cameras(self) -> tuple[str, ...]:
        """Camera names, in the order of their first keys."""
        return tuple(dict.fromkeys(span.camera for span in self.spans if span.camera is not None))

    @property
    def growing_span(self) -> Span | None:
        """The span of generated tokens; None where every action query sees the same keys."""
        return next((span for span in self.spans if span.growing), None)

    def span(self, name: str) -> Span:
        """Return the span of that name; the error lists the existing ones."""
        for span in self.spans:
            if span.name == name:
                return span
        raise unknown_name("span", name, [span.name for span in self.spans])

    @property
    def pictured(self) -> tuple[str, ...]:
        """Names of the cameras that have patches, in the order of their first patches."""
        return tuple(self._grids)

    @property
    def _grids(self) -> dict[str, tuple[PatchGrid, ...]]:
        found: dict[str, tuple[PatchGrid, ...]] = {}
        for span in self.spans:
            if span.camera is not None and span.grid is not None:
                found[span.camera] = (*found.get(span.camera, ()), span.grid)
        return found

    def camera_spans(self, camera: str) -> tuple[Span, ...]:
        """Return all spans of a camera, in key order; the error lists the existing cameras."""
        spans = tuple(span for span in self.spans if span.camera == camera)
        if not spans:
            raise unknown_name("camera", camera, self.cameras)
        return spans

    def grids(self, camera: str) -> tuple[PatchGrid, ...]:
        """Return the grids of a camera's spans, in key order; empty where none of its keys lies in the picture."""
        self.camera_spans(camera)  # raises the error that lists the cameras
        return self._grids.get(camera, ())

    def patch_keys(self, camera: str) -> NDArray[np.int64]:
        """Keys of the patches of all grids of a camera, shape (patch,), in key order: the patches of its coverage."""
        of_grids = [np.arange(span.start, span.stop) for span in self.camera_spans(camera) if span.grid is not None]
        return np.concatenate(of_grids) if of_grids else np.zeros(0, dtype=np.int64)

    def frame(self, name: str) -> Span:
        """Return a latent frame by its name, by `frameN`, or as `curr_last`.

        `curr_last` is the name in the published Cosmos scripts of the last frame with a current camera picture.
        """
        frames = [span for span in self.spans if span.kind == "latent"]
        for span in frames:
            if span.name == name:
                return span
        number = name.removeprefix("frame")
        if name.startswith("frame") and number.isdecimal() and len(number) < 9 and int(number) < len(frames):
            return frames[int(number)]
        seen = [span for span in frames if span.camera is not None]
        if name == "curr_last" and seen:
            return seen[-1]
        aliases = [*(f"frame{i}" for i in range(len(frames))), "curr_last"] if frames else []
        raise unknown_name("latent frame", name, [*(span.name for span in frames), *aliases])

    def span_of_key(self) -> NDArray[np.int32]:
        """Index into `spans` for each key, shape (key,)."""
        lengths = [span.num_keys for span in self.spans]
        return np.repeat(np.arange(len(lengths), dtype=np.int32), lengths)


def _check_picture_sizes(camera: str, grids: Sequence[PatchGrid]) -> None:
    """Raise `BadArgument` unless all grids of a camera are of one picture."""
    sizes = listing(dict.fromkeys(f"{grid.image_height} x {grid.image_width}" for grid in grids))
    if len({(grid.image_height, grid.image_width) for grid in grids}) > 1:
        raise BadArgument(
            f"The grids of camera '{camera}' are of pictures of {sizes} pixels; expected one size, that of the whole "
            "picture, and what a grid covers of it in its part=(top, left, height, width)."
        )


def camera_grids(sites: Sequence[SiteLayout], camera: str) -> tuple[PatchGrid, ...]:
    """The grids of a camera in key order, the same at every site that has its patches; its coverage has these patches.

    Raises:
        UnknownName: no site has patches of the camera.
        BadArgument: two sites have different patches of it.
    """
    by_site = _grids_of_sites(sites, camera)
    if len(set(by_site.values())) > 1:
        grids = "; ".join(f"'{name}' {listing(one.describe() for one in own)}" for name, own in by_site.items())
        raise BadArgument(
            f"Sites have different patches of camera '{camera}' ({grids}), so patches of it are not the same at both: "
            "what objects cover is stored once for a camera. Leave out masks and coverage of it."
        )
    return next(iter(by_site.values()))


def _grids_of_sites(sites: Sequence[SiteLayout], camera: str) -> dict[str, tuple[PatchGrid, ...]]:
    found = {site.name: site.grids(camera) for site in sites if camera in site.pictured}
    if not found:
        raise unknown_name("camera with patches", camera, dict.fromkeys(name for one in sites for name in one.pictured))
    return found


def picture_size(sites: Sequence[SiteLayout], camera: str) -> tuple[int, int]:
    """Height and width in pixels of a camera's picture as the model sees it; errors as `camera_grids`."""
    grids = [grid for own in _grids_of_sites(sites, camera).values() for grid in own]
    _check_picture_sizes(camera, grids)
    return grids[0].image_height, grids[0].image_width


class Piece(Document, frozen=True):
    """One prompt token: its key, its text, and the characters [start, stop) of the prompt that it covers."""

    key: int
    text: str
    start: int
    stop: int


class Prompt(Document, frozen=True):
    """The text given to the policy at a replan, as pieces, and where the instruction stands in it.

    `instruction` is the character range [start, stop) of the instruction inside `text`. Pieces that have no characters
    of their own (bos, padding) are not listed; their keys are known from the roles.
    """

    text: str
    pieces: tuple[Piece, ...]
    instruction: tuple[int, int]

    @property
    def instruction_text(self) -> str:
        """The instruction as the policy reads it."""
        return self.text[self.instruction[0] : self.instruction[1]]


def prompt_at(sites: Sequence[SiteLayout], layout: SiteLayout, prompt: Prompt) -> Prompt:
    """The prompt with its pieces at the keys of one site.

    Pieces are stored with the keys of the first site that has text. Another site may have the same text spans at other
    keys: a piece is at the same place of the span of that name. Pieces of spans that the site lacks are left out.
    """
    first = next((site for site in sites if any(span.kind == "text" for span in site.spans)), layout)
    spans = {span.name: span for span in layout.spans if span.kind == "text"}
    texts = [span for span in first.spans if span.kind == "text"]
    if all(spans.get(span.name) == span for span in texts):
        return prompt
    pieces = []
    for piece in prompt.pieces:
        span = next((span for span in texts if span.start <= piece.key < span.stop), None)
        span_here = None if span is None else spans.get(span.name)
        if span is not None and span_here is not None and piece.key - span.start < span_here.num_keys:
            pieces.append(replace(piece, key=piece.key - span.start + span_here.start))
    return replace(prompt, pieces=tuple(pieces))


def roles_from_spans(layout: SiteLayout, role_of_span: dict[str, Role]) -> NDArray[np.uint8]:
    """Give every key the role of its span, shape (key,); text spans are usually refined by the tokenizer's roles."""
    roles = np.zeros(layout.num_keys, dtype=ROLE_DTYPE)
    for span in layout.spans:
        roles[span.start : span.stop] = role_of_span[span.name]
    return roles
