"""Files that are elsewhere, through fsspec (the extra `remote`), and the cache of what was fetched.

Only the bytes that are asked for are fetched. `hf://datasets/ORG/NAME/PATH` is read by the addresses under which the
hub serves files, so that a part of a file is one request; fsspec's own file system of the hub asks for a description of
the file each time. What belongs to a sealed episode is kept in a folder of this machine, by the seal's digest: bytes of
an episode that was changed are never taken for those of another. `VLA_REMOTE_CACHE` names the folder (`off`: keep
nothing), `VLA_REMOTE_CACHE_SIZE` its most bytes.
"""

from __future__ import annotations

import hashlib
import os
import re
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from vla_attention.schemas.byte_counts import parse_bytes
from vla_attention.schemas.errors import BadArgument, UserError
from vla_attention.schemas.limits import ANSWER_WITHIN_S, ROOT_BYTES, SLOWEST_BYTES_A_SECOND, WHOLE_FILE_BYTES
from vla_attention.schemas.stores.bounded_fetch import TooSlow, asked_within, fetched, files_below, names_in
from vla_attention.schemas.stores.byte_source import ByteSource, Folder, Memory, copy_into, split
from vla_attention.schemas.stores.store_url import HUB_PROTOCOL, HubAddress, StorePlace, StoreUrl, stated_commit
from vla_attention.schemas.user_cache import user_cache

FOLDER_VARIABLE = "VLA_REMOTE_CACHE"
SIZE_VARIABLE = "VLA_REMOTE_CACHE_SIZE"
DEFAULT_BYTES = 10_000_000_000
_OFF = ("off", "0", "no", "false")
_DIGEST_BYTES = 32
#: The cache is searched for what to remove after every so many bytes that were added to it.
_LOOK_EVERY = 64_000_000
#: Protocols whose addresses may be `//name:password@host`; elsewhere @ stands before a revision.
_WITH_PASSWORDS = ("http", "https", "ftp", "sftp", "ssh", "smb", "webdav")


