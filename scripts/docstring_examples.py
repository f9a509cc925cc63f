"""A griffe extension for the documentation site: the examples of docstrings (`>>> ...`) become blocks of code."""

from __future__ import annotations

import re
from typing import Any

from griffe import Extension, Object

#: An example: from its first line to the next empty one.
_EXAMPLE = re.compile(r"^>>> .*(?:\n(?!\s*$).*)*", re.MULTILINE)


class Examples(Extension):
    """Puts the examples of every docstring between fences: Markdown would take `>>>` for a quotation."""

    def on_object(self, *, obj: Object, **_: Any) -> None:
        """Change the docstring of an object that was read."""
        if obj.docstring:
            obj.docstring.value = fenced(obj.docstring.value)


def fenced(docstring: str) -> str:
    """Return a docstring with its examples between fences, neighbours in one block."""
    return _EXAMPLE.sub(lambda match: f"```pycon\n{match[0]}\n```", docstring)
