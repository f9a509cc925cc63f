"""Results as one self-contained HTML page. A report is the page of several results."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from functools import cache, partial

import jinja2

from vla_attention.analyze.core.result import Figure, Result, Table
from vla_attention.analyze.render.figures import content
from vla_attention.analyze.render.numbers import cell
from vla_attention.analyze.render.style import Style
from vla_attention.schemas.safe_text import visible

#: Rows of a table on the page; the files have all.
_MOST_ROWS = 100
#: Width of a picture, two of which stand side by side: text is as large as the page's small print.
_INCHES = 5.4
#: Rows of a table that stands open.
_SHORT = 12


def fragment(result: Result) -> str:
    """One result as HTML without a page around it, for notebooks."""
    return _environment().get_template("result.html").render(result=result, title="")


def page(title: str, results: Sequence[Result], version: str = "") -> str:
    """The page. It needs no network and nothing beside it."""
    return _environment().get_template("page.html").render(title=title, results=results, version=version)


@cache
def _environment() -> jinja2.Environment:
    """The folder `templates/`. Every text is escaped and `visible`; an unknown name in a template is an error."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("vla_attention.analyze.render"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        finalize=lambda value: visible(value) if type(value) is str else value,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.globals.update(
        cell=cell, picture=_picture, most=_MOST_ROWS, open_tables=partial(_tables, folded=False),
        folded_tables=partial(_tables, folded=True),
    )  # fmt: skip
    return environment


def _tables(result: Result, folded: bool) -> list[Table]:
    """The tables with rows: the first is open where it is short and no picture shows it, all where they were asked for.

    All others are folded: who wants numbers opens them.
    """
    tables = [table for table in result.tables if table.columns and table.shown.height]
    first = bool(tables) and not result.figures and tables[0].shown.height <= _SHORT
    number = len(tables) if result.whole else int(first)
    return tables[number:] if folded else tables[:number]


def _picture(figure: Figure) -> tuple[str, bool]:
    """The address of a picture that stands in the page itself, and whether it is wide.

    Photographs are WebP, half the bytes of PNG.
    """
    kind = "webp" if figure.kind == "pictures" else "png"
    (drawn,), inches = content(figure, Style(inches=_INCHES), (kind,))
    return f"data:image/{kind};base64,{base64.b64encode(drawn).decode()}", inches > _INCHES
