"""What a request may name: the page's own files, and answers, see `answers`. No I/O here."""

from __future__ import annotations

import hmac
import re
from collections.abc import Mapping, Sequence
from importlib.resources import files
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
BUNDLE = files("vla_attention.analyze.view") / "bundle"
#: What the page asks for first.
RUNS = "runs.json"
#: A site elsewhere can let its own name mean 127.0.0.1 (DNS rebinding); the browser then sends that name.
LOOPBACK_NAMES = frozenset({"127.0.0.1", "localhost", "[::1]"})
_HOST = re.compile(r"([0-9a-z_](?:[0-9a-z_.-]{0,252})|\[[0-9a-f:.]{2,45}\])(?::[0-9]{1,5})?")


class NothingThere(LookupError):
    """An address that names nothing that is served."""


class WrongToken(PermissionError):
    """A path that does not begin with the secret part of the link."""


def name_of_host(host: str) -> str | None:
    """The name of a host, in lower case, without the port that may follow it; None for what is none."""
    match = _HOST.fullmatch(host.lower())
    return match and match[1]


def wanted(target: str, token: str) -> tuple[list[str], Mapping[str, Sequence[str]]]:
    """The parts of an address, and what is asked there, of a request's target (`/TOKEN/PATH?QUERY`).

    A proxy may have a path of its own before the token.

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
    names = ["index.html"] if parts == [""] else [_decoded(part) for part in parts]
    if names[0] not in ("runs", RUNS) and (len(names) > 1 or names[0] not in PAGE_FILES):
        raise NothingThere
    return names, parse_qs(asked, keep_blank_values=True)


def _decoded(part: str) -> str:
    try:
        name = unquote_to_bytes(part).decode("utf-8")
        check_inner_path(name)
    except (UnicodeDecodeError, BadArgument):
        raise NothingThere from None
    if "/" in name:
        raise NothingThere
    return name
