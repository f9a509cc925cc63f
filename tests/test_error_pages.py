"""Every sentence that docs/commands.md quotes is printed somewhere: its fixed parts are in one text of the sources."""

from __future__ import annotations

import ast
import re
from functools import lru_cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "commands.md"
#: What a value in a text of the sources becomes; no text has it.
VALUE = "\x00"
#: Quotes of fewer fixed characters would be found by chance.
FEWEST_CHARACTERS = 20


def text_of(node: ast.expr) -> str:
    """A text of the sources, with VALUE in the place of what is filled in."""
    if isinstance(node, ast.Constant):
        return node.value if isinstance(node.value, str) else VALUE
    if isinstance(node, ast.JoinedStr):
        return "".join(map(text_of, node.values))
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        return text_of(node.left) + text_of(node.right)
    return VALUE


@lru_cache(maxsize=1)
def sources() -> str:
    """All texts of the program, a line each."""
    texts = [
        text_of(node).replace("\n", " ")
        for folder in ("schemas", "capture", "analyze")
        for path in sorted((ROOT / folder).rglob("*.py"))
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Constant | ast.JoinedStr | ast.BinOp)
    ]
    texts += [
        line for path in (ROOT / "scripts").glob("*.sh") for line in path.read_text(encoding="utf-8").splitlines()
    ]
    return "\n".join(texts)


def is_printed(quote: str) -> bool:
    """Whether a text of the sources has the quote's fixed parts in their order; … is any value or text."""
    parts = [re.escape(part) for part in quote.strip("… ").split("…")]
    return re.search("[^\n]*?".join(parts), sources()) is not None


def quotes() -> list[str]:
    """The first cells of the tables of sentences."""
    tables = re.findall(r"^\| sentence \|.*\n\|[-|]+\n((?:\|.*\n)+)", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    rows = [row for table in tables for row in table.splitlines()]
    return [re.split(r" (?<!\\)\| ", row.removeprefix("| "))[0].replace("\\|", "|") for row in rows]


def test_every_quoted_sentence_is_in_the_sources():
    found = quotes()
    assert len(found) >= 30
    assert [quote for quote in found if len(quote.replace("…", "").strip()) < FEWEST_CHARACTERS] == []
    assert [quote for quote in found if not is_printed(quote)] == []
