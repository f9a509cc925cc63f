"""What a request may name: the page's own files, its documents, and the files of a store. No I/O here."""

from __future__ import annotations

import hmac
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from urllib.parse import parse_qs, unquote_to_bytes

from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.safe_text import check_inner_path
from vla_attention.schemas.stores.store_format import EPISODES_GROUP

#: The files of the page; the others in its folder say how it was built.
PAGE_FILES = {
    "index.html": "text/html; charset=utf-8",
    "viewer.js": "text/javascript; charset=utf-8",
    "viewer.css": "text/css; charset=utf-8",
    "licenses.txt": "text/plain; charset=utf-8",
}
STORES_DOCUMENT = "stores.json"
#: What of a store is served. Whatever else lies in its folder stays there.
_STORE_FILES = ("zarr.json", EPISODES_GROUP)
_LOOPBACK = frozenset({"127.0.0.1", "localhost", "[::1]"})
_HOST = re.compile(r"([0-9a-z_](?:[0-9a-z_.-]{0,252})|\[[0-9a-f:.]{2,45}\])(?::[0-9]{1,5})?")
_SUMMARY = re.compile(r"([0-9]{1,4})\.summary\.json")


class NothingThere(LookupError):
    """A path that names nothing that is served."""


class WrongToken(PermissionError):
    """A path that does not begin with the secret part of the link."""


@dataclass(frozen=True)
class Wanted:
    """What a request names.

    Attributes:
        page: a file of the page.
        document: `stores.json`.
        summary: the number of the store whose summary is asked for.
        store: the number of the store whose file is asked for.
        file: the path of that file in its store.
        answer: the parts of an answer's address, see `answers`; query: what is asked there.
    """

    page: str = ""
    document: bool = False
    summary: int | None = None
    store: int | None = None
    file: str = ""
    answer: tuple[str, ...] = ()
    query: Mapping[str, Sequence[str]] = field(default_factory=dict)


def name_of_host(host: str) -> str | None:
    """The name of a host, in lower case, without the port that may follow it; None for what is none."""
    match = _HOST.fullmatch(host.lower())
    return match and match[1]


def is_allowed(host: str, allowed: Collection[str] = ()) -> bool:
    """Whether the host that a request names is this machine's loopback, or one of the allowed (`name_of_host`).

    A site elsewhere can let its own name mean 127.0.0.1 (DNS rebinding); the browser then sends that name.
    """
    name = name_of_host(host)
    return name is not None and (name in _LOOPBACK or name in allowed)


def wanted(target: str, token: str, num_stores: int) -> Wanted:
    """What the target of a request (`/TOKEN/PATH`) names; a proxy may have a path of its own before the token.

    Every part of the path is decoded once, and by itself: a slash, a backslash or a control character that appears then
    is refused, as is `..`.

    Raises:
        WrongToken: it does not have the token.
        NothingThere: nothing of that name is served.
    """
    path, _, asked = target.partition("?")
    first, *parts = path.split("/")
    if first:
        raise WrongToken
    while parts and parts[0] and not hmac.compare_digest(parts[0].encode("utf-8", "replace"), token.encode()):
        del parts[0]
    if not parts or not parts.pop(0):
        raise WrongToken
    if not parts:  # the link without its last slash; relative addresses of the page would miss the token
        raise NothingThere
    if parts == [""]:
        return Wanted(page="index.html")
    names = [_decoded(part) for part in parts]
    if len(names) == 1 and names[0] in PAGE_FILES:
        return Wanted(page=names[0])
    if names == [STORES_DOCUMENT]:
        return Wanted(document=True)
    if names[0] in ("runs", "runs.json"):
        return Wanted(answer=tuple(names), query=parse_qs(asked, keep_blank_values=True))
    if names[0] != "stores" or len(names) < 2:
        raise NothingThere
    summary = _SUMMARY.fullmatch(names[1])
    if len(names) == 2 and summary is not None and int(summary[1]) < num_stores:
        return Wanted(summary=int(summary[1]))
    if len(names) == 2 or names[2] not in _STORE_FILES or names[1] not in map(str, range(num_stores)):
        raise NothingThere
    return Wanted(store=int(names[1]), file="/".join(names[2:]))


def _decoded(part: str) -> str:
    try:
        name = unquote_to_bytes(part).decode("utf-8")
        check_inner_path(name)
    except (UnicodeDecodeError, BadArgument):
        raise NothingThere from None
    if "/" in name:
        raise NothingThere
    return name


_RANGE = re.compile(r"bytes=([0-9]{0,19})-([0-9]{0,19})")


class BadRange(ValueError):
    """A range that no byte of the file is in."""


def byte_range(header: str | None, size: int) -> tuple[int, int] | None:
    """The bytes [first, end) of a file of `size` bytes that a `Range` header asks for.

    None is the whole file: without the header, with several ranges, or with one that is not understood; RFC 9110 has it
    so.

    Raises:
        BadRange: no byte of the file is in it.
    """
    match = _RANGE.fullmatch(header.strip()) if header is not None else None
    if match is None or match[0] == "bytes=-":
        return None
    if not match[1]:
        first, end = max(0, size - int(match[2])), size
    else:
        first, end = int(match[1]), min(size, int(match[2]) + 1) if match[2] else size
        if match[2] and int(match[2]) < first:
            return None
    if first >= end:
        raise BadRange
    return first, end
