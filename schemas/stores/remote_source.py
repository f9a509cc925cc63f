"""Files that are elsewhere, through fsspec (the extra `remote`).

Only the bytes that are asked for are fetched, and nothing is kept: `vla-attention store copy` brings a store here. An
answer to a part of a file that is longer than the part is an error; `sealed_files.py` notices one that is shorter or
another.
`hf://datasets/ORG/NAME/PATH` is read by the addresses under which the hub serves files, so that a part of a file is one
request; fsspec's own file system of the hub asks for a description of the file each time.
"""

from __future__ import annotations

import os
import re
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from vla_attention.schemas.errors import BadArgument, UserError
from vla_attention.schemas.foreign_files import MAX_DOCUMENT_BYTES
from vla_attention.schemas.install_line import install_line
from vla_attention.schemas.stores.byte_source import ByteSource, Folder, Memory
from vla_attention.schemas.stores.store_url import HUB_PROTOCOL, HubAddress, StorePlace, StoreUrl, stated_commit

#: Protocols whose addresses may be `//name:password@host`; elsewhere @ stands before a revision.
_WITH_PASSWORDS = ("http", "https", "ftp", "sftp", "ssh", "smb", "webdav")

#: Seconds without a connection, or without a further byte, after which a server counts as silent. aiohttp's own limit
#: is five minutes for a whole answer: too long for a server that hangs, and too short for a large file.
ANSWER_WITHIN_S = 60.0
#: Bytes a second that an answer must have beyond that time, and bytes that are taken at once.
_SLOWEST, _READ_BYTES = 10_000, 1 << 18
#: Compressed answers to a range are ranges of compressed files.
_AS_IT_IS = {"Accept-Encoding": "identity"}


class RemoteFailure(UserError, OSError):
    """A place elsewhere that cannot be read: the network, a server's refusal, or a missing package."""


def is_web(place: StoreUrl) -> bool:
    """Whether a plain web server has it, which need not list its folders."""
    return place.protocol in ("http", "https")


def source_of(place: StorePlace) -> ByteSource:
    """The files below a path or an address.

    Raises:
        BadArgument: an address with a query or a fragment, which is one file's and not a folder's; or with a password.
    """
    if not isinstance(place, StoreUrl):
        return Folder(place)
    who, at, host = place.url.partition("://")[2].partition("/")[0].rpartition("@")
    if at and ":" in who and place.protocol in _WITH_PASSWORDS:
        raise BadArgument(
            f"The address of {host} was given with a password, which summaries and results would show. Give it "
            "without; fsspec reads passwords from its own configuration (~/.config/fsspec)."
        )
    without = re.split("[?#]", place.url, maxsplit=1)[0]
    if without != place.url and is_web(place):
        raise BadArgument(
            f"The address {without} was given with a query (a signed link), which is for one file; a store is a folder "
            "of files. Give an address that is read without one, or copy the store here."
        )
    return RemoteFolder(place.url)


def at_commit(place: StorePlace) -> StorePlace:
    """The same place, at the commit that its branch or tag on the hub is now; other places are as they are.

    A branch may be moved between two requests, so that a store would be read half at one commit and half at another.

    Raises:
        RemoteFailure: the hub has no such repository or revision, shows it to others only, or cannot be asked.
    """
    if not isinstance(place, StoreUrl) or not place.url.startswith(HUB_PROTOCOL):
        return place
    address = HubAddress.of(place.url)
    if address.is_commit:
        return place
    asked = address.revision_address(_hub()[0])
    try:
        files = _file_system(place.url)[0]
        answer = _asked(place.url, lambda: _of_web_server(files, asked, None, MAX_DOCUMENT_BYTES))
    except FileNotFoundError:
        raise RemoteFailure(
            f"{place.url} cannot be read: the hub knows no revision {address.revision} of {address.repository}. "
            "Private repositories need HF_TOKEN or `hf auth login`."
        ) from None
    commit = stated_commit(answer)
    if commit is None:
        raise RemoteFailure(
            f"{place.url} cannot be read: the hub did not say which commit {address.revision} is. Give the commit "
            "after the repository's name: hf://datasets/ORG/NAME@COMMIT/PATH."
        )
    return StoreUrl(str(address.at(commit)))


