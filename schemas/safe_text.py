"""Text that comes from stores and other files: refused as a name, safe as part of a path, visible when it is shown.

A store may come from anybody. Its names (suite, tasks, cameras, objects ...) become parts of paths, and all of its text
is printed. Control characters in it could change what a terminal shows, and characters that reverse the direction of
writing, what a reader takes it for.
"""

from __future__ import annotations

import functools
import re
import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from types import TracebackType
from typing import IO, Any
from urllib.parse import quote

from vla_attention.schemas.errors import BadArgument, shortened
from vla_attention.schemas.errors import visible as visible

#: Beside letters and digits, what stays as it is in `file_part`.
_PLAIN = re.compile(r"[\w ._+=,@-]")
_LINE_END = "\n"


def check_name(what: str, name: str) -> None:
    """Raise `BadArgument` unless a name is printable and one part of a path.

    `what` says whose name it is, for instance "suite".
    """
    check_text(what, name)
    if not name.strip() or name in (".", "..") or "/" in name or "\\" in name:
        raise BadArgument(f"'{name}' cannot be the name of a {what}: expected text without / and \\ that is no '..'.")


def check_text(what: str, text: str) -> None:
    """Raise `BadArgument` unless a text of one line that is in no path (a policy, an address) is printable."""
    if not text.isprintable():
        raise BadArgument(f"The {what} '{visible(shortened(text))}' has control characters: expected printable text.")


@functools.lru_cache(maxsize=4096)
def check_inner_path(path: str) -> None:
    """Raise `BadArgument` unless a path of a file or array stays inside the folder that it is relative to."""
    check_text("path", path)
    if any(part in ("", ".", "..") or "\\" in part for part in path.split("/")):
        raise BadArgument(f"'{path}' cannot be the path of a file or array: expected names joined by /, without '..'.")


def file_part(name: str) -> str:
    """A name as a part of a file's name. Names that differ stay different.

    Letters, digits, space and ``._-+=,@`` stay; every other character, and a dot at the beginning, becomes % and the
    codes of its UTF-8 bytes.
    """
    plain = "".join(c if _PLAIN.fullmatch(c) and c.isprintable() else quote(c, safe="", errors="replace") for c in name)
    return f"%2E{plain[1:]}" if plain.startswith(".") else plain


def print_line(text: str) -> None:
    """Print one line at once, also into a file that somebody follows; a line end in it is visible and ends no line."""
    print(visible(text), flush=True)


class _VisibleStream:
    """An output stream that writes text `visible`, line ends apart. Everything else is the wrapped stream's.

    What its encoding lacks is written as escapes; three dots in one sign, which latin-1 lacks, as three.
    """

    def __init__(self, stream: IO[str]) -> None:
        self._wrapped = stream  # under this name tqdm recognises the stream of its bar

    def write(self, text: str) -> int:
        shown, encoding = visible(text, keep=_LINE_END), getattr(self._wrapped, "encoding", None) or "utf-8"
        try:
            self._wrapped.write(shown)
        except UnicodeEncodeError:
            self._wrapped.write(shown.replace("\u2026", "...").encode(encoding, "backslashreplace").decode(encoding))
        return len(text)

    def writelines(self, lines: Any) -> None:
        for line in lines:
            self.write(line)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._wrapped, name)


@contextmanager
def visible_output() -> Iterator[None]:
    """What the block prints on stdout and stderr is `visible`, line ends apart, and so is the traceback of an error."""
    before = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = (_VisibleStream(stream) for stream in before)
    try:
        yield
    except Exception:
        # Printed by the interpreter when it ends; a name from a file may be part of the error's text.
        sys.excepthook = _print_visible_traceback
        raise
    finally:
        sys.stdout, sys.stderr = before


def _print_visible_traceback(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    lines = traceback.format_exception(kind, error, trace)
    sys.stderr.write(visible("".join(lines), keep=_LINE_END))


def plain_stderr() -> IO[str]:
    """stderr itself, also inside of `visible_output`: progress bars move the cursor."""
    stream: IO[str] = getattr(sys.stderr, "_wrapped", sys.stderr)
    return stream
