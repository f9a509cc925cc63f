"""Asking places elsewhere through fsspec without believing them: never more bytes or more time than are expected."""

from __future__ import annotations

import asyncio
import re
import threading
import time
from typing import Any
from urllib.parse import unquote, urljoin

from vla_attention.schemas.limits import LISTED_NAMES, LISTING_BYTES, SLOWEST_BYTES_A_SECOND

#: Where a link of a web page leads to. No part of the expression can match in two ways, so that the time is linear.
_LINK = re.compile(rb"""href=["']([^"'<>\s]{1,2000})["']""", re.IGNORECASE)


class TooMuch(OSError):
    """A list of a folder that goes on and on."""


class TooSlow(Exception):
    """An answer that does not end. `received` bytes of it came within `seconds`.

    It is no `TimeoutError`, which fsspec turns into one of its own.
    """

    def __init__(self, received: int, seconds: float) -> None:
        super().__init__(received, seconds)
        self.received = received
        self.seconds = seconds


def fetched(files: Any, path: str, start: int | None, end: int | None, most: int, within_s: float) -> bytes:
    """Bytes [start, end) of a file, all of it without the two; one byte more than `most` where there are more.

    Args:
        files: file system of fsspec.
        path: of the file there.
        start, end: the wanted part.
        most: bytes that are read at most.
        within_s: seconds that an answer may take before it has to have `SLOWEST_BYTES_A_SECOND`.

    Raises:
        TooSlow: the answer takes longer.
        Exception: whatever the file system raises.
    """
    if _is_web(files):
        return _over_http(files, path, start, end, most, within_s)
    if start is None:
        start, end = 0, most + 1  # a file of any size would be read into memory
    content: bytes = asked_within(
        files, "cat_file", path, start=start, end=end, seconds=within_s + most / SLOWEST_BYTES_A_SECOND
    )
    return content


def names_in(files: Any, path: str, within_s: float) -> list[str]:
    """The names in a folder, in any order.

    Raises:
        TooMuch: there are more, or longer ones, than of any store.
        TooSlow: the answer takes longer than `within_s` and its size allow.
        Exception: whatever the file system raises.
    """
    if _is_web(files):
        return _linked_names(files, path, within_s)
    paths = asked_within(files, "ls", path, detail=False, seconds=within_s)
    return [str(name).rstrip("/").rpartition("/")[2] for name in _not_too_many(paths)]


def asked_within(files: Any, method: str, *given: Any, seconds: float, **named: Any) -> Any:
    """What a method of a file system gives; `TooSlow` when it has given nothing after so many seconds."""
    if getattr(files, "async_impl", False):
        from fsspec.asyn import sync

        begun = time.monotonic()
        try:
            # Ends the request, too, which goes on in a thread otherwise.
            return sync(files.loop, getattr(files, f"_{method}"), *given, timeout=seconds, **named)
        except TimeoutError:
            raise TooSlow(0, time.monotonic() - begun) from None
    return _in_thread(lambda: getattr(files, method)(*given, **named), seconds)


def _in_thread(ask: Any, seconds: float) -> Any:
    """The answer of a client that waits by itself."""
    answer: list[Any] = []
    failed: list[BaseException] = []

    def run() -> None:
        try:
            answer.append(ask())
        except BaseException as error:
            failed.append(error)

    thread = threading.Thread(target=run, name="asks elsewhere", daemon=True)
    thread.start()
    thread.join(seconds)
    if failed:
        raise failed[0]
    if not answer:
        raise TooSlow(0, seconds)
    return answer[0]


def _is_web(files: Any) -> bool:
    return isinstance(getattr(files, "protocol", None), tuple) and "http" in files.protocol


def _not_too_many(names: Any) -> Any:
    if len(names) > LISTED_NAMES:
        raise TooMuch(f"its list has more than {LISTED_NAMES:,} names")
    return names


def _linked_names(files: Any, url: str, within_s: float) -> list[str]:
    """Names below a folder's address to which its page links, as web servers list folders; fsspec reads any page."""
    page = _over_http(files, url, None, None, LISTING_BYTES, within_s)
    if len(page) > LISTING_BYTES:
        raise TooMuch(f"its list has more than {LISTING_BYTES:,} bytes")
    base = f"{url.rstrip('/')}/"
    names = dict[str, None]()
    for link in _LINK.findall(page):
        try:
            address = urljoin(base, link.decode("utf-8", "replace"))
        except ValueError:  # no address at all
            continue
        if address.startswith(base):
            path = re.split("[?#]", address.removeprefix(base), maxsplit=1)[0]
            names[unquote(path.partition("/")[0])] = None
    return [name for name in names if name]


def _over_http(files: Any, url: str, start: int | None, end: int | None, most: int, within_s: float) -> bytes:
    """One request, whose answer is read up to `most` bytes; fsspec reads all that the server sends."""
    from fsspec.asyn import sync

    content: bytes = sync(files.loop, _answer, files, url, start, end, most, within_s)
    return content


async def _answer(files: Any, url: str, start: int | None, end: int | None, most: int, within_s: float) -> bytes:
    options = dict(files.kwargs)
    if start is not None and end is not None:
        # Compressed answers to a range are ranges of compressed files.
        ours = {"Range": f"bytes={start}-{end - 1}", "Accept-Encoding": "identity"}
        options["headers"] = {**options.get("headers", {}), **ours}
    session = await files.set_session()
    begun, size, parts = asyncio.get_running_loop().time(), 0, []
    try:
        async with (
            asyncio.timeout_at(begun + within_s) as limit,
            session.get(files.encode_url(url), **options) as answer,
        ):
            files._raise_not_found_for_status(answer, url)
            while size <= most:
                part = await answer.content.read(most + 1 - size)
                if not part:
                    break
                parts.append(part)
                size += len(part)
                limit.reschedule(begun + within_s + size / SLOWEST_BYTES_A_SECOND)
    except TimeoutError:
        if limit.expired():
            raise TooSlow(size, asyncio.get_running_loop().time() - begun) from None
        raise
    return b"".join(parts)
