"""The tables of `docs/validation.md`, written between marks from the file of results."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.validation.numbers import NUMBERS
from benchmarks.validation.policies import TITLES
from benchmarks.validation.ranks import FAMILIES
from vla_attention.analyze.render.numbers import format_number
from vla_attention.schemas.errors import BadArgument

Results = Mapping[str, Any]


def markdown(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table."""
    lines = [f"| {' | '.join(header)} |", f"|{'---|' * len(header)}"]
    return "\n".join([*lines, *(f"| {' | '.join(row)} |" for row in rows)])


def numbers_table(results: Results) -> str:
    """A row for each number, a column for each kind of policy, a value for each training."""
    kinds = [kind for kind in TITLES if any(policy["control"] == kind for policy in results["policies"])]

    def cell(kind: str, name: str) -> str:
        own = [policy["numbers"] for policy in results["policies"] if policy["control"] == kind]
        return ", ".join(format_number(of[name]) for of in own if name in of) or "-"

    solved = [
        ", ".join(f"{policy['solved']}" for policy in results["policies"] if policy["control"] == kind)
        for kind in kinds
    ]
    rows = [("solved, of 12", *solved)]
    rows += [(title, *(cell(kind, name) for kind in kinds)) for name, title in NUMBERS.items()]
    return markdown(("", *(TITLES[kind] for kind in kinds)), rows)


def ranks_table(results: Results) -> str:
    """A row for each family of groups: with which rank correlation attention foretells the effect."""
    of = {(row["family"], row["queries"]): row for row in results["ranks"]}

    def cell(family: str, queries: str) -> str:
        row = of[family, queries]
        interval = "" if row["low"] is None else f" [{row['low']:.2f}, {row['high']:.2f}]"
        return f"{row['value']:.2f}{interval}"

    rows = (
        (what, f"{of[family, 'all']['items']:.0f}", cell(family, "action"), cell(family, "all"))
        for family, (what, _) in FAMILIES.items()
    )
    return markdown(("groups", "number", "hidden from the action tokens", "hidden from all tokens"), rows)


def success_table(results: Results) -> str:
    """Rollouts under each condition."""
    rows = (
        (TITLES[row["control"]], row["condition"], f"{row['solved']} of {row['episodes']}")
        for row in results["success"]
    )
    return markdown(("policy", "changed", "solved"), rows)


def fill_page(page: Path, results: Results) -> None:
    """Write the three tables of the study into the page; see `fill_marks`."""
    fill_marks(
        page,
        {"numbers": numbers_table(results), "ranks": ranks_table(results), "success": success_table(results)},
    )


def fill_marks(page: Path, blocks: Mapping[str, str]) -> None:
    """Replace what stands between the marks `<!-- NAME -->` and `<!-- end NAME -->`."""
    text = page.read_text(encoding="utf-8")
    for name, block in blocks.items():
        begin, end = f"<!-- {name} -->", f"<!-- end {name} -->"
        if begin not in text or end not in text:
            raise BadArgument(f"{page} has no marks '{begin}' and '{end}' to write the table between.")
        head, rest = text.split(begin, 1)
        text = f"{head}{begin}\n\n{block}\n\n{end}{rest.split(end, 1)[1]}"
    page.write_text(text, encoding="utf-8")
