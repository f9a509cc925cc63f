"""Write the tables of benchmarks/rows/*.json into benchmarks/README.md, between the lines that name them.

Usage: python benchmarks/make_page.py [--check]

A table NAME.json/TABLE stands between `<!-- table NAME/TABLE -->` and `<!-- end of NAME/TABLE -->`. With --check,
nothing is written; exit code 1 says that the page differs from the rows.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent))

from measurement import ROOT, ROWS, read_rows

PAGE = ROOT / "benchmarks" / "README.md"
_BLOCK = re.compile(
    r"(<!-- table (?P<file>[\w-]+)/(?P<table>[\w-]+) -->\n)(?P<body>.*?)(<!-- end of (?P=file)/(?P=table) -->)",
    re.DOTALL,
)
_BEGIN = re.compile(r"<!-- table .*?-->")


class PageError(ValueError):
    """The page and the files of rows do not fit."""


def number(value: float) -> str:
    """Return three significant digits, and whole numbers from 1000 up with a comma: 0.0123, 1.05, 12.3, 1,234."""
    if isinstance(value, int) or abs(value) >= 999.5:
        return f"{round(value):,}"
    text = f"{value:.3g}"
    if "e" in text:
        return text
    digits = len(text.lstrip("-0.").replace(".", ""))  # 1.1 is shown as 1.10
    return text if digits >= 3 or value == 0 else text + ("" if "." in text else ".") + "0" * (3 - digits)


def cell(value: Any) -> str:
    """Return the text of a value; a measured one as its median with the lowest and highest in brackets."""
    if value is None:
        return "-"
    if isinstance(value, str):
        return value.replace("|", "\\|")
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, Mapping):
        median, lowest, highest = (number(value[key]) for key in ("median", "lowest", "highest"))
        return median if value["times"] == 1 else f"{median} ({lowest}, {highest})"
    return number(value)


def table_text(content: Mapping[str, Any]) -> str:
    """Return the Markdown of a table with the line that says how it was made."""
    columns = content["columns"]
    lines = ["| " + " | ".join(columns.values()) + " |", "|" + "---|" * len(columns)]
    lines += ["| " + " | ".join(cell(row.get(key)) for key in columns) + " |" for row in content["rows"]]
    facts = content["machine"]
    device = facts.get("gpu", facts["processor"])
    threads = facts["threads"].get("torch", facts["threads"].get("OMP_NUM_THREADS"))
    made = [device, f"{facts['cores']} cores", f"{facts['memory_gb']:g} GB"]
    made += [f"{threads} thread{'' if str(threads) == '1' else 's'}"] if threads is not None else []
    made += [
        f"{name} {content['versions'][name]}" for name in ("torch", "numpy", "zarr") if name in content["versions"]
    ]
    times = {value["times"] for row in content["rows"] for value in row.values() if isinstance(value, Mapping)} - {1}
    meaning = f" Medians of {' or '.join(map(str, sorted(times)))} rounds (lowest, highest)." if times else ""
    lines += ["", f"`{content['command']}`, {content['date']}: {', '.join(made)}; load {facts['load']}.{meaning}"]
    if content["note"]:
        lines += ["", content["note"]]
    return "\n".join(lines) + "\n"


def filled(page: str, folder: Path = ROWS) -> str:
    """Return the page with its tables.

    Raises `PageError` for a block without rows, for a beginning without its end, and for rows that no block shows.
    """
    tables = {
        f"{path.stem}/{name}": table
        for path in sorted(folder.glob("*.json"))
        for name, table in read_rows(path).items()
    }
    shown: list[str] = []

    def replace(match: re.Match[str]) -> str:
        name = f"{match['file']}/{match['table']}"
        if name not in tables:
            raise PageError(f"The page names the table {name}; the files of rows hold {', '.join(tables) or 'none'}.")
        shown.append(name)
        return f"{match[1]}\n{table_text(tables[name])}\n{match[5]}"

    text = _BLOCK.sub(replace, page)
    if len(_BEGIN.findall(page)) != len(shown):
        raise PageError(f"A line `<!-- table NAME/TABLE -->` has no end; whole blocks: {', '.join(shown) or 'none'}.")
    missing = [name for name in tables if name not in shown]
    if missing:
        raise PageError(
            f"No block of the page shows {', '.join(missing)}; add `<!-- table {missing[0]} -->` and its end."
        )
    return text


def main() -> int:
    """Fill the page, or say whether it is as the rows are."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--check", action="store_true", help="write nothing; exit code 1 if the page differs")
    arguments = parser.parse_args()
    page = PAGE.read_text(encoding="utf-8")
    try:
        text = filled(page)
    except PageError as error:
        print(error, file=sys.stderr)
        return 2
    if arguments.check:
        return int(text != page)
    PAGE.write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
