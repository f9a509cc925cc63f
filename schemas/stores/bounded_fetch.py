"""Fetching files and parts of them through fsspec without believing the server: never more bytes than are expected."""

from __future__ import annotations

from typing import Any


def fetched(files: Any, path: str, start: int | None, end: int | None, most: int) -> bytes:
    """Bytes [start, end) of a file, all of it without the two; one byte more than `most` where there are more.

    Args:
        files: file system of fsspec.
        path: of the file there.
        start, end: the wanted part.
        most: bytes that are read at most.

    Raises:
        Exception: whatever the file system raises.
    """
    if isinstance(getattr(files, "protocol", None), tuple) and "http" in files.protocol:
        return _over_http(files, path, start, end, most)
    if start is None:
        start, end = 0, most + 1  # a file of any size would be read into memory
    content: bytes = files.cat_file(path, start=start, end=end)
    return content


def _over_http(files: Any, url: str, start: int | None, end: int | None, most: int) -> bytes:
    """One request, whose answer is read up to `most` bytes; fsspec reads all that the server sends."""
    from fsspec.asyn import sync

    found: bytes = sync(files.loop, _answer, files, url, start, end, most)
    return found


async def _answer(files: Any, url: str, start: int | None, end: int | None, most: int) -> bytes:
    options = dict(files.kwargs)
    if start is not None and end is not None:
        # Compressed answers to a range are ranges of compressed files.
        ours = {"Range": f"bytes={start}-{end - 1}", "Accept-Encoding": "identity"}
        options["headers"] = {**options.get("headers", {}), **ours}
    session = await files.set_session()
    async with session.get(files.encode_url(url), **options) as answer:
        files._raise_not_found_for_status(answer, url)
        parts, size = [], 0
        while size <= most:
            part = await answer.content.read(most + 1 - size)
            if not part:
                break
            parts.append(part)
            size += len(part)
    return b"".join(parts)
