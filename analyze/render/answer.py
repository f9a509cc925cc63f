"""A result with the ways to see it: in a notebook, as text, as pictures, as files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING

from vla_attention.analyze.core.result import Result
from vla_attention.analyze.render.files import write_result
from vla_attention.analyze.render.style import Style, StyleName
from vla_attention.analyze.render.terminal import screen
from vla_attention.schemas.errors import unknown_name

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas


@dataclass(frozen=True, repr=False)
class Answer(Result):
    """A `Result` that shows itself: `print(answer)`, the last line of a notebook's cell, `.plot()`, `.save(folder)`."""

    @classmethod
    def of(cls, result: Result) -> Answer:
        """The same result."""
        return cls(**{field.name: getattr(result, field.name) for field in fields(Result)})

    def __str__(self) -> str:
        return screen(self)

    #: At Python's prompt too: what it holds would fill many screens.
    __repr__ = __str__

    def _repr_html_(self) -> str:
        from vla_attention.analyze.render.page import fragment

        return fragment(self)

    def plot(self, name: str = "", style: StyleName = "screen") -> Canvas:
        """One of the figures as a matplotlib figure: the first one unless a name is given.

        Raises:
            UnknownName: there is no such figure, or none at all.
        """
        from vla_attention.analyze.render.figures import draw

        known = {figure.name: figure for figure in self.figures}
        if (name or next(iter(known), "")) not in known:
            raise unknown_name("figure", name, known)
        return draw(known[name] if name else self.figures[0], Style(style))

    def save(
        self,
        folder: str | Path,
        csv: bool = False,
        pictures: bool = True,
        style: StyleName = "screen",
        formats: Sequence[str] = (),
    ) -> list[Path]:
        """Write `result.json`, every table (Parquet, or CSV) and every picture into a folder; returns the paths.

        formats: of the pictures, png unless given; for print (`style="paper"`) pdf too.

        Raises:
            BadArgument: the folder cannot be made or written to.
        """
        written = write_result(self, Path(folder), csv)
        if pictures and self.figures:
            from vla_attention.analyze.render.figures import save

            for figure in self.figures:
                written += save(figure, Path(folder), Style(style), formats)
        return written
