"""Which sentences are told in scenes that look alike, which words vary there, and whether the actions do.

Every pair of sentences, every word and every moment is held against one limit, in both directions: told apart in less
than `LIMIT` of the episodes, or in more.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
import polars as pl

from vla_attention.analyze.core.data_episodes import DataEpisodes, looks_of_motion
from vla_attention.analyze.core.exchanged import KINDS, words_by_kind
from vla_attention.analyze.statistics.many_looks import NAMED_AT, adjusted_p_values
from vla_attention.analyze.statistics.told_apart import Labels, Share, tell_apart
from vla_attention.schemas.progress_bar import progress_bar
from vla_attention.schemas.safe_text import visible

#: Sentences, and words, of fewer episodes are left out; of more sentences than this, those of most episodes are
#: compared in pairs.
FEWEST, MOST_SENTENCES = 5, 150
#: Told apart in less than this share of episodes, scenes count as shared: half of the way from guessing to knowing.
LIMIT = 0.75
SHARED, APART, OPEN = "share scenes", "told apart", "not known"
#: Pairs whose actions are compared.
_MOST_PAIRS = 60


@dataclass(frozen=True)
class Sentences:
    """The sentences that are compared, those of most episodes first: names as written, and episodes (sentence,)."""

    names: tuple[str, ...]
    keys: tuple[str, ...]
    members: tuple[Labels, ...]

    @classmethod
    def of(cls, data: DataEpisodes) -> Sentences:
        """Those that are told in `FEWEST` episodes or more."""
        counts = Counter(sentence for sentence in data.sentences if sentence)
        keys = tuple(key for key, number in counts.most_common() if number >= FEWEST)
        told = np.array(data.sentences, dtype=object)
        names = tuple(visible(data.written[key].most_common(1)[0][0]) for key in keys)
        return cls(names, keys, tuple(np.flatnonzero(told == key) for key in keys))

    @property
    def num_episodes(self) -> int:
        """Of all of them together."""
        return sum(map(len, self.members))


def pairs_of(episodes: DataEpisodes, sentences: Sentences) -> pl.DataFrame:
    """Every pair of sentences: how well first pictures tell them apart, and what is shown of it."""
    looks, some = list(episodes.looks.values()), range(min(len(sentences.keys), MOST_SENTENCES))
    rows = []
    with progress_bar(len(some) * (len(some) - 1) // 2, "pairs") as advance:
        for a, b in combinations(some, 2):
            share = tell_apart(looks, sentences.members[a], sentences.members[b])
            sizes = len(sentences.members[a]), len(sentences.members[b])
            names = sentences.names[a], sentences.names[b]
            rows.append((a, b, *names, *sizes, *estimate_of(share), share.p_less(LIMIT), share.p_more(LIMIT)))
            advance(1)
    frame = with_verdicts(pl.DataFrame(rows, schema=_PAIRS, orient="row")).sort("told", "first", "second")
    differ = [_where_they_differ(one, other) for one, other in frame.select("sentence", "other").rows()]
    return frame.with_columns(differ=pl.Series(differ, dtype=pl.String))


def _where_they_differ(one: str, other: str) -> str:
    """Two sentences without the words with which both begin and end."""
    first, second = one.split(), other.split()
    fewest = min(len(first), len(second)) - 1
    begin = next((i for i in range(fewest) if first[i] != second[i]), fewest)
    left = fewest - begin
    end = next((i for i in range(left) if first[-1 - i] != second[-1 - i]), left)
    parts = [" ".join(words[begin : len(words) - end]) for words in (first, second)]
    return f"{'… ' if begin else ''}{parts[0]} / {parts[1]}{' …' if end else ''}"


def with_verdicts(frame: pl.DataFrame) -> pl.DataFrame:
    """Rows with p_less and p_more: their q over all rows, and which of the two is shown."""
    shown = frame.with_columns(
        pl.Series(f"q_{side}", adjusted_p_values(frame[f"p_{side}"].to_list()), dtype=pl.Float64)
        for side in ("less", "more")
    )
    less, more = (pl.col(f"q_{side}") <= NAMED_AT for side in ("less", "more"))
    verdict = pl.when(less).then(pl.lit(SHARED)).when(more).then(pl.lit(APART)).otherwise(pl.lit(OPEN))
    return shown.with_columns(verdict=verdict)


def groups_of(pairs: pl.DataFrame, sentences: Sentences) -> list[list[int]]:
    """Groups of sentences, the largest first: each is shown to share scenes with another one, and is told from none."""
    verdicts = {frozenset(row[:2]): row[2] for row in pairs.select("first", "second", "verdict").iter_rows()}
    groups: list[list[int]] = []
    for number in range(len(sentences.keys)):
        found = [(group, [verdicts.get(frozenset((number, one))) for one in group]) for group in groups]
        fitting = [group for group, of in found if SHARED in of and APART not in of]
        if fitting:
            max(fitting, key=len).append(number)
        else:
            groups.append([number])
    return sorted((group for group in groups if len(group) > 1), key=len, reverse=True)


def words_by_pairs(pairs: pl.DataFrame, sentences: Sentences) -> pl.DataFrame:
    """Of every word that is told where another of its kind could be: whether scenes are shared, or tell it."""
    by_kind = [words_by_kind(name) for name in sentences.names]
    verdicts: dict[tuple[str, str], list[str]] = {}
    for first, second, verdict in pairs.select("first", "second", "verdict").iter_rows():
        for kind in KINDS:
            one, other = by_kind[first][kind], by_kind[second][kind]
            for word in (one ^ other) if one and other else ():
                verdicts.setdefault((kind, word), []).append(verdict)
    rows = []
    for (kind, word), found in verdicts.items():
        n = sum(len(sentences.members[i]) for i, words in enumerate(by_kind) if word in words[kind])
        verdict = SHARED if SHARED in found else APART if set(found) == {APART} else OPEN
        rows.append((kind, word, n, found.count(SHARED), len(found), verdict, None, None, None))
    return pl.DataFrame(rows, schema=_WORD_SCHEMA, orient="row").sort("verdict", "kind", "word")


def words_by_picture(episodes: DataEpisodes) -> pl.DataFrame:
    """Of every word, whether the picture tells it from other words of its kind."""
    kinds = {sentence: words_by_kind(sentence) for sentence in set(episodes.sentences)}
    by_kind = [kinds[sentence] for sentence in episodes.sentences]
    looks, rows = list(episodes.looks.values()), []
    words = [(kind, word) for kind in KINDS for word in sorted(set().union(*(one[kind] for one in by_kind)))]
    with progress_bar(len(words), "words") as advance:
        for kind, word in words:
            told = np.array([word in one[kind] for one in by_kind])
            other = np.array([bool(one[kind]) for one in by_kind]) & ~told
            if min(told.sum(), other.sum()) >= FEWEST:
                share = tell_apart(looks, np.flatnonzero(told), np.flatnonzero(other))
                tests = share.p_less(LIMIT), share.p_more(LIMIT)
                rows.append((kind, word, int(told.sum()), *estimate_of(share), *tests))
            advance(1)
    columns = ("told", "told_low", "told_high", "p_less", "p_more")
    schema = {"kind": pl.String, "word": pl.String, "num_episodes": pl.Int64, **dict.fromkeys(columns, pl.Float64)}
    found = with_verdicts(pl.DataFrame(rows, schema=schema, orient="row"))
    return found.select(
        "kind", "word", "num_episodes", pl.lit(None, pl.Int64).alias("shared"), pl.lit(None, pl.Int64).alias("pairs"),
        "verdict", *columns[:3],
    ).sort("verdict", "kind", "word")  # fmt: skip


def parting(episodes: DataEpisodes, sentences: Sentences, pairs: pl.DataFrame) -> pl.DataFrame:
    """Of pairs that share scenes: from which moment on what was done tells them apart."""
    shared = pairs.filter(verdict=SHARED).head(_MOST_PAIRS).select("first", "second").rows()
    if episodes.motions is None or not shared:
        return pl.DataFrame(schema=_PARTS)
    rows = []
    with progress_bar(len(shared), "pairs of actions") as advance:
        moments = [looks_of_motion(episodes, moment) for moment in range(len(episodes.moments))]
        for first, second in shared:
            for moment, looks in zip(episodes.moments.tolist(), moments, strict=True):
                share = tell_apart(looks, sentences.members[first], sentences.members[second])
                tests = share.p_less(LIMIT), share.p_more(LIMIT)
                rows.append((first, second, moment, *estimate_of(share), *tests))
            advance(1)
    names = ("done", "done_low", "done_high", "p_less", "p_more")
    schema = {"first": pl.Int64, "second": pl.Int64, "moment": pl.Float64, **dict.fromkeys(names, pl.Float64)}
    each = with_verdicts(pl.DataFrame(rows, schema=schema, orient="row"))
    last = pl.col("moment") == pl.col("moment").max()
    return each.group_by("first", "second", maintain_order=True).agg(
        pl.col("moment").filter(pl.col("verdict") == APART).min().alias("parts_at"),
        *(pl.col(name).filter(last).first() for name in names[:3]),
        (pl.col("verdict") == SHARED).all().alias("the_same"),
    )


def ways_of(episodes: DataEpisodes) -> pl.DataFrame:
    """What is said, by the words with a meaning of their own; in how many ways, and how often in the commonest."""
    counts = Counter(sentence for sentence in episodes.sentences if sentence)
    meanings: dict[tuple[frozenset[str], ...], list[str]] = {}
    for sentence in counts:
        meanings.setdefault(tuple(words_by_kind(sentence).values()), []).append(sentence)
    rows = []
    for same in meanings.values():
        first, n = max(same, key=counts.__getitem__), sum(counts[one] for one in same)
        name = visible(episodes.written[first].most_common(1)[0][0])
        rows.append((name, len(same), len(first.split()), n, counts[first] / n))
    schema = {
        "sentence": pl.String,
        "ways": pl.Int64,
        "words": pl.Int64,
        "num_episodes": pl.Int64,
        "commonest": pl.Float64,
    }
    return pl.DataFrame(rows, schema=schema, orient="row").sort("num_episodes", "sentence", descending=[True, False])


def estimate_of(share: Share) -> tuple[float, float, float]:
    """Value, and both ends of the interval."""
    return share.value, *share.interval()


_PAIRS: Mapping[str, Any] = {
    "first": pl.Int64, "second": pl.Int64, "sentence": pl.String, "other": pl.String, "num_first": pl.Int64,
    "num_second": pl.Int64, "told": pl.Float64, "told_low": pl.Float64, "told_high": pl.Float64,
    "p_less": pl.Float64, "p_more": pl.Float64,
}  # fmt: skip
_PARTS: Mapping[str, Any] = {
    "first": pl.Int64, "second": pl.Int64, "parts_at": pl.Float64, "done": pl.Float64, "done_low": pl.Float64,
    "done_high": pl.Float64, "the_same": pl.Boolean,
}  # fmt: skip
_WORD_SCHEMA: Mapping[str, Any] = {
    "kind": pl.String, "word": pl.String, "num_episodes": pl.Int64, "shared": pl.Int64, "pairs": pl.Int64,
    "verdict": pl.String, "told": pl.Float64, "told_low": pl.Float64, "told_high": pl.Float64,
}  # fmt: skip