@dataclass(frozen=True)
class RemoteFolder:
    """A folder at an address that fsspec can read.

    Attributes:
        url: the address.
    """

    url: str

    def whole(self, file: str, most: int = MAX_DOCUMENT_BYTES) -> bytes:
        """See `ByteSource`."""
        content = self._bytes(file, None, most)
        if len(content) > most:
            raise RemoteFailure(f"{self.url} cannot be read: its {file} has more than {most:,} bytes.")
        return content

    def part(self, file: str, offset: int, length: int) -> bytes:
        """See `ByteSource`; one request."""
        content = self._bytes(file, offset, length)
        if len(content) > length:
            raise RemoteFailure(
                f"The server of {self.url} sends whole files where a part was asked for (no range requests), so that "
                "every number would cost a whole episode; copy the store here, or use a server that has them."
            )
        return content

    def read_into(self, memory: Memory, file: str, offset: int) -> int:
        """See `ByteSource`; one request."""
        content = self.part(file, offset, len(memory))
        memory[: len(content)] = np.frombuffer(content, np.uint8)
        return len(content)

    def size(self, file: str) -> int:
        """See `ByteSource`."""
        return int(_asked(self.url, "size", self._path(file)) or 0)

    def names(self, folder: str) -> list[str]:
        """The names in a folder; web servers list none."""
        files, path = _hub_listing(self.url) if self.url.startswith(HUB_PROTOCOL) else _file_system(self.url)
        names = _asked(self.url, "ls", f"{path}/{folder}", files=files, detail=False)
        return sorted(str(name).rstrip("/").rpartition("/")[2] for name in names)

    def _bytes(self, file: str, first: int | None, most: int) -> bytes:
        """So many bytes of a file from one on; None: all of it. A web server's longer answer has one byte more."""
        files, path = _file_system(self.url)
        address = f"{path}/{file}"
        if hasattr(files, "set_session"):
            content: bytes = _asked(self.url, lambda: _of_web_server(files, address, first, most))
        else:
            part = {} if first is None else {"start": first, "end": first + most}
            content = _asked(self.url, "cat_file", address, **part)
        return content

    def shown(self, folder: str) -> str:
        """The page on which a web server shows a folder; `OSError` where it shows none."""
        files, path = _file_system(self.url)
        page: bytes = _asked(self.url, lambda: _of_web_server(files, f"{path}/{folder}/", None, MAX_DOCUMENT_BYTES))
        return page.decode(errors="replace")

    def _path(self, file: str) -> str:
        return f"{_file_system(self.url)[1]}/{file}"


def _file_system(url: str) -> tuple[Any, str]:
    """fsspec's file system of an address, and the path in it.

    A forked process makes its own, and so does one whose hub or token is another one now.
    """
    return _file_system_of(url, os.getpid(), os.environ.get("HF_ENDPOINT"), os.environ.get("HF_TOKEN"))


@cache
def _file_system_of(url: str, _process: int, *_hub_variables: str | None) -> tuple[Any, str]:
    try:
        import fsspec
        from fsspec.core import url_to_fs
    except ImportError as error:
        raise _missing(url, error) from None
    try:
        if url.startswith(HUB_PROTOCOL):
            endpoint, headers = _hub()
            options = {"headers": {**headers, **_AS_IT_IS}, "timeout": _time_limits()}
            return fsspec.filesystem("https", client_kwargs=options), HubAddress.of(url).file_address(endpoint)
        options = {"client_kwargs": {"headers": _AS_IT_IS, "timeout": _time_limits()}}
        files, path = url_to_fs(url, **(options if is_web(StoreUrl(url)) else {}))
    except ImportError as error:
        raise _missing(url, error) from None
    except ValueError as error:
        raise BadArgument(f"The address {url} cannot be read: {error}.") from None
    return files, path.rstrip("/")


