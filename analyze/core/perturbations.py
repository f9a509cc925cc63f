"""What a policy does where LIBERO-PRO changed something: a row for each suite, by what was changed."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

import polars as pl

from vla_attention.analyze.core.naming import Naming
from vla_attention.analyze.core.result import Column, Finding, Table
from vla_attention.analyze.measures.question import Question
from vla_attention.analyze.measures.tables import EPISODE_ID
from vla_attention.schemas.errors import plural

#: What a suite of LIBERO-PRO changes, by the end of its name.
_CHANGED = {"lan": "the sentence", "object": "an object", "swap": "places", "task": "the task"}
_SUITE = re.compile(rf"libero_pro_.+_({'|'.join(_CHANGED)})")
_SAID = {
    "solved": "{:.0%} solved",
    "did": "{:.0%} did as told",
    "named": "what is named gets {:.2g} times as much attention as where it is not named",
}
_COLUMNS = [
    Column("kind", "text", "changed"),
    Column("run", "text"),
    Column("suite", "text"),
    Column("solved", "percent"),
    Column("did", "percent", "did as told"),
    Column(
        "named",
        "factor",
        "named / not",
        "attention to what is named, over that to the same thing where it is not, at the first policy call",
    ),
    Column("num_episodes", "count", "episodes"),
    Column("pairs", "count", "pairs", "with the first run, from the same initial states; 0: not paired"),
]


def any_perturbed(suites: Iterable[str]) -> bool:
    """Whether one of the suites is LIBERO-PRO's."""
    return any(_SUITE.fullmatch(suite) for suite in suites)


def by_suite(question: Question, asked: pl.DataFrame, named: Sequence[Naming]) -> pl.DataFrame:
    """A row a suite: kind (what was changed), suite, solved, did, named, num_episodes. Every task weighs the same.

    Args:
        question: its selected episodes.
        asked: of `behaviour`: what was told and done.
        named: of `naming.named_in`; a suite of which nothing shows it has none.
    """
    schema = {**dict(zip(EPISODE_ID, (pl.String, pl.Int64, pl.Int64), strict=True)), "solved": pl.Float64}
    rows = pl.DataFrame([(*one.key, one.episode.attributes.success) for one in question.selected], schema, orient="row")
    rows = rows.join(asked.select(*EPISODE_ID, did=pl.col("as_told").cast(pl.Float64)), on=EPISODE_ID, how="left")
    logs = [one.episodes.select(*EPISODE_ID, named="log_ratio") for one in named]
    none = rows.clear().select(*EPISODE_ID, named=pl.lit(None, pl.Float64))
    rows = rows.join(pl.concat([none, *logs]), on=EPISODE_ID, how="left")
    means = [pl.mean("solved", "did", "named")]
    tasks = rows.group_by("suite", "task_id").agg(pl.len().alias("num_episodes"), *means)
    suites = tasks.group_by("suite").agg(pl.sum("num_episodes"), *means).sort("suite")
    kinds = [_CHANGED[found[1]] if (found := _SUITE.fullmatch(suite)) else "nothing" for suite in suites["suite"]]
    return suites.with_columns(named=pl.col("named").exp(), kind=pl.Series(kinds, dtype=pl.String))


def perturbations(table: pl.DataFrame) -> tuple[Finding, Table]:
    """The rows of `by_suite` of one or several runs (run, pairs) in a sentence, and as a table."""
    several = "run" in table.columns
    said = []
    for row in table.iter_rows(named=True):
        values = [how.format(row[name]) for name, how in _SAID.items() if row[name] is not None]
        run = f" ({row['run']})" if several else ""
        said.append(f"{row['kind']} changed{run}: {', '.join([plural(row['num_episodes'], 'episode'), *values])}")
    apart = table.height > 1 and (not several or (table["pairs"] == 0).any())
    limit = "Not paired, so differences of scenes are in it: each suite has initial states of its own." if apart else ""
    columns = [column for column in _COLUMNS if column.name in table.columns]
    shown = Table("perturbations", table, columns, "By what LIBERO-PRO changed")
    sentence = "; ".join(said)
    return Finding(f"{sentence[0].upper()}{sentence[1:]}.", "By what was changed?", limit=limit), shown
