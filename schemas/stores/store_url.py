"""Addresses of stores: a path of this machine, or `hf://`, `s3://`, `https://` and what else fsspec knows.

Those on the Hugging Face hub are `hf://datasets/ORG/NAME/PATH`, with `@REVISION` after NAME.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.jsonable import decode_json

#: What the operating system makes of the two slashes when an address went through `Path`: one.
_ADDRESS = re.compile(r"([a-z][a-z0-9+.-]+):/{1,3}(?=[^/])")


@dataclass(frozen=True, order=True)
class StoreUrl:
    """The address of a store that is elsewhere. It has what the program asks of a path: name, parent and so on."""

    url: str

    def __str__(self) -> str:
        return self.url

    @property
    def protocol(self) -> str:
        """What stands before `://`."""
        return self.url.partition("://")[0]

    @property
    def _path(self) -> PurePosixPath:
        return PurePosixPath(self.url.partition("://")[2])

    @property
    def name(self) -> str:
        """The last part."""
        return self._path.name

    @property
    def stem(self) -> str:
        """The last part without its ending."""
        return self._path.stem

    @property
    def suffix(self) -> str:
        """The ending of the last part."""
        return self._path.suffix

    @property
    def parent(self) -> StoreUrl:
        """The folder above."""
        return StoreUrl(f"{self.protocol}://{self._path.parent}")

    @property
    def parts(self) -> tuple[str, ...]:
        """The parts behind the protocol."""
        return self._path.parts

    def with_suffix(self, suffix: str) -> StoreUrl:
        """The address with another ending."""
        return StoreUrl(f"{self.protocol}://{self._path.with_suffix(suffix)}")

    def resolve(self) -> StoreUrl:
        """An address is as it is."""
        return self

    def absolute(self) -> StoreUrl:
        """An address is as it is."""
        return self

    def __truediv__(self, part: str) -> StoreUrl:
        return StoreUrl(f"{self.url.rstrip('/')}/{part}")


#: Where a store is.
StorePlace = Path | StoreUrl


def is_store(word: str) -> bool:
    """Whether a word of a command line is the place of a store."""
    return word.rstrip("/").endswith(".zarr") or "://" in word


def store_place(given: str | Path | StoreUrl) -> StorePlace:
    """The path or the address that somebody gave. `Path("s3://bucket/a.zarr")`, which lost a slash, is an address."""
    if isinstance(given, StoreUrl):
        return given
    match = _ADDRESS.match(str(given))
    if match is None:
        return Path(given)
    protocol, rest = match[1], str(given)[match.end() :].rstrip("/")
    return Path(f"/{rest}") if protocol == "file" else StoreUrl(f"{protocol}://{rest}")


def local_path(place: StorePlace) -> Path:
    """The path of a store that is here.

    Raises:
        BadArgument: it is elsewhere.
    """
    if isinstance(place, StoreUrl):
        raise BadArgument(
            f"{place} is elsewhere, and this command needs a store here: vla-attention store copy {place} NAME.zarr."
        )
    return place


HUB_PROTOCOL = "hf://"
#: The branch that is read where an address states no revision.
MAIN = "main"
_COMMIT = re.compile(r"[0-9a-f]{40}")


@dataclass(frozen=True)
class HubAddress:
    """A place in a repository of the hub.

    Attributes:
        kind: `datasets`, `spaces` or `models`.
        repository: `ORG/NAME`.
        revision: a commit, or a branch or tag, which may be moved to another commit at any time.
        path: of a file or folder in the repository.
    """

    kind: str
    repository: str
    revision: str
    path: str

    @classmethod
    def of(cls, url: str) -> HubAddress:
        """The parts of an address; raises `BadArgument` for one that names no repository."""
        parts = url.removeprefix(HUB_PROTOCOL).split("/")
        kind = parts.pop(0) if parts[0] in ("datasets", "spaces") else "models"
        name, _, revision = (parts[1] if len(parts) > 1 else "").partition("@")
        if not parts[0] or not name:
            raise BadArgument(f"{url} is no address on the hub; expected hf://datasets/ORG/NAME/PATH.")
        return cls(kind, f"{parts[0]}/{name}", revision or MAIN, "/".join(parts[2:]))

    def __str__(self) -> str:
        at = "" if self.revision == MAIN else f"@{self.revision}"
        return f"{HUB_PROTOCOL}{self._prefix}{self.repository}{at}/{self.path}"

    @property
    def is_commit(self) -> bool:
        """Whether the revision is a commit, whose files never change."""
        return _COMMIT.fullmatch(self.revision) is not None

    def at(self, commit: str) -> HubAddress:
        """The same place at a commit."""
        return replace(self, revision=commit)

    def file_address(self, endpoint: str) -> str:
        """Where the hub at `endpoint` serves the files of this place."""
        return f"{endpoint}/{self._prefix}{self.repository}/resolve/{self._revision}/{self.path}".rstrip("/")

    def revision_address(self, endpoint: str) -> str:
        """Where the hub at `endpoint` says which commit the revision is; without `expand` it lists all files too."""
        return f"{endpoint}/api/{self.kind}/{self.repository}/revision/{self._revision}?expand%5B%5D=sha"

    @property
    def _prefix(self) -> str:
        return "" if self.kind == "models" else f"{self.kind}/"

    @property
    def _revision(self) -> str:
        return self.revision.replace("/", "%2F")


def stated_commit(answer: bytes) -> str | None:
    """The commit in what the hub answers at `HubAddress.revision_address`, None where it states none."""
    try:
        document = decode_json(answer)
    except ValueError:
        return None
    commit = document.get("sha") if isinstance(document, dict) else None
    return commit if isinstance(commit, str) and _COMMIT.fullmatch(commit) else None