def _time_limits() -> Any:
    import aiohttp

    return aiohttp.ClientTimeout(total=None, sock_connect=ANSWER_WITHIN_S, sock_read=ANSWER_WITHIN_S)


def _hub() -> tuple[str, dict[str, str]]:
    """The hub's address, and the headers that say who asks."""
    token = os.environ.get("HF_TOKEN", "")
    if not token:
        with suppress(ImportError):
            from huggingface_hub import get_token

            token = get_token() or ""
    endpoint = os.environ.get("HF_ENDPOINT", "https://huggingface.co").rstrip("/")
    return endpoint, {"authorization": f"Bearer {token}"} if token else {}


def _hub_listing(url: str) -> tuple[Any, str]:
    try:
        from huggingface_hub import HfFileSystem
    except ImportError as error:
        raise _missing(url, error) from None
    # The client keeps the hub's address from when it was imported, and its file systems keep what they have listed.
    token = os.environ.get("HF_TOKEN") or None
    return HfFileSystem(endpoint=_hub()[0], token=token, skip_instance_cache=True), url.removeprefix(HUB_PROTOCOL)


def _missing(url: str, error: ImportError) -> RemoteFailure:
    return RemoteFailure(
        f"Reading {url} needs a package that is not installed ({error.name or error}); "
        f"{install_line('remote')}, or copy the store here."
    )


def _of_web_server(files: Any, address: str, first: int | None, most: int) -> bytes:
    """What a server sends for a file or a part of it, as it is stored; of a longer answer one byte more than `most`."""
    from fsspec.asyn import sync

    async def fetched() -> bytes:
        given = dict(files.kwargs)
        if first is not None:
            given["headers"] = {**given.get("headers", {}), "Range": f"bytes={first}-{first + most - 1}"}
        content, began = bytearray(), time.monotonic()
        async with (await files.set_session()).get(files.encode_url(address), **given) as answer:
            files._raise_not_found_for_status(answer, address)
            if answer.headers.get("Content-Encoding", "identity") != "identity":
                raise OSError("its server compresses files, which was not asked for")
            while len(content) <= most and (part := await answer.content.read(_READ_BYTES)):
                content += part[: most + 1 - len(content)]
                if time.monotonic() - began > ANSWER_WITHIN_S + len(content) / _SLOWEST:
                    raise OSError(f"its server sent {len(content):,} bytes in {time.monotonic() - began:.0f} s")
        return bytes(content)

    found: bytes = sync(files.loop, fetched) if most or first is None else b""
    return found


def _asked(url: str, method: str | Callable[[], Any], *given: Any, files: Any = None, **named: Any) -> Any:
    """What a method of a file system, or a function, answers; what it raises becomes an `OSError` with the address.

    files: the file system, if it is not that of the address.
    """
    try:
        return method() if callable(method) else getattr(files or _file_system(url)[0], method)(*given, **named)
    except (FileNotFoundError, NotImplementedError, UserError):
        raise
    except TimeoutError:
        raise RemoteFailure(f"{url} cannot be read: its server gave nothing for {ANSWER_WITHIN_S:.0f} s.") from None
    except OSError as error:
        reason = error.strerror or str(error).partition("\n")[0]
        raise RemoteFailure(f"{url} cannot be read: {reason}.") from None
    except Exception as error:  # aiohttp, botocore and others have classes of their own
        if getattr(error, "status", None) == 416:  # a part beyond the file's end
            return b""
        raise RemoteFailure(f"{url} cannot be read: {type(error).__name__} {error}.".rstrip(". ") + ".") from None
