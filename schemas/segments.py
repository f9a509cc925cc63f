"""Segments: all keys of one span that have one role. Every grouping by camera, role or span is made of whole segments.

Their masses are stored beside the rows (`atoms`), a few numbers instead of a thousand keys, so that such a grouping is
computed without reading a row. A grouping that takes part of a segment (a word, a patch, an object) needs the rows.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from vla_attention.schemas.jsonable import Document
from vla_attention.schemas.layout import Role, SiteLayout


class Segment(Document, frozen=True):
    """All keys of one span that have one role at a replan."""

    span: str
    role: str


def segments_of(layout: SiteLayout, key_role: NDArray[np.uint8]) -> tuple[Segment, ...]:
    """The segments of role codes of shape (key,) or (replan, key), by span and then by role code."""
    roles = np.atleast_2d(key_role)
    return tuple(
        Segment(span.name, Role(code).label)
        for span in layout.spans
        for code in np.unique(roles[:, span.start : span.stop])
    )


def merge_segments(layout: SiteLayout, parts: Iterable[Iterable[Segment]]) -> tuple[Segment, ...]:
    """Union of several replans' segments, in the canonical order of `segments_of`."""
    order = {span.name: i for i, span in enumerate(layout.spans)}
    union = {segment for part in parts for segment in part}
    return tuple(sorted(union, key=lambda segment: (order[segment.span], Role[segment.role.upper()])))


def segment_members(
    layout: SiteLayout, key_role: NDArray[np.uint8], segments: tuple[Segment, ...]
) -> NDArray[np.bool_]:
    """Which keys belong to which segment, shape (replan, key, segment); `key_role` has shape (replan, key)."""
    spans = layout.span_of_key()
    number = {span.name: i for i, span in enumerate(layout.spans)}
    of_span = np.array([number[segment.span] for segment in segments])
    of_role = np.array([int(Role[segment.role.upper()]) for segment in segments])
    members: NDArray[np.bool_] = (spans[None, :, None] == of_span) & (key_role[:, :, None] == of_role)
    return members


def segment_masses(rows: NDArray[np.float32], members: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Masses (..., segment) of one replan, summed in float64 from rows (..., key) and members (key, segment)."""
    masses = rows.astype(np.float64) @ members.astype(np.float64)
    return masses.astype(np.float32)


def weights_on_segments(
    weights: NDArray[np.float32], members: NDArray[np.bool_]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Group weights per segment, and where a group does not treat all keys of a segment alike: there rows are needed.

    Args:
        weights: (replan or 1, key, group), as resolved from a grouping.
        members: (replan or 1, key, segment).

    Returns:
        (replan or 1, segment, group) float32, 0 for a segment without keys at a replan, or that the group cuts; and
        (segment, group), whether it cuts it.
    """
    replans = max(weights.shape[0], members.shape[0])
    result = np.zeros((replans, members.shape[2], weights.shape[2]), dtype=np.float32)
    cut = np.zeros(result.shape[1:], dtype=bool)
    for segment in range(members.shape[2]):
        keys = np.flatnonzero(members[:, :, segment].any(axis=0))
        if not keys.size:
            continue
        # A segment is a part of a span: looking at all keys for each of them would take ten times as long.
        keys_of_segment = slice(keys[0], keys[-1] + 1)
        inside, values = members[:, keys_of_segment, segment, None], weights[:, keys_of_segment]
        highest = np.where(inside, values, -np.inf).max(axis=1)
        lowest = np.where(inside, values, np.inf).min(axis=1)
        present = inside.any(axis=1)
        cut[segment] = (present & (highest != lowest)).any(axis=0)
        result[:, segment] = np.where(present & ~cut[segment], highest, 0.0)
    return result, cut
