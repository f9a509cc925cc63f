"""Reading JSON and TOML that somebody else may have written: size, nesting and numbers are bounded.

Every problem is a `ValueError` with a sentence: not a traceback of Python's recursion, of its limit of digits, or of
memory. `jsonable.py` makes documents of what comes out.
"""

from __future__ import annotations

import json
import re
import tomllib
from contextlib import suppress
from typing import Any

import msgspec

from vla_attention.schemas.limits import DOCUMENT_BYTES, DOCUMENT_NESTS, NESTING, WHOLE_NUMBER

_TOO_DEEP = f"its lists, objects and tables are nested more than {NESTING} deep"
_OTHER_BYTES = bytes(set(range(256)) - set(b"[]{}"))
#: Strings of JSON, in which brackets mean nothing. The quantifier gives nothing back, so that the time is linear.
_STRING = re.compile(rb'"(?:[^"\\]|\\.)*+"', re.DOTALL)
#: Digits as 0, what may stand before a number as a space, anything else as x.
_SHAPE = bytes((b"0" if b in b"0123456789" else b" " if b in b" \t\n\r:,[-" else b"x")[0] for b in range(256))
#: A number of 19 digits or more in that form, or text that looks like one.
_LONG = re.compile(b" " + b"0" * 19 + b"0*")
#: An escaped part of a surrogate pair; half a pair can be neither printed nor written to a file.
_SURROGATE = re.compile(rb"\\u[dD][89a-fA-F]")
#: Strings and comments of TOML, likewise.
_TOML_TEXT = re.compile(r'"""(?:[^\\]|\\.)*?"""|\'\'\'.*?\'\'\'|"(?:[^"\\\n]|\\.)*+"|\'[^\'\n]*+\'|#[^\n]*+', re.DOTALL)


def decode_json(content: bytes, most: int = DOCUMENT_BYTES, nests: int = DOCUMENT_NESTS) -> Any:
    """The value of a JSON document; `NaN` and `Infinity` are numbers, as Python's json reads them.

    Args:
        content: the document, in UTF-8.
        most: bytes that it may have.
        nests: lists and objects that it may have.

    Raises:
        ValueError: it is no JSON, or larger, nested deeper or with longer numbers than any that we read.
    """
    if len(content) > most:
        raise ValueError(f"it has {len(content):,} bytes; expected at most {most:,}")
    _check_brackets(content, nests)
    may_be_long = _may_be_long(content)
    if not may_be_long:
        with suppress(msgspec.DecodeError, UnicodeDecodeError):
            return msgspec.json.decode(content)
    # Numbers that JSON does not have, or a document that is none: Python's own, which is slower, says where.
    try:
        document = json.loads(content.decode("utf-8-sig"), parse_int=_bounded if may_be_long else None)
        if _SURROGATE.search(content):
            json.dumps(document, ensure_ascii=False).encode()
        return document
    except RecursionError:
        raise ValueError(_TOO_DEEP) from None
    except UnicodeEncodeError:
        raise ValueError("it has half a surrogate pair, which is no character") from None
    except UnicodeDecodeError as error:
        raise ValueError(f"it is no text in UTF-8: {error.reason} at byte {error.start}") from None


def _may_be_long(content: bytes) -> bool:
    """Whether a whole number, or digits in a text, do not fit into 64 bits. To ask each number takes twice as long."""
    found = _LONG.finditer(b" " + content.translate(_SHAPE))
    return any(int(content[one.start() : one.end() - 1][:20]) >= WHOLE_NUMBER for one in found)


def _bounded(digits: str) -> int:
    if len(digits) > 20 or not -WHOLE_NUMBER <= int(digits) < WHOLE_NUMBER:
        raise ValueError("it has a whole number that does not fit into 64 bits")
    return int(digits)


def _check_brackets(content: bytes, nests: int) -> None:
    """Raise `ValueError` for more lists and objects, or for more of them in one another, than we read."""
    brackets = content.translate(None, _OTHER_BYTES)
    if len(brackets) > 2 * nests:
        raise ValueError(f"it has more than {nests:,} lists and objects")
    if _is_flat(brackets):
        return
    # Texts may hold brackets that are never closed.
    if not _is_flat(_STRING.sub(b"", content).translate(None, _OTHER_BYTES)):
        raise ValueError(_TOO_DEEP)


def _is_flat(brackets: bytes) -> bool:
    """Whether brackets, with nothing between them, are at most `NESTING` deep; false where they do not match."""
    for _ in range(NESTING):
        if not brackets:
            return True
        shorter = brackets.replace(b"[]", b"").replace(b"{}", b"")
        if len(shorter) == len(brackets):
            return len(brackets) <= NESTING  # unbalanced: the parser says where
        brackets = shorter
    return not brackets


def decode_toml(text: str) -> dict[str, Any]:
    """The table of a TOML document.

    Raises:
        ValueError: it is no TOML, or nested deeper or with longer numbers than any that we read. tomllib takes time in
            the square of the parts of a dotted key.
    """
    # Texts without their content: no bracket, dot or line end in them counts.
    bare = _TOML_TEXT.sub("_", text)
    dots = max((line.partition("=")[0].count(".") for line in bare.split("\n")), default=0)
    inline = max((line.count(".") for line in bare.split("\n") if "{" in line), default=0)
    if dots > NESTING or inline > 10 * NESTING or not _is_flat(re.sub(r"[^][{}]", "", bare).encode()):
        raise ValueError(_TOO_DEEP)
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        raise
    except RecursionError:
        raise ValueError(_TOO_DEEP) from None
    except (ValueError, OverflowError) as error:
        reason = "it has a whole number of more than 4,000 digits" if "digits" in str(error) else str(error)
        raise ValueError(reason) from None
