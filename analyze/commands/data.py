"""Do the data ask for the sentence? What the first picture tells of it, before anything is trained.

A policy that is trained where the picture says what to do need not read. Asked are: how often the sentence is told from
the first picture; which sentences are told in scenes that look alike; which words vary there; whether the actions
differ where the pictures do not; and in how many ways the same is said.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from itertools import combinations
from typing import Any, TypeAlias

import numpy as np
import polars as pl

from vla_attention.analyze.core.data_episodes import EVERYTHING, DataEpisodes
from vla_attention.analyze.core.exchanged import words_by_kind
from vla_attention.analyze.core.result import Column, Figure, Finding, Result, Table
from vla_attention.analyze.core.shared_scenes import (
    APART,
    FEWEST,
    LIMIT,
    MOST_SENTENCES,
    OPEN,
    SHARED,
    Sentences,
    estimate_of,
    groups_of,
    pairs_of,
    parting,
    ways_of,
    words_by_pairs,
    words_by_picture,
)
from vla_attention.analyze.statistics.many_looks import NAMED_AT
from vla_attention.analyze.statistics.told_apart import Labels, Share, Told, enough, tell
from vla_attention.schemas.errors import BadArgument, listing, plural
from vla_attention.schemas.safe_text import visible

Numbers: TypeAlias = dict[str, float | int | str | None]
#: From this share on, the picture tells the sentence.
TELLS = 0.9
#: A simpler look that is right in this much less does as well.
_AS_WELL = 0.03
#: Names in a sentence.
_NAMES = 4
_MUST, _WHERE, _WORDS, _BY_WHAT = "Must a policy read the sentence here?", "Where must it?", "Which words?", "By what?"
_ACTIONS, _WAYS, _FAULTS = "Do the demonstrations differ there?", "Is it said in more than one way?", "Faults?"
_WEAK = "A network may see more than this look: small pictures (8 x 8 colours and edges) and the first state."


def data(episodes: DataEpisodes) -> Result:
    """What the beginnings of episodes tell of their sentences.

    Raises:
        BadArgument: fewer than two sentences are told.
    """
    told = [sentence for sentence in episodes.sentences if sentence]
    if len(set(told)) < 2:
        raise BadArgument(
            f"'{episodes.name}' tells {plural(len(set(told)), 'sentence')} in {plural(len(told), 'episode')}; expected "
            "two or more: with one there is nothing to tell apart."
        )
    sentences = Sentences.of(episodes)
    figures: list[Figure] = []
    notes: list[str] = []
    by_word = len(sentences.keys) < 2 or 2 * sentences.num_episodes < len(told)
    if by_word:
        words = words_by_picture(episodes)
        findings, tables = [_asked_by_word(words, episodes)], [_word_table(words)]
    else:
        findings, tables, figures, notes = _by_sentence(episodes, sentences)
    ways = ways_of(episodes)
    left = len(told) - sentences.num_episodes
    if left and not by_word:
        few = plural(len(set(told)) - len(sentences.keys), "sentence")
        notes.append(f"{plural(left, 'episode')} of {few} left out: told in fewer than {FEWEST} episodes.")
    return Result(
        "Do the data ask for the sentence?",
        _about(episodes, len(set(told))),
        [*findings, _said_in_ways(ways, told), *_faults(episodes)],
        [*tables, Table("ways", ways, _WAY_COLUMNS, "What is said, and in how many ways")],
        figures,
        notes,
    )


def _about(episodes: DataEpisodes, number: int) -> list[str]:
    read = len(episodes.sentences)
    part = f"{read} of {episodes.total} episodes, evenly spread" if read < episodes.total else plural(read, "episode")
    state = f", and the first state ({episodes.state})" if episodes.state else ""
    return [
        f"{visible(episodes.name)}: {part}, {plural(number, 'sentence')}. Looked at: the first picture of "
        f"{listing(episodes.cameras)}{state}."
    ]


def _by_sentence(
    episodes: DataEpisodes, sentences: Sentences
) -> tuple[list[Finding], list[Table], list[Figure], list[str]]:
    chosen = np.concatenate(sentences.members)
    order = np.argsort(chosen)
    groups = np.repeat(np.arange(len(sentences.keys)), [len(one) for one in sentences.members])[order]
    found = tell({name: look.of(chosen[order]) for name, look in episodes.looks.items()}, groups)
    pairs = pairs_of(episodes, sentences)
    shared = groups_of(pairs, sentences)
    words = words_by_pairs(pairs, sentences)
    parts = parting(episodes, sentences, pairs)
    pairs = pairs.join(parts, on=["first", "second"], how="left", maintain_order="left") if parts.height else pairs
    notes = []
    if found.scenes < len(groups):
        ways = f"{found.scenes} ways that look different"
        notes.append(f"{len(groups)} episodes begin in {ways}: what looks the same counts once.")
    if more := len(sentences.keys[MOST_SENTENCES:]):
        notes.append(f"{plural(more, 'sentence')} of fewer episodes are not compared in pairs.")
    findings = [
        _must_read(found, groups, sentences, pairs),
        *_by_what(found),
        _where(pairs, shared, sentences),
        *_cannot_be_learned(words),
        *_demonstrations(parts, episodes),
    ]
    looks = [(name, *estimate_of(_share(right, found.scenes))) for name, right in found.by_look.items()]
    schema = {"look": pl.String, **dict.fromkeys(("told", "told_low", "told_high"), pl.Float64)}
    by_look = pl.DataFrame(looks, schema=schema, orient="row").sort("told", descending=True)
    tables = [
        Table("pairs", pairs, _PAIR_COLUMNS + (_PARTING if parts.height else []), "Sentence by sentence",
              where=pl.col("verdict") != APART),
        _word_table(words),
        Table("looks", by_look, _LOOK_COLUMNS, "What tells the sentence, each look alone"),
    ]  # fmt: skip
    return findings, tables, [_matrix(pairs, sentences, episodes)], notes


def _share(right: Any, scenes: int) -> Share:
    return Share.of(float(np.mean(right)), scenes)


def _must_read(found: Told, groups: Labels, sentences: Sentences, pairs: pl.DataFrame) -> Finding:
    share, n, number = _share(found.right, found.scenes), len(groups), len(sentences.keys)
    low, high = share.interval()
    guess = float(np.bincount(groups).max() / n)
    # The lower end: its error is that of as many answers as the share's.
    error = float(found.gained.std()) / math.sqrt(share.effective)
    explained = max(0.0, float(found.gained.mean()) - 1.96 * error) / found.entropy
    explains = _at_least(explained)
    beside = f"(guessing: {guess:.0%}; shuffled sentences: at most {found.shuffled.max():.0%})"
    of = f"which of {number} sentences was given"
    advice, limit = "", _WEAK
    if not found.is_shown:
        sentence = f"Perhaps: this look does not tell {of}: right in {share.value:.0%} of {n} episodes, in at most "
        sentence += f"{high:.0%} {beside}."
    elif low >= TELLS:
        sentence = f"No: the first picture alone tells {of}, in {_at_least(low)} of {n} episodes {beside}; it "
        sentence += f"explains {explains} of the sentences' entropy."
        advice, limit = _advice(pairs), ""
    else:
        sentence = f"Only in part: the first picture alone tells {of} in {share.value:.0%} [{low:.0%}, {high:.0%}] of "
        sentence += f"{n} episodes {beside}; it explains {explains} of the sentences' entropy."
        advice = _advice(pairs)
    numbers: Numbers = {"told": share.value, "low": low, "high": high, "p": found.p}
    numbers |= {"n": n, "guess": guess, "shuffled": float(found.shuffled.mean()), "explained": explained}
    return Finding(sentence, _MUST, numbers, f"{advice} {limit}".strip())


def _at_least(share: float) -> str:
    return f"more than {_ALL:.0%}" if share > _ALL else f"at least {share:.0%}"


def _advice(pairs: pl.DataFrame) -> str:
    """What to record: the told-apart pair whose sentences differ in the fewest words."""
    apart = [(_difference(row["sentence"], row["other"]), row["first"], row["second"], row)
             for row in pairs.filter(verdict=APART).iter_rows(named=True)]  # fmt: skip
    if not apart:
        return ""
    row = min(apart, key=lambda one: one[:3])[3]
    number = enough(LIMIT, 1, NAMED_AT)
    return (
        f"Record '{row['sentence']}' in the scenes of '{row['other']}', too: with {number} episodes of each this shows "
        "whether the picture still tells them apart."
    )


def _difference(one: str, other: str) -> int:
    first, second = (set().union(*words_by_kind(text).values()) for text in (one, other))
    return len(first ^ second)


def _by_what(found: Told) -> list[Finding]:
    """The simplest look that tells the sentence nearly as well as the best one: brightness, state, picture."""
    if not found.is_shown:
        return []
    alone = [
        (name, _share(right, found.scenes)) for name, right in found.by_look.items() if not name.startswith(EVERYTHING)
    ]
    best_name, best = max(alone, key=lambda one: one[1].value)
    simple = sorted(alone, key=lambda one: (one[0].startswith("picture"), -one[1].value))
    name, share = next(one for one in simple if one[1].value >= best.value - _AS_WELL)
    said = f"The {name} alone tells it in {share.value:.0%} {_ends(share)}"
    numbers: Numbers = {"look": name, "told": share.value, "best": best_name}
    bright = [one for one in simple if one[0].startswith("brightness")]
    if name.startswith("picture") and bright:
        dim, one = bright[0]
        said += f"; the {dim} (mean and spread of its colours) in {one.value:.0%} {_ends(one)}"
    limit = "Was each task recorded on a day of its own, in a light of its own?" if name.startswith("bright") else ""
    return [Finding(f"{said}.", _BY_WHAT, numbers, limit)]


def _ends(share: Share) -> str:
    low, high = share.interval()
    return f"[{low:.0%}, {high:.0%}]"


def _where(pairs: pl.DataFrame, groups: list[list[int]], sentences: Sentences) -> Finding:
    counts = {verdict: pairs.filter(verdict=verdict).height for verdict in (SHARED, APART, OPEN)}
    numbers: Numbers = {"shared": counts[SHARED], "apart": counts[APART], "n": pairs.height}
    needed = enough(LIMIT, pairs.height, NAMED_AT)
    few = f"Of {plural(counts[OPEN], 'pair')} it is not known: {needed} episodes a sentence show it in 80% of cases."
    few = few if counts[OPEN] else ""
    if not groups:
        said = f"Nowhere that this look shows: it tells {counts[APART]} of {plural(pairs.height, 'pair')} of sentences "
        return Finding(f"{said}apart in more than {LIMIT:.0%}, none in less.", _WHERE, numbers, few)
    inside = {frozenset(pair) for group in groups for pair in combinations(group, 2)}
    of_groups = [row for row in pairs.iter_rows(named=True) if frozenset((row["first"], row["second"])) in inside]
    mean = float(np.mean([row["told"] for row in of_groups]))
    if len(groups[0]) == len(sentences.keys):
        said = f"Everywhere: all {len(groups[0])} sentences share scenes"
    else:
        said = "; ".join(f"{_named(sentences.names[one] for one in group)} share scenes" for group in groups[:2])
        said += f"; {len(groups) - 2} more groups do" if len(groups) > 2 else ""
    shown = sum(row["verdict"] == SHARED for row in of_groups)
    said += f": the picture tells two of them apart in {mean:.0%} (guessing: 50%; less than {LIMIT:.0%} is shown for "
    said += "each pair)" if shown == len(of_groups) else f"{shown} of {len(of_groups)} pairs)"
    return Finding(f"{said}.", _WHERE, numbers | {"groups": len(groups), "inside": mean}, few)


def _named(names: Iterable[str]) -> str:
    return listing([f"'{name}'" for name in names], _NAMES)


def _asked_by_word(words: pl.DataFrame, episodes: DataEpisodes) -> Finding:
    apart, shared, unclear = (words.filter(verdict=one)["word"].to_list() for one in (APART, SHARED, OPEN))
    n = len(episodes.sentences)
    begin = "Asked by word, as most sentences are told in fewer than five episodes"
    if words.is_empty():
        return Finding(
            f"{begin}: no word is told in {FEWEST} of {n} episodes and another of its kind in as many.", _MUST
        )
    parts = [f"the first picture tells {_named(apart)} from other words of their kind"] if apart else []
    parts += [f"{_named(shared)} are told in the same scenes as others"] if shared else []
    parts += [f"of {plural(len(unclear), 'word')} it is not known"] if unclear else []
    numbers: Numbers = {"apart": len(apart), "shared": len(shared), "n": n}
    return Finding(f"{begin}: {'; '.join(parts)}.", _MUST, numbers, _WEAK)


def _cannot_be_learned(words: pl.DataFrame) -> list[Finding]:
    if words.is_empty():
        return []
    apart, shared = (words.filter(verdict=one) for one in (APART, SHARED))
    numbers: Numbers = {"apart": apart.height, "shared": shared.height, "n": words.height}
    said = []
    if shared.height:
        said.append(f"In the scenes of {_named(shared['word'])} another word is told in its place, too.")
    if apart.height:
        said.append(
            f"Little makes a policy read {_named(apart['word'])}: the picture tells sentences with one of them from "
            f"those with another word there, in more than {LIMIT:.0%} each."
        )
    return [Finding(" ".join(said) or f"Not known of any of {plural(words.height, 'word')}.", _WORDS, numbers)]


def _demonstrations(parts: pl.DataFrame, episodes: DataEpisodes) -> list[Finding]:
    if parts.is_empty():
        return []
    differ, same = parts.drop_nulls("parts_at"), parts.filter("the_same").height
    n, unit, until = parts.height, episodes.unit, episodes.moments[-1]
    numbers: Numbers = {"differ": differ.height, "same": same, "n": n}
    rest = (
        f"in {same} they do not differ until {until:.2g} {unit} (told apart in less than {LIMIT:.0%})" if same else ""
    )
    if differ.is_empty():
        said = f"Not shown in any of {plural(n, 'pair')} that share scenes" + (f"; {rest}" if rest else "")
        return [Finding(f"{said}.", _ACTIONS, numbers)]
    half = float(differ["parts_at"].quantile(0.5, "higher") or 0.0)
    many = "half of them by" if differ.height > 1 else "by"
    said = f"Yes, in {differ.height} of {plural(n, 'pair')} that share scenes, {many} {half:.2g} {unit}: what "
    said += f"was done tells the sentences apart in more than {LIMIT:.0%} (two demonstrations of one sentence: 50%)"
    numbers |= {"parts_at": half}
    return [Finding(f"{said}{'; ' + rest if rest else ''}.", _ACTIONS, numbers)]


def _said_in_ways(ways: pl.DataFrame, told: Sequence[str]) -> Finding:
    sentences, several = int(ways["ways"].sum()), ways.filter(pl.col("ways") > 1)
    vocabulary = {word for sentence in told for word in sentence.split()}
    numbers: Numbers = {"sentences": sentences, "meanings": ways.height, "words": len(vocabulary)}
    limit = (
        f"{plural(len(vocabulary), 'word')} in all. Counted by words with a meaning of their own: synonyms are others."
    )
    if several.is_empty():
        said = f"No: {plural(ways.height, 'thing')} to do, each always said in the same words."
    else:
        top = several.sort("ways", descending=True).row(0, named=True)
        verb = "is" if several.height == 1 else "are"
        said = f"Of {plural(ways.height, 'thing')} to do, {several.height} {verb} said in more than one way; '"
        said += f"{top['sentence']}' in {top['ways']} (this one in {top['commonest']:.0%} of its episodes)."
    return Finding(said, _WAYS, numbers, limit)


def _faults(episodes: DataEpisodes) -> list[Finding]:
    """Sentences that differ in case or punctuation only, episodes under two sentences, and empty ones."""
    otherwise = {key: kinds for key, kinds in episodes.written.items() if key and len(kinds) > 1}
    empty = sum(not sentence for sentence in episodes.sentences)
    parts = []
    if otherwise:
        kinds = max(otherwise.values(), key=lambda one: one.total())
        names = " and ".join(f"'{visible(name)}' ({number})" for name, number in kinds.most_common(2))
        few = len(otherwise)
        whose = f"{plural(few, 'sentence')} {'is' if few == 1 else 'are'}"
        parts.append(f"{whose} written in ways that differ in case or punctuation only, as {names}: counted as one")
    if episodes.several:
        parts.append(f"in {plural(episodes.several, 'episode')} more than one sentence is told: the first counts")
    if empty:
        parts.append(f"in {plural(empty, 'episode')} nothing is told: left out")
    numbers: Numbers = {"otherwise": len(otherwise), "several": episodes.several}
    said = "; ".join(parts)
    return [Finding(f"{said[0].upper()}{said[1:]}.", _FAULTS, numbers | {"empty": empty})] if parts else []


def _matrix(pairs: pl.DataFrame, sentences: Sentences, episodes: DataEpisodes) -> Figure:
    """Pair by pair, those that share scenes first, with a first picture of each sentence."""
    order = [*dict.fromkeys(number for row in pairs.select("first", "second").rows() for number in row)][:_IN_PICTURE]
    both = pl.concat([
        pairs.select("first", "second", "told"), pairs.select(first="second", second="first", told="told"),
    ])  # fmt: skip
    place = {number: i for i, number in enumerate(order)}
    rows = [(place[a], place[b], told) for a, b, told in both.iter_rows() if a in place and b in place]
    names = [f"{sentences.names[number]} ({i + 1})" for i, number in enumerate(order)]
    frame = pl.DataFrame(
        [(str(b + 1), names[a], told) for a, b, told in sorted(rows, key=lambda one: (-one[0], one[1]))],
        schema={"other": pl.String, "sentence": pl.String, "told": pl.Float64}, orient="row",
    )  # fmt: skip
    beside = {names[place[number]]: episodes.pictures[sentences.keys[number]] for number in order}
    options = {"x": "other", "y": "sentence", "value": "told", "share": True, "low": 0.5, "label": "told apart",
               "xlabel": "and this one", "ylabel": "", "beside": beside}  # fmt: skip
    left = len(sentences.keys) - len(order)
    caption = f"{sentences.num_episodes} episodes; 50 % is guessing." + (
        f" {left} more sentences in pairs." if left else ""
    )
    return Figure("pairs", "heat_map", frame, "Which sentences does the first picture tell apart?", caption, options)


def _word_table(words: pl.DataFrame) -> Table:
    by_picture = words["told"].is_not_null().any()
    columns = _WORD_COLUMNS + (_TOLD if by_picture else _OF_PAIRS)
    return Table("words", words, columns, "Word by word")


#: Sentences in the picture; the largest share that is said as it is.
_IN_PICTURE, _ALL = 24, 0.99
_TOLD = [Column("told", "percent", "told by picture", "mean of both groups' shares of right answers; guessing is 50%")]
_PAIR_COLUMNS = [
    Column("differ", "text", "sentences"),
    *_TOLD,
    Column("verdict", "text", "", f"{SHARED}: less than {LIMIT:.0%} is shown; {APART}: more (q <= {NAMED_AT:g})"),
]
_PARTING = [Column("parts_at", "number", "actions part at", "s, or steps of the simulator")]
_WORD_COLUMNS = [
    Column("kind", "text"),
    Column("word", "text"),
    Column("num_episodes", "count", "episodes"),
    Column("verdict", "text"),
]
_OF_PAIRS = [
    Column("shared", "count", "pairs that share scenes"),
    Column("pairs", "count", "of", "pairs of sentences of which one has the word, and the other another of its kind"),
]
_LOOK_COLUMNS = [Column("look", "text"), Column("told", "percent", "tells the sentence in", "of the episodes")]
_WAY_COLUMNS = [
    Column("sentence", "text"),
    Column("ways", "count"),
    Column("num_episodes", "count", "episodes"),
    Column("commonest", "percent", "this one"),
]
