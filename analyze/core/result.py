"""What a question found, as data. Commands make it, `analyze.render` shows it, and nothing reads a text back."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, TypeAlias

import polars as pl

from vla_attention.schemas.errors import unknown_name

#: What the values of a column are. prose: text of any length, in the last column. percent: a share, 0.5 is 50 %.
#: factor: 1 is no change. signed: with its sign. points: a difference of shares, with its sign. p: a p-value or what it
#: was adjusted to.
Kind: TypeAlias = Literal["text", "prose", "count", "number", "percent", "factor", "signed", "points", "p"]
#: The kinds of `analyze.render.figures`.
FigureKind: TypeAlias = Literal[
    "forest", "lines", "courses", "heat_map", "stacked", "distribution", "scatter", "pictures"
]


@dataclass(frozen=True)
class Column:
    """How a column of a frame is shown. Where the frame has NAME_low and NAME_high, they are its interval everywhere.

    Attributes:
        name: of the column.
        kind: what its values are, see `Kind`.
        header: above it; the name without underscores unless it is given.
        meaning: what the values are, said once below the table.
        screen: whether a terminal shows it too.
    """

    name: str
    kind: Kind = "number"
    header: str = ""
    meaning: str = ""
    screen: bool = True

    @property
    def title(self) -> str:
        """What stands above the column."""
        return self.header or self.name.replace("_", " ")


@dataclass(frozen=True)
class Table:
    """A frame, and what of it is shown. Files hold all of its rows and columns.

    Attributes:
        name: of the table and its file.
        frame: the rows; lazy where they are those of thousands of episodes.
        columns: those that texts show, in order; a table without any is in the files only.
        title: above it.
        where: the rows that texts show; all unless it is given.
        rows: how many of them a terminal shows at most.
        of: name of the table whose file has these rows; without one the table has a file of its own.
        file: whether it has a file at all; a large one that few ask for is for Python and for `--by`.
    """

    name: str
    frame: pl.DataFrame | pl.LazyFrame
    columns: Sequence[Column] = ()
    title: str = ""
    where: pl.Expr | None = None
    rows: int = 12
    of: str = ""
    file: bool = True

    @property
    def shown(self) -> pl.DataFrame:
        """The rows that texts show."""
        rows = self.frame.lazy() if self.where is None else self.frame.lazy().filter(self.where)
        return rows.collect()

    @property
    def names(self) -> list[str]:
        """The columns of the frame."""
        return self.frame.lazy().collect_schema().names()

    @property
    def legend(self) -> dict[str, str]:
        """What the columns mean, by their titles."""
        return {column.title: column.meaning for column in self.columns if column.meaning}


@dataclass(frozen=True)
class Finding:
    """A sentence that may be quoted, and what it rests on.

    Attributes:
        sentence: the answer, with its estimate.
        asks: the question that it answers, in a few words: "Does it listen?".
        numbers: what the sentence says as numbers, by name: estimate, low, high, p, n and the like.
        limit: what the data do not show, as a sentence: too few episodes, one scene.
        next_step: a command line that shows more.
    """

    sentence: str
    asks: str = ""
    numbers: Mapping[str, float | int | str | None] = field(default_factory=dict)
    limit: str = ""
    next_step: str = ""


@dataclass(frozen=True)
class Figure:
    """A picture of a frame.

    Attributes:
        name: of the picture's file.
        kind: how it is drawn, see `analyze.render.figures`, which lists the options of each kind.
        frame: what is drawn.
        title: one line above it.
        caption: what is drawn, over how much, and what the bars are: below it in print.
        options: columns and looks.
    """

    name: str
    kind: FigureKind
    frame: pl.DataFrame
    title: str
    caption: str = ""
    options: Mapping[str, object] = field(default_factory=dict)


@dataclass(frozen=True)
class Result:
    """The answer of a question.

    Attributes:
        title: the question.
        about: what was run: policy, suite, episodes solved, and what was changed in the run.
        findings: the answer first; the most important ones in front.
        tables: the numbers, those that answer in front.
        figures: pictures.
        notes: what to know beside the numbers: site, layers, what was left out, what intervals are about.
        files: what is written besides tables and pictures, by name: results files of the published scripts, videos.
            Each writes itself to a path.
        whole: whether a terminal shows all rows, however many: what was asked for is a list.
    """

    title: str
    about: Sequence[str]
    findings: Sequence[Finding]
    tables: Sequence[Table]
    figures: Sequence[Figure] = ()
    notes: Sequence[str] = ()
    files: Mapping[str, Callable[[Path], object]] = field(default_factory=dict)
    whole: bool = False

    def __getitem__(self, name: str) -> pl.DataFrame:
        """The frame of the table with this name, all its rows.

        Raises:
            UnknownName: no table has it.
        """
        for table in self.tables:
            if table.name == name:
                return table.frame.lazy().collect()
        raise unknown_name("table", name, [table.name for table in self.tables])
