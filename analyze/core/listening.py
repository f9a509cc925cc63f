"""Whether a policy does what it is told, and which kinds of sentences and which words it hears.

All is of the rows of `behaviour.with_choices`. A policy that is deaf to half of its sentences does what it is told more
often than with shuffled ones, too. So every part of what was told is asked by itself: a kind of sentence (a template),
and a word in which the sentences of a stratum differ.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import polars as pl
from numpy.typing import NDArray

from vla_attention.analyze.core.exchanged import words_by_kind
from vla_attention.analyze.core.result import Column, Finding, Table
from vla_attention.analyze.statistics.exact_tests import Shuffled, fewer, share_interval, share_shown, shuffled
from vla_attention.analyze.statistics.many_looks import SHOWN_AT, holm
from vla_attention.schemas.errors import listing, plural
from vla_attention.schemas.groupings.words import folded_words

LISTENS = "Does it listen?"
#: Where a policy does not: nothing may have made it read.
ASK_THE_DATA = "vla-attention data TRAINING_DATA   # could the first picture tell it the sentence?"
#: From this share of episodes on, what was done most is said.
_MOSTLY = 0.8
#: Of the words that are heard, or not, so many are named.
_MOST_NAMED = 5
FAMILY, WORD = "kind of sentence", "word"
#: heard: what was done goes with it. not heard: it was done less often than the rest, and does not go with it.
#: not shown: neither, where the episodes could have shown it. too few: they could not.
HEARD, NOT_HEARD, NOT_SHOWN, TOO_FEW = "heard", "not heard", "not shown", "too few episodes"
#: What is said of all that was told; not known: the pictures could say what to do.
LISTENS_TO_ALL, IN_PART, NOT_KNOWN = "listens", "listens in part", "not known"
_VERDICTS = {"heard": HEARD, "not_heard": NOT_HEARD}
_SCHEMA = {"kind": pl.String, "item": pl.String, "right": pl.Int64, "num_episodes": pl.Int64, "other": pl.Int64,
           "p": pl.Float64, "verdict": pl.String, "fails": pl.Boolean}  # fmt: skip


def listens(asked: pl.DataFrame) -> Finding:
    """Whether it did what it was told more often than with shuffled instructions, of the rows of `with_choices`."""
    if asked.is_empty():
        return Finding(
            "Nobody knows what it did: the store holds no steps (positions, touches, goals), which our simulators "
            "record. A rerun of stored calls does nothing of its own.",
            LISTENS,
            next_step="va.language_test(call, inputs, sentences)   # Python, with your policy: does its action change?",
        )
    shown, n = asked.filter(pl.col("left_out").is_null()), asked.height
    rest = [*asked.drop_nulls("left_out")["left_out"].value_counts(sort=True).sort("left_out").iter_rows()]
    left = [f"{plural(count, 'episode')} left out: {why}." for why, count in rest]
    if shown.is_empty():
        done = asked.filter("as_told").height
        whys = "; ".join(f"in {count} of {plural(n, 'episode')}, {why}" for why, count in rest)
        return Finding(
            f"These episodes cannot show whether it listens: {whys}. It did what it was told in {done} of {n}.",
            LISTENS,
            {"right": done, "n": n},
            "Tell two tasks in one scene, best from the same initial states.",
        )
    told, first = shown["told_goal"].to_list(), shown["first"].to_list()
    # Where each task has its own initial states, the pictures say what to do as well as the words.
    found = shuffled(told, first, shown["block"].to_list())
    alike = shown.filter(pl.col("told_goal").n_unique().over("block") > 1)
    shared = found.least_p <= SHOWN_AT or 2 * alike.height > shown.height
    if shared:
        compared = alike
    else:
        found, compared = shuffled(told, first, shown["stratum"].to_list()), shown
    limits = [_apart(shown, compared, shared)]
    right, n = compared.filter(pl.col("told_goal") == pl.col("first")).height, compared.height
    low, high = share_interval(right, n)
    p = "p < 0.001" if found.p_value < 0.001 else f"p = {found.p_value:.2g}"
    by_chance = f"with the instructions shuffled, {found.expected - (found.matches - right):.3g} would be; {p}"
    does = f"it did what it was told in {right} of {n} episodes [{low:.0%}, {high:.0%}]"
    does += " in which it could have done another task"
    numbers: dict[str, float | int | str] = {"right": right, "n": n, "low": low, "high": high}
    numbers |= {"expected": found.expected, "p": found.p_value}
    verdict = TOO_FEW if found.least_p > SHOWN_AT else NOT_SHOWN if found.p_value > SHOWN_AT else NOT_KNOWN
    if found.p_value > SHOWN_AT:
        sentence = f"Not shown to listen: {whatever(compared)}{does}"
        limits.append(_could_show(compared, "block" if shared else "stratum", found.least_p))
    elif not shared:
        sentence = f"{does[0].upper()}{does[1:]}"
    else:
        parts = parts_heard(compared, SHOWN_AT)
        to, few, named = _to_what(parts)
        sentence = f"It listens{to}: {does}"
        limits.append(few)
        verdict = IN_PART if to else LISTENS_TO_ALL
        numbers |= {name: ", ".join(named.filter(verdict=which)["item"]) for name, which in _VERDICTS.items()}
    if nothing := compared["first"].null_count():
        limits.append(f"In {plural(nothing, 'episode')} none of the told goals was reached.")
    another = pl.col("before").is_not_null() | pl.col("first").ne_missing(pl.col("told_goal"))
    if others := compared.filter(pl.col("outcome") & another).height:
        limits.append(f"In {plural(others, 'solved episode')} another goal held before the told one.")
    numbers |= {"nothing_reached": nothing, "verdict": verdict}
    return Finding(f"{sentence} ({by_chance}).", LISTENS, numbers, " ".join([*filter(None, limits), *left]))


def _apart(shown: pl.DataFrame, compared: pl.DataFrame, shared: bool) -> str:
    """That the pictures could say what to do, where tasks do not share initial states."""
    if not shared:
        alone = shown.select((pl.col("told_goal").n_unique().over("block") == 1).all()).item()
        whose = "Each task has its" if alone else "Most tasks have their"
        return f"{whose} own initial states here, so the pictures could say what to do."
    rest = shown.join(compared, on=["suite", "task_id", "episode_index"], how="anti")
    if rest.is_empty():
        return ""
    done = rest.filter(pl.col("told_goal") == pl.col("first")).height
    return (
        f"Not counted: {plural(rest.height, 'episode')} whose initial state no other task shares, so that the pictures "
        f"could say what to do; it did what it was told in {done} of them."
    )


def _could_show(shown: pl.DataFrame, strata: str, least_p: float) -> str:
    """What a run of this size could have shown."""
    share = share_shown(shown["told_goal"].to_list(), shown[strata].to_list(), SHOWN_AT)
    if share is None:
        return f"Too few episodes: even without a mistake p would be {least_p:.2g}."
    said = f"With {plural(shown.height, 'episode')}, a policy that is right in {share:.0%} is shown to listen"
    return f"{said} in 80% of runs."


def _to_what(parts: pl.DataFrame) -> tuple[str, str, pl.DataFrame]:
    """To which kinds of sentences, or words, it listens and to which not; that these are too few to say it; and which.

    Nothing where no part of what was told fails. Kinds of sentences come before words.
    """
    of_kinds = [parts.filter(kind=kind) for kind in (FAMILY, WORD)]
    failing = next((part for part in of_kinds if part["fails"].any()), None)
    few = parts.filter(verdict=TOO_FEW)["kind"].unique(maintain_order=True)
    limit = f"Too few episodes to say it of each {' or '.join(few)}." if len(few) else ""
    if failing is None:
        return "", limit, parts
    heard, deaf = (failing.filter(verdict=verdict) for verdict in (HEARD, NOT_HEARD))
    unclear = failing.filter(pl.col("fails") & (pl.col("verdict") != NOT_HEARD))
    to = f" to {_counts(heard)}" if heard.height else " in part"
    to += f", not to {_counts(deaf)}" if deaf.height else ""
    to += f", and is not shown to listen to {_counts(unclear)}" if unclear.height else ""
    return to, limit, failing


def _counts(parts: pl.DataFrame) -> str:
    rows = parts.select("item", "right", "num_episodes").rows()
    return listing([f"'{item}' ({done} of {n})" for item, done, n in rows], _MOST_NAMED)


def whatever(shown: pl.DataFrame) -> str:
    """What was done in most of the episodes, told more than one thing."""
    for column, how in (("touched", "touched the {}"), ("did", "reached the goal of '{}'")):
        for value, count in shown[column].drop_nulls().value_counts(sort=True).head(1).iter_rows():
            if count >= _MOSTLY * shown.height and shown.filter(pl.col(column) == value)["told_goal"].n_unique() > 1:
                often = f"in {count} of {shown.height} episodes"
                return f"whatever it was told, it {how.format(value)} first ({often}); "
    return ""


class _Part(NamedTuple):
    """Something that was told: in which episodes, which did it, and among which it is shuffled; (episode,) bool."""

    kind: str
    item: str
    told: NDArray[np.bool_]
    did: NDArray[np.bool_]
    among: NDArray[np.bool_]

    @property
    def rest(self) -> NDArray[np.bool_]:
        """What else was told: in all other kinds of sentences, or in sentences without the word."""
        return ~self.told if self.kind == FAMILY else self.among & ~self.told


def parts_heard(shown: pl.DataFrame, level: float) -> pl.DataFrame:
    """Kinds of sentences and words that were told, and whether the policy does what they say.

    A part is heard where what was done goes with it (`shuffled` within the blocks, Holm over all parts), and, of a
    word, where it is also told from every other word that could have been said instead. It is not heard where that is
    not shown and it was done less often than all the rest was (Fisher, Holm), of the episodes that reached any goal: a
    policy that cannot lift is not deaf to it.

    Args:
        shown: the episodes that count, with `block`: episodes within which sentences can be shuffled.
        level: p at which a part is named, in either direction.

    Returns:
        kind, item, right (did what they were told), num_episodes (told it), other (reached another told goal),
        p (Holm), verdict, fails (whether "it listens" would say too much).
    """
    goals, first = shown["told_goal"].to_numpy(), shown["first"].to_numpy()
    blocks = shown["block"].to_numpy()
    right, reached = goals == first, shown["first"].is_not_null().to_numpy()
    parts = [*_families(shown, right), *_words(shown)]
    if not parts:
        return pl.DataFrame(schema=_SCHEMA)
    tests = [_shuffled(part, goals, first, blocks) for part in parts]
    lower = []
    for part in parts:
        of, rest = part.told & reached, part.rest & reached
        lower.append(fewer(int((part.did & of).sum()), int(of.sum()), int((right & rest).sum()), int(rest.sum())))
    own, below = holm([one.p_value for one in tests]), holm(lower)
    rows = []
    for part, test, p, less in zip(parts, tests, own, below, strict=True):
        number, done = int(part.told.sum()), int((part.did & part.told).sum())
        heard = p <= level and 2 * done > number and _told_apart(part, parts, blocks, level)
        unheard = not heard and test.p_value > level and less <= level
        could = test.least_p * len(parts) <= level
        verdict = HEARD if heard else NOT_HEARD if unheard else NOT_SHOWN if could else TOO_FEW
        fails = verdict in (NOT_HEARD, NOT_SHOWN) or 2 * done <= number
        other = int((~part.did & part.told & reached).sum())
        rows.append((part.kind, part.item, done, number, other, p, verdict, fails))
    return pl.DataFrame(rows, schema=_SCHEMA, orient="row")


def _shuffled(
    part: _Part, goals: NDArray[np.object_], first: NDArray[np.object_], blocks: NDArray[np.object_]
) -> Shuffled:
    at = part.among
    if part.kind == FAMILY:
        return shuffled(goals[at].tolist(), first[at].tolist(), blocks[at].tolist())
    return _of_word(part, at, blocks)


def _of_word(part: _Part, at: NDArray[np.bool_], blocks: NDArray[np.object_]) -> Shuffled:
    told, did = np.where(part.told[at], "yes", "no"), np.where(part.did[at], "yes", "")
    return shuffled(told.tolist(), did.tolist(), blocks[at].tolist())


def _told_apart(part: _Part, parts: list[_Part], blocks: NDArray[np.object_], level: float) -> bool:
    """Whether a word is told from every other one: who does 'green' for every colour but red hears no 'green'."""
    others = [other for other in parts if other.kind == part.kind == WORD and other is not part]
    tests = [_of_word(part, part.among & other.among & (part.told != other.told), blocks) for other in others]
    return all(test.p_value <= level or test.least_p > level for test in tests)


def _families(shown: pl.DataFrame, right: NDArray[np.bool_]) -> list[_Part]:
    """The templates with several told goals; none where all sentences are of one."""
    kinds = shown["stratum"].str.split("\t").list.last().to_numpy()
    names = sorted({kind for kind in kinds if kind})
    if len(set(kinds)) < 2:
        return []
    return [_Part(FAMILY, name, kinds == name, right & (kinds == name), kinds == name) for name in names]


def _words(shown: pl.DataFrame) -> list[_Part]:
    """The words, or words that always stand together, in which told sentences of a stratum differ."""
    sentences = dict(
        shown.select("goals").explode("goals").unnest("goals").select("goal", "instruction").unique().rows()
    )
    goals, first, strata = (shown[name].to_numpy() for name in ("told_goal", "first", "stratum"))
    said = {goal: set().union(*words_by_kind(sentences[goal]).values()) for goal in sentences}
    told_in = {stratum: {*goals[strata == stratum]} for stratum in set(strata)}
    order = dict.fromkeys(word for goal in sorted({*goals}) for word in folded_words(sentences[goal]))
    together: dict[tuple[frozenset[str], ...], list[str]] = {}
    for word in order:
        having = tuple(frozenset(goal for goal in told if word in said[goal]) for told in told_in.values())
        together.setdefault(having, []).append(word)
    found = []
    for having, words in together.items():
        among = np.zeros(len(goals), bool)
        for (stratum, told), with_it in zip(told_in.items(), having, strict=True):
            among |= (strata == stratum) & (0 < len(with_it) < len(told))
        carrying = frozenset().union(*having)
        of_first = np.array([goal is not None and words[0] in said[goal] for goal in first])
        if among.any():
            found.append(_Part(WORD, " ".join(words), among & np.isin(goals, [*carrying]), among & of_first, among))
    return found


def table_of_parts(asked: pl.DataFrame) -> list[Table]:
    """What was told and done by kinds of sentences and words, of the rows of `with_choices`."""
    parts = parts_heard(asked.filter(pl.col("left_out").is_null()), SHOWN_AT)
    columns = [
        Column("kind", "text"),
        Column("item", "text", "told"),
        Column("right", "count", "did it"),
        Column("num_episodes", "count", "of"),
        Column("other", "count", "did another", "reached another of the told goals first"),
        Column("p", "p", "p", "of what is done having nothing to do with it, adjusted for the rows (Holm)"),
        Column("verdict", "text", "heard?"),
    ]
    return [Table("told_parts", parts.drop("fails"), columns, "By kind of sentence and word")] if parts.height else []
