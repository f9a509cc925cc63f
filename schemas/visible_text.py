"""Control characters as escapes; `safe_text` has what else is done with text from files."""

from __future__ import annotations


def visible(text: str, keep: str = "") -> str:
    r"""Text with its unprintable characters as escapes, for instance \x1b, \n or \u202e.

    Unprintable are control and format characters, line and paragraph separators, spaces other than the plain one, and
    code points without a character (`str.isprintable`). Characters in `keep` stay as they are.
    """
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or c in keep else c.encode("unicode_escape").decode("ascii") for c in text)
