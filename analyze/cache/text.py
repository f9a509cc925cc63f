"""The text of `vla-analyze cache`."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime

from vla_attention.analyze.cache.housekeeping import KeptSegment
from vla_attention.analyze.cache.places import CachePlace
from vla_attention.analyze.show.numbers import format_bytes, plural
from vla_attention.analyze.show.text_table import text_table
from vla_attention.schemas.safe_text import visible


def describe_cache(place: CachePlace, segments: Sequence[KeptSegment]) -> str:
    """Folder and size, then a line for every question: its size, when it was last used, what it is."""
    total = sum(one.size for one in segments)
    head = f"{place.folder}: {format_bytes(total)} of at most {format_bytes(place.most_bytes)}"
    if not segments:
        return f"{head}; nothing is kept yet."
    questions: dict[str, list[KeptSegment]] = {}
    for one in segments:
        questions.setdefault(one.about, []).append(one)
    rows = [
        [
            visible(about),
            format_bytes(sum(one.size for one in kept)),
            f"{datetime.fromtimestamp(max(one.used for one in kept)):%Y-%m-%d %H:%M}",
        ]
        for about, kept in questions.items()
    ]
    return f"{head}; {plural(len(questions), 'question')}\n{text_table(['kept', 'size', 'last used'], rows, left=[0])}"
