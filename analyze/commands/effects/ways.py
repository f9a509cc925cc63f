"""How the words that move the action reach it, and whether attention tells that they do: a part of `effects`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import polars as pl

from vla_attention.analyze.commands.effects.items import IS_WORD, LESS, MORE, MOST_NAMED, OPEN, named_sizes
from vla_attention.analyze.core.estimate import Scale, estimate
from vla_attention.analyze.core.result import Finding
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.measures.tables import EPISODE_ID
from vla_attention.analyze.statistics.many_looks import NAMED_AT
from vla_attention.schemas.errors import listing

#: Of the total effect.
_HALF = 0.5


def ways_of_words(question: Question, episodes: pl.DataFrame, words: pl.DataFrame) -> list[Finding]:
    """Which of the shown words the action tokens read themselves, and which act through what has read them.

    Named is what is shown to be more, or less, than half of the total.
    """
    shown = words.filter(than_noise=MORE)["item"].to_list()
    rows = episodes.filter(IS_WORD, pl.col("item").is_in(shown), pl.col("reader").is_not_null())
    of_readers = rows.pivot("reader", index=[*EPISODE_ID, "item", "label"], values="effect")
    parts = {f"{name}_part": (name, "total") for name in ("direct", "pictures") if name in of_readers.columns}
    if "direct_part" not in parts or "total" not in of_readers.columns:
        return []
    readers: dict[str, Scale] = dict.fromkeys(("total", "direct"), "positive")
    half = dict.fromkeys(parts, _HALF)
    found = estimate(of_readers, ["item", "label"], readers, question.sampling, half, quotients=parts)
    words_of = found.sort("total", descending=True).to_dicts()
    own = [row["label"] for row in words_of if _side_of_half(row, "direct_part") > 0]
    rest = [row for row in words_of if _side_of_half(row, "direct_part") < 0]
    said = [f"the action tokens read {listing(own, MOST_NAMED)} themselves"] if own else []
    for seen, through in ((True, "the pictures"), (False, "other tokens")):
        some = [row for row in rest if (_side_of_half(row, "pictures_part") > 0) is seen]
        if some:
            several, left = len(some) > 1, [row["direct_part"] for row in some]
            sizes = " to ".join(dict.fromkeys(f"{size:.1%}" for size in (min(left), max(left))))
            most = max(row["direct_part_high"] for row in some)
            said.append(
                f"{listing([row['label'] for row in some], MOST_NAMED)} {'act' if several else 'acts'} mostly through "
                f"{through}, which have read {'them' if several else 'it'}: hidden from the action tokens alone, "
                f"{sizes} of the effect is left (95% intervals up to {most:.0%})"
            )
    text = "; ".join(said)
    return [Finding(f"{text[0].upper()}{text[1:]}.", "How do these words reach the action?")] if said else []


def _side_of_half(row: Mapping[str, Any], name: str) -> int:
    """Whether a part is shown to be more (1) or less (-1) than half; 0 where neither is."""
    q = row.get(f"{name}_q")
    return 0 if q is None or q > NAMED_AT else 1 if row[name] > _HALF else -1


def unlike_attention(words: pl.DataFrame) -> list[Finding]:
    """Words whose attention is shown to say something else than their effect."""
    sure = words.filter(pl.col("lift_q") <= NAMED_AT)
    silent = sure.filter(pl.col("lift") < 1, than_noise=MORE)
    idle = sure.filter(pl.col("lift") > 1, pl.col("than_noise").is_in([OPEN, LESS]))
    sides = ((silent, "less than its share, and the action changes without it"),
             (idle, "more than its share, and no change is shown without it"))  # fmt: skip
    parts = [f"{text}: {named_sizes(rows, 'lift')}" for rows, text in sides if rows.height]
    said = "; ".join(parts)
    limit = "In brackets: attention to the word, evenly spread over all tokens = 1."
    return [Finding(f"{said[0].upper()}{said[1:]}.", "Does attention tell?", limit=limit)] if parts else []
