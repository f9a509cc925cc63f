"""A long text on a screen: what fits is printed, and the whole is in a file.

A text is a sequence of blocks with blank lines between them. A block with a rule begins with its name, which may have
two spaces and more words behind it; it may hold a table of `text_table`. The most important blocks stand first.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from vla_attention.analyze.show.headings import wrap
from vla_attention.analyze.show.output_files import files_lines, write_text, writing

#: Lines of a terminal that show everything at once.
SCREEN_LINES = 40
#: Name of the file with the whole text.
WHOLE_TEXT = "summary.txt"
#: So many rows of a table are left when it is cut.
_FEWEST_ROWS = 5
#: At most so many lines name the blocks that are left out.
_MOST_LINES_OF_NAMES = 3


@dataclass
class _Block:
    """Lines without rules, its name (empty without a rule), and from `first` to `last` the rows of its table."""

    lines: list[str]
    name: str
    first: int
    last: int

    def cut(self) -> None:
        """Leave the table's first rows, and say how many more there are."""
        more = self.last - self.first - _FEWEST_ROWS
        if more > 1:
            self.lines[self.first + _FEWEST_ROWS : self.last] = [f"... {more} more rows in {WHOLE_TEXT}"]
            self.last = self.first


def write_whole(folder: Path, text: str) -> Path:
    """Write the whole text into a folder; returns its path."""
    path = folder / WHOLE_TEXT
    with writing("results", folder):
        write_text(path, text.rstrip("\n") + "\n")
    return path


def fitted(text: str, folder: Path, files: Sequence[Path]) -> str:
    """What to print of a text that `write_whole` has written, with the files in the folder: a screen of lines.

    Rules are left out. Where that is too long, tables are cut after a few rows, and then blocks that do not fit are
    left out and named.
    """
    others = [file for file in files if file != folder / WHOLE_TEXT]
    last = [*wrap(f"The whole: {folder / WHOLE_TEXT}", rest="  "), *files_lines(folder, others)]
    blocks = [_block(part.splitlines()) for part in text.strip("\n").split("\n\n") if part.strip()]
    if sum(len(block.lines) + 1 for block in blocks) > SCREEN_LINES - len(last):
        for block in blocks:
            block.cut()
    # More lines for the names of what is left out leave out more.
    for lines_of_names in range(_MOST_LINES_OF_NAMES + 1):
        shown, names = _first_that_fit(blocks, SCREEN_LINES - len(last) - lines_of_names)
        named = wrap(f"Also in {WHOLE_TEXT}: {'; '.join(names)}.") if names else []
        if len(named) <= lines_of_names:
            break
    return "\n".join([*shown, *named[:lines_of_names], *last])


def _first_that_fit(blocks: Sequence[_Block], room: int) -> tuple[list[str], list[str]]:
    """Lines of the blocks that fit, each with a blank one behind it, and the names of the other blocks."""
    shown: list[str] = []
    left_out: list[str] = []
    for block in blocks:
        if len(shown) + len(block.lines) + 1 <= room:
            shown += [*block.lines, ""]
        elif block.name:
            left_out.append(block.name)
    return shown, left_out


def _block(lines: list[str]) -> _Block:
    """A block without its rules. A table's rows are as long as the rule under its header, which is as long as they."""
    kept: list[str] = []
    first = last = width = 0
    for line in lines:
        if line and set(line) <= {"·"}:
            first = last = len(kept)
            width = len(line)
        elif not (line and set(line) <= {"-"}):
            kept.append(line)
            if first and last == len(kept) - 1 and len(line) == width:
                last = len(kept)
    name = kept[0].split("  ")[0].rstrip(":") if len(kept) < len(lines) else ""
    return _Block(kept, name, first, last)
