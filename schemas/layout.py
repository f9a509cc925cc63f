"""Token layout: what every key of a site is. No other module contains the position or number of any key.

A site's keys are divided into spans (a camera's patches, the prompt, the actions ...). A `SiteLayout` is the same for a
whole run. The role of each key and the prompt may change from replan to replan, because some policies write their state
into the prompt; they are stored beside the rows.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from vla_attention.schemas.errors import BadArgument, unknown_name
from vla_attention.schemas.safe_text import check_name

SiteName = Literal["joint", "self", "cross"]
SpanKind = Literal["image", "text", "state", "action", "latent"]
ROLE_DTYPE = np.uint8


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

    @property
    def label(self) -> str:
        """The role's name as written in selectors and reports."""
        return self.name.lower()


#: Roles of keys that can never hold information: exact zeros of a mask, or an inert null sink.
INVALID_ROLES = (Role.MASKED_IMAGE, Role.PADDING, Role.NULL)


def find_role(label: str) -> Role:
    """Look a role up by its label; the error names the nearest and all that exist."""
    for role in Role:
        if role.label == label.casefold():
            return role
    raise unknown_name("role", label, [role.label for role in Role])


@dataclass(frozen=True)
class PatchGrid:
    """How an image span's keys tile the model's input image: row-major from its top left corner."""

    rows: int
    columns: int
    image_height: int
    image_width: int

    @property
    def num_patches(self) -> int:
        """Number of keys that the grid covers."""
        return self.rows * self.columns


@dataclass(frozen=True)
class Span:
    """A run of neighbouring keys [start, stop) of one kind."""

    name: str
    kind: SpanKind
    start: int
    stop: int
    camera: str | None = None
    grid: PatchGrid | None = None

    def __post_init__(self) -> None:
        """Check the names; they are parts of paths in a store."""
        check_name("span", self.name)
        if self.camera is not None:
            check_name("camera", self.camera)

    @property
    def num_keys(self) -> int:
        """Number of keys in the span."""
        return self.stop - self.start


@dataclass(frozen=True)
class SiteLayout:
    """The spans of one softmax family, in key order, without gaps.

    Raises `BadArgument` when spans leave a gap, overlap, share a name, or a grid does not match its span's length.
    """

    name: SiteName
    spans: tuple[Span, ...]

    def __post_init__(self) -> None:
        """Check that the spans tile [0, num_keys)."""
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

    @property
    def num_keys(self) -> int:
        """Number of keys of the site."""
        return self.spans[-1].stop if self.spans else 0

    @property
    def cameras(self) -> tuple[str, ...]:
        """Camera names, in key order."""
        return tuple(span.camera for span in self.spans if span.camera is not None)

    def span(self, name: str) -> Span:
        """Return the span of that name; the error lists the existing ones."""
        for span in self.spans:
            if span.name == name:
                return span
        raise unknown_name("span", name, [span.name for span in self.spans])

    def camera_span(self, camera: str) -> Span:
        """Return the span that holds a camera's patches; the error lists the existing cameras."""
        for span in self.spans:
            if span.camera == camera:
                return span
        raise unknown_name("camera", camera, self.cameras)

    def frame(self, name: str) -> Span:
        """Return a latent frame by its name, by `frameN`, or as `curr_last`.

        `curr_last` is the name in the published Cosmos scripts of the last frame with a current camera picture.
        """
        frames = [span for span in self.spans if span.kind == "latent"]
        for span in frames:
            if span.name == name:
                return span
        number = name.removeprefix("frame")
        if name.startswith("frame") and number.isdigit() and int(number) < len(frames):
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


@dataclass(frozen=True)
class Piece:
    """One prompt token: its key, its text, and the characters [start, stop) of the prompt that it covers."""

    key: int
    text: str
    start: int
    stop: int


@dataclass(frozen=True)
class Prompt:
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


def roles_from_spans(layout: SiteLayout, role_of_span: dict[str, Role]) -> NDArray[np.uint8]:
    """Give every key the role of its span, shape (key,); text spans are usually refined by the tokenizer's roles."""
    roles = np.zeros(layout.num_keys, dtype=ROLE_DTYPE)
    for span in layout.spans:
        roles[span.start : span.stop] = role_of_span[span.name]
    return roles