class RemoteFailure(UserError, OSError):
    """A place elsewhere that cannot be read: the network, a server's refusal, or a missing package."""


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
    if without != place.url and place.protocol in ("http", "https"):
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
    files, _ = _file_system(place.url)
    asked = address.revision_address(_hub()[0])
    try:
        answer = _asked(place.url, lambda: fetched(files, asked, None, None, ROOT_BYTES, ANSWER_WITHIN_S))
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
        digest: that of the seal or the index to which the files belong; they are kept then.
    """

    url: str
    digest: str = ""

    @property
    def remembers(self) -> bool:
        """See `ByteSource`."""
        return bool(self.digest) and kept_bytes() is not None

    def whole(self, file: str, *, most: int = WHOLE_FILE_BYTES, fresh: bool = False) -> bytes:
        """See `ByteSource`."""
        return self._get(file, None, None, fresh, most)

    def parts(self, file: str, offset: int, lengths: Sequence[int], *, fresh: bool = False) -> list[bytes]:
        """See `ByteSource`; one request."""
        length = sum(lengths)
        return split(self._get(file, offset, offset + length, fresh, length) if length else b"", lengths)

    def read_into(self, memory: Memory, file: str, offset: int, *, fresh: bool = False) -> int:
        """See `ByteSource`; one request."""
        return copy_into(memory, self.parts(file, offset, (len(memory),), fresh=fresh)[0])

    def size(self, file: str) -> int:
        """See `ByteSource`."""
        files, path = _file_system(self.url)
        size = _asked(self.url, lambda: asked_within(files, "size", f"{path}/{file}", seconds=ANSWER_WITHIN_S))
        return int(size or 0)

    def names(self, folder: str) -> list[str]:
        """The names in a folder, where the server lists them."""
        files, path = self._listing()
        return sorted(_asked(self.url, lambda: names_in(files, f"{path}/{folder}", ANSWER_WITHIN_S)))

    def files_below(self, folder: str) -> list[str]:
        """Paths of all files below a folder; `NotImplementedError` where the server has no list of them."""
        files, path = self._listing()
        return sorted(_asked(self.url, lambda: files_below(files, f"{path}/{folder}", ANSWER_WITHIN_S)))

    def _listing(self) -> tuple[Any, str]:
        return _hub_listing(self.url) if self.url.startswith(HUB_PROTOCOL) else _file_system(self.url)

    def bound_to(self, digest: str) -> RemoteFolder:
        """See `ByteSource`."""
        return RemoteFolder(self.url, digest)

    def _get(self, file: str, start: int | None, end: int | None, fresh: bool, most: int) -> bytes:
        kept = kept_bytes() if self.digest else None
        key = f"{self.digest}\n{file}\n{start}\n{end}"
        if kept is not None and not fresh:
            answer = kept.get(key)
            if answer is not None:
                return answer
        content = self._fetch(file, start, end, most)
        if kept is not None:
            kept.put(key, content)
        return content

    def _fetch(self, file: str, start: int | None, end: int | None, most: int) -> bytes:
        files, path = _file_system(self.url)
        content: bytes = _asked(self.url, lambda: fetched(files, f"{path}/{file}", start, end, most, ANSWER_WITHIN_S))
        if len(content) <= most:
            return content
        if start is not None:
            raise RemoteFailure(
                f"The server of {self.url} sends whole files where a part was asked for (no range requests), so that "
                "every number would cost a whole episode; copy the store here, or use a server that has them."
            )
        raise RemoteFailure(f"{self.url}/{file} has more than the {most:,} bytes that such a file has at most.")


@dataclass(frozen=True)
class KeptBytes:
    """A folder of bytes that were fetched; every file begins with the sha256 of the rest."""

    folder: Path
    most_bytes: int

    def get(self, key: str) -> bytes | None:
        """What was kept, or None; a damaged file is removed and is nothing."""
        path = self._path(key)
        try:
            content = path.read_bytes()
        except OSError:
            return None
        kept = content[_DIGEST_BYTES:]
        if hashlib.sha256(kept).digest() != content[:_DIGEST_BYTES]:
            path.unlink(missing_ok=True)
            return None
        with suppress(OSError):
            os.utime(path)  # the least recently used is removed first
        return kept

    def put(self, key: str, content: bytes) -> None:
        """Keep bytes; a folder without room or rights keeps nothing."""
        path = self._path(key)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            handle, name = tempfile.mkstemp(dir=path.parent, prefix=".new-")
            try:
                with os.fdopen(handle, "wb") as file:
                    file.write(hashlib.sha256(content).digest() + content)
                os.replace(name, path)
            except BaseException:
                Path(name).unlink(missing_ok=True)
                raise
        except OSError:
            return
        self._note(len(content))

    def _path(self, key: str) -> Path:
        digest = hashlib.sha256(key.encode()).hexdigest()
        return self.folder / digest[:2] / digest[2:]

    def _note(self, added: int) -> None:
        seen = _ADDED.get(self.folder, _LOOK_EVERY) + added
        _ADDED[self.folder] = 0 if seen >= min(_LOOK_EVERY, self.most_bytes) else seen
        if not _ADDED[self.folder]:
            self.prune()

    def prune(self) -> None:
        """Remove the files that were not used for longest, until the rest is small enough."""
        files = []
        for path in self.folder.glob("??/*"):
            with suppress(OSError):
                status = path.stat()
                files.append((status.st_mtime_ns, status.st_size, path))
        total = sum(size for _, size, _ in files)
        for _, size, path in sorted(files):
            if total <= self.most_bytes:
                break
            with suppress(OSError):
                path.unlink()
                total -= size


#: Bytes added to each folder since it was last searched.
_ADDED: dict[Path, int] = {}


def kept_bytes() -> KeptBytes | None:
    """The cache of this process, or None when it is switched off."""
    given = os.environ.get(FOLDER_VARIABLE, "").strip()
    if given.casefold() in _OFF:
        return None
    size = os.environ.get(SIZE_VARIABLE, "").strip()
    most = parse_bytes(size) if size else DEFAULT_BYTES
    if most is None:
        raise BadArgument(
            f"{SIZE_VARIABLE}={size} is no size; expected a number of bytes, or one with a unit, as in 500MB or 10GB. "
            f"To keep nothing, set {FOLDER_VARIABLE}=off."
        )
    return KeptBytes(Path(given).absolute() if given else user_cache("remote"), most)


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
            options = {"headers": headers, "timeout": _time_limits()}
            return fsspec.filesystem("https", client_kwargs=options), HubAddress.of(url).file_address(endpoint)
        is_web = url.startswith(("http://", "https://"))
        files, path = url_to_fs(url, **({"client_kwargs": {"timeout": _time_limits()}} if is_web else {}))
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
        "pip install 'vla-attention[remote]', or copy the store here."
    )


def _asked(url: str, ask: Any) -> Any:
    """What a file system answers; what it raises in its own classes becomes an `OSError` with the address."""
    try:
        return ask()
    except FileNotFoundError:
        raise
    except NotImplementedError:
        raise
    except TooSlow as slow:
        if slow.received:
            raise RemoteFailure(
                f"{url} cannot be read: its server sent {slow.received:,} bytes in {slow.seconds:.0f} s; expected at "
                f"least {SLOWEST_BYTES_A_SECOND:,} a second. Try again later, or from elsewhere."
            ) from None
        raise RemoteFailure(f"{url} cannot be read: its server sent nothing for {slow.seconds:.1f} s.") from None
    except TimeoutError:
        raise RemoteFailure(f"{url} cannot be read: its server sent nothing for {ANSWER_WITHIN_S:g} s.") from None
    except OSError as error:
        reason = error.strerror or str(error).partition("\n")[0]
        raise RemoteFailure(f"{url} cannot be read: {reason}.") from None
    except Exception as error:  # aiohttp, botocore and others have classes of their own
        if getattr(error, "status", None) == 416:  # a part beyond the file's end
            return b""
        raise RemoteFailure(f"{url} cannot be read: {type(error).__name__} {error}.".rstrip(". ") + ".") from None
