"""The answer of a command as data, and the one way to show it: files, the whole as text, and what fits a screen.

An answer has sections with blank lines between them, the most important first. Its text is written as a file; the
screen gets as much as it holds: first tables are cut after a few rows, then sections are left out and named.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from vla_attention.analyze.show.headings import heading as ruled_heading
from vla_attention.analyze.show.headings import wrap
from vla_attention.analyze.show.output_files import files_lines, write_csv, write_parquet, write_text, writing
from vla_attention.analyze.show.tables import Table

if TYPE_CHECKING:
    import polars as pl

#: Lines of a terminal that show everything at once.
SCREEN_LINES = 40
#: Name of the file with the whole text.
WHOLE_TEXT = "summary.txt"
#: So many rows of a table are left when it is cut.
_FEWEST_ROWS = 5
#: At most so many lines name the sections that are left out.
_MOST_LINES_OF_NAMES = 3


@dataclass(frozen=True)
class Section:
    """Sentences (wrapped to the page), tables, and lists of lines that stand as they are, below a heading or none."""

    parts: Sequence[str | Table | Sequence[str]]
    heading: str = ""

    @property
    def name(self) -> str:
        """What it is called where it is left out: the heading, line or header that it begins with; or nothing."""
        if self.heading:
            first = self.heading
        elif any(isinstance(part, Table) for part in self.parts):
            top = self.parts[0]
            first = str(top.columns[0].header) if isinstance(top, Table) else top if isinstance(top, str) else top[0]
        else:
            return ""
        return first.split("  ")[0].rstrip(":")

    def __str__(self) -> str:
        below = [line for part in self.parts for line in ([str(part)] if isinstance(part, Table) else _lines(part))]
        return "\n".join([*([ruled_heading(self.heading)] if self.heading else []), *below])

    def on_screen(self, cut: bool) -> list[str]:
        """Its lines without rules; with `cut`, of a table the first rows and how many more there are."""
        lines = wrap(self.heading)
        for part in self.parts:
            if not isinstance(part, Table):
                lines += _lines(part)
                continue
            head, rows = part.laid_out()
            more = len(rows) - _FEWEST_ROWS
            cutting = cut and part.can_be_cut and more > 1
            lines += [*head, *(line for row in rows[: _FEWEST_ROWS if cutting else None] for line in row)]
            lines += [f"... {more} more rows in {WHOLE_TEXT}"] if cutting else []
        return lines


def _lines(part: str | Sequence[str]) -> list[str]:
    return wrap(part) if isinstance(part, str) else list(part)


def text_of(sections: Sequence[Section]) -> str:
    """The whole text, at most `headings.WIDTH` columns wide."""
    return "\n\n".join(filter(None, map(str, sections)))


@dataclass(frozen=True)
class Answer:
    """What a command found.

    Attributes:
        sections: what is said and printed.
        tables: name -> table, or parts of one; each is a file NAME.parquet.
        draw: into a folder; returns the files of the pictures.
        csv: whether the tables are files NAME.csv too.
        whole: whether all of the text is printed, however long, and is no file.
    """

    sections: Sequence[Section]
    tables: Mapping[str, pl.DataFrame | Iterable[pl.DataFrame]] = field(default_factory=dict)
    draw: Callable[[Path], list[Path]] | None = None
    csv: bool = False
    whole: bool = False

    def show(self, folder: Path, pictures: bool) -> int:
        """Write text, tables and pictures into a folder, and print what fits a screen; returns the exit code."""
        if self.whole:
            print(text_of(self.sections))
        # Nothing is made for an answer of pictures alone, whose drawing may end with an error.
        files = write_parquet(folder, **self.tables) if self.tables else []
        files += write_csv(folder, **self.tables) if self.tables and self.csv else []
        if not self.whole:
            files.append(write_whole(folder, text_of(self.sections)))
        if self.draw is not None and pictures:
            files += self.draw(folder)
        print("\n".join(files_lines(folder, files)) if self.whole else fitted(self.sections, folder, files))
        return 0


def write_whole(folder: Path, text: str) -> Path:
    """Write the whole text into a folder; returns its path."""
    path = folder / WHOLE_TEXT
    with writing("results", folder):
        write_text(path, text.rstrip("\n") + "\n")
    return path


def fitted(sections: Sequence[Section], folder: Path, files: Sequence[Path]) -> str:
    """What to print of an answer whose whole text is in a folder, with the other files in it: a screen of lines."""
    others = [file for file in files if file != folder / WHOLE_TEXT]
    last = [*wrap(f"The whole: {folder / WHOLE_TEXT}", rest="  "), *files_lines(folder, others)]
    blocks = [(section.name, lines) for section in sections if (lines := section.on_screen(cut=False))]
    if sum(len(lines) + 1 for _, lines in blocks) > SCREEN_LINES - len(last):
        blocks = [(section.name, lines) for section in sections if (lines := section.on_screen(cut=True))]
    # More lines for the names of what is left out leave out more.
    for lines_of_names in range(_MOST_LINES_OF_NAMES + 1):
        room = SCREEN_LINES - len(last) - lines_of_names
        shown: list[str] = []
        names = []
        for name, lines in blocks:
            if len(shown) + len(lines) + 1 <= room:
                shown += [*lines, ""]
            elif name:
                names.append(name)
        named = wrap(f"Also in {WHOLE_TEXT}: {'; '.join(names)}.") if names else []
        if len(named) <= lines_of_names:
            break
    return "\n".join([*shown, *named[:lines_of_names], *last])
