"""What a request may name: the page's own files, and answers. No I/O here."""

from __future__ import annotations

import hmac
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from urllib.parse import parse_qs, unquote_to_bytes

from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.safe_text import check_inner_path

#: The files of the page; the others in its folder say how it was built.
PAGE_FILES = {
    "index.html": "text/html; charset=utf-8",
    "main.js": "text/javascript; charset=utf-8",
    "main.css": "text/css; charset=utf-8",
    "licenses.txt": "text/plain; charset=utf-8",
}
#: What the page asks for first.
RUNS = "runs.json"
_LOOPBACK = frozenset({"127.0.0.1", "localhost", "[::1]"})
_HOST = re.compile(r"([0-9a-z_](?:[0-9a-z_.-]{0,252})|\[[0-9a-f:.]{2,45}\])(?::[0-9]{1,5})?")


class NothingThere(LookupError):
    """A path that names nothing that is served."""


class WrongToken(PermissionError):
    """A path that does not begin with the secret part of the link."""


@dataclass(frozen=True)
class Wanted:
    """What a request names.

    Attributes:
        page: a file of the page.
        answer: the parts of an answer's address, see `answers`; query: what is asked there.
    """

    page: str = ""
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


def wanted(target: str, token: str) -> Wanted:
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
    if names[0] not in ("runs", RUNS):
        raise NothingThere
    return Wanted(answer=tuple(names), query=parse_qs(asked, keep_blank_values=True))


def _decoded(part: str) -> str:
    try:
        name = unquote_to_bytes(part).decode("utf-8")
        check_inner_path(name)
    except (UnicodeDecodeError, BadArgument):
        raise NothingThere from None
    if "/" in name:
        raise NothingThere
    return name
