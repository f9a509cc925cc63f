"""Addresses of stores: a path of this machine, or `hf://`, `s3://`, `https://` and what else fsspec knows."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from vla_attention.schemas.errors import BadArgument

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
            f"{place} is elsewhere, and this command needs a store here: vla-analyze copy {place} NAME.zarr."
        )
    return place
