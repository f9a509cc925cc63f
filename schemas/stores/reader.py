"""Reading stores: what episodes there are, what their keys are, and their rows. The only module that touches Zarr."""

from __future__ import annotations

import hashlib
import itertools
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray
from zarr.storage import LocalStore, StorePath

from vla_attention.schemas.errors import did_you_mean, listing
from vla_attention.schemas.groupings.vocabulary import EpisodeTokens
from vla_attention.schemas.jsonable import MalformedDocument, from_json
from vla_attention.schemas.stores.shards import ShardedLayers
from vla_attention.schemas.stores.store_format import (
    EPISODES_GROUP,
    SEAL_GROUP,
    CorruptEpisode,
    EpisodeAttributes,
    EpisodeSeal,
    RootAttributes,
    StoreError,
    StoreNotFound,
    check_format,
    parse_episode_name,
)


@dataclass(frozen=True)
class StoredEpisode:
    """One committed episode. Nothing is read before it is asked for."""

    folder: Path

    @property
    def name(self) -> str:
        """The episode's group name."""
        return self.folder.name

    @cached_property
    def attributes(self) -> EpisodeAttributes:
        """What the episode says of itself."""
        try:
            return from_json(EpisodeAttributes, _attributes_of(self.sealed("zarr.json")))
        except (OSError, ValueError, KeyError) as error:
            if isinstance(error, CorruptEpisode):
                raise
            raise CorruptEpisode(f"Episode {self.name} cannot be read: its attributes are damaged ({error}).") from None

    @cached_property
    def seal(self) -> EpisodeSeal:
        """The digests of the episode's metadata."""
        try:
            given = _attributes_of((self.folder / SEAL_GROUP / "zarr.json").read_bytes())
            return from_json(EpisodeSeal, given)
        except (OSError, ValueError, KeyError) as error:
            raise CorruptEpisode(f"Episode {self.name} cannot be read: its seal is damaged ({error}).") from None

    def sealed(self, file: str) -> bytes:
        """The bytes of one `zarr.json` of the episode; raises `CorruptEpisode` when they are not those that the seal knows."""
        try:
            content = (self.folder / file).read_bytes()
        except OSError as error:
            raise CorruptEpisode(f"Episode {self.name} lacks its {file} ({error.strerror}).") from None
        if hashlib.sha256(content).hexdigest() != self.seal.files.get(file):
            raise CorruptEpisode(f"Episode {self.name} is damaged: its {file} does not agree with its seal.")
        return content

    @property
    def is_of_this_run(self) -> bool:
        """Whether the store's own attributes are, to the byte, those that the episode was recorded under."""
        run = self.folder.parents[1] / "zarr.json"
        return hashlib.sha256(run.read_bytes()).hexdigest() == self.seal.run

    @cached_property
    def _opened(self) -> dict[str, zarr.Array]:
        return {}

    @cached_property
    def _layers(self) -> dict[str, ShardedLayers | None]:
        return {}

    def array(self, name: str) -> zarr.Array:
        """One array of the episode; raises `CorruptEpisode` when it lacks a file or has another shape than promised."""
        if name not in self._opened:
            self._opened[name] = self._open(name)
        return self._opened[name]

    def _open(self, name: str) -> zarr.Array:
        promised = self.attributes.arrays.get(name)
        if promised is None:
            raise CorruptEpisode(f"Episode {self.name} lacks the array {name}: its attributes do not list it.")
        document = self.sealed(f"{name}/zarr.json")
        try:
            # Opened from the very bytes that the seal vouches for: nothing is looked up, and nothing read twice.
            place = StorePath(LocalStore(self.folder / name, read_only=True))
            array: zarr.Array = zarr.Array(zarr.AsyncArray(metadata=json.loads(document), store_path=place))
        except (KeyError, TypeError, ValueError) as error:
            raise CorruptEpisode(f"Episode {self.name} lacks the array {name} ({error}).") from None
        if tuple(array.shape) != promised.shape:
            raise CorruptEpisode(f"Array {name} of episode {self.name} has not the shape that its attributes promise.")
        # A missing file reads as the fill value, and in a picture that may be any picture's number.
        for file in _chunk_files(array):
            if not (self.folder / name / file).is_file():
                raise CorruptEpisode(f"Array {name} of episode {self.name} has lost its file {file}.")
        return array

    def read(self, name: str, index: Any = ...) -> NDArray[Any]:
        """Values of one array; a chunk that is missing or fails its checksum raises `CorruptEpisode`."""
        array = self.array(name)
        try:
            values = np.asarray(array[index])
        except IndexError:
            raise  # the caller's mistake
        except Exception as error:  # damaged bytes can make codecs raise anything
            problem = str(error).rstrip(".")
            raise CorruptEpisode(f"Array {name} of episode {self.name} cannot be read: {problem}.") from error
        if _holds_missing(values) or (name.endswith("/key_role") and not values.all()):
            raise CorruptEpisode(f"Array {name} of episode {self.name} has missing values: a chunk is lost.")
        return values

    def read_layer(self, name: str, layer: int, denoise: int) -> NDArray[np.float32]:
        """One layer and denoise step (positions) of an array (replan, layer, denoise, ...), without those two axes."""
        if name not in self._layers:
            self._layers[name] = ShardedLayers.of(self.folder / name, dict(self.array(name).metadata.to_dict()))
        layers = self._layers[name]
        if layers is None:
            return self.read(name, (slice(None), layer, denoise))
        try:
            values = layers.read(layer, denoise)
        except CorruptEpisode as error:
            raise CorruptEpisode(f"Array {name} of episode {self.name} cannot be read: {error}") from None
        if _holds_missing(values):
            raise CorruptEpisode(f"Array {name} of episode {self.name} has missing values: a chunk is lost.")
        return values

    def tokens(self, root: RootAttributes, site: str) -> EpisodeTokens:
        """What every key of a site is in this episode."""
        layout = next(layout for layout in root.sites if layout.name == site)
        stored = [name.removeprefix("objects/") for name in self.attributes.arrays if name.startswith("objects/")]
        cameras = [camera for camera in stored if camera in layout.cameras]
        # A prompt's pieces are keys of the site that reads it; elsewhere (Cosmos's self-attention) there are no words.
        reads = any(span.kind == "text" for span in layout.spans)
        return EpisodeTokens(
            layout=layout,
            key_role=self.read(f"{site}/key_role"),
            prompts=self.attributes.prompts if reads else (),
            prompt_index=self.read("prompt_index"),
            objects=self.attributes.objects,
            coverage=_StoredCoverage(self, cameras),
        )


class _StoredCoverage(Mapping[str, NDArray[np.float32]]):
    """Object coverage by camera, read when a grouping needs it."""

    def __init__(self, episode: StoredEpisode, cameras: Sequence[str]) -> None:
        self._episode = episode
        self._cameras = cameras

    def __getitem__(self, camera: str) -> NDArray[np.float32]:
        return self._episode.read(f"objects/{camera}")

    def __iter__(self) -> Iterator[str]:
        return iter(self._cameras)

    def __len__(self) -> int:
        return len(self._cameras)


@dataclass(frozen=True)
class Store:
    """A store opened for reading: its run, and the episodes that were committed when it was opened."""

    path: Path
    attributes: RootAttributes
    episodes: tuple[StoredEpisode, ...]

    @property
    def suite(self) -> str:
        """The task suite of the run."""
        return self.attributes.protocol.suite

    @property
    def task_ids(self) -> tuple[int, ...]:
        """Ids of the tasks that have at least one episode."""
        return tuple(sorted({parse_episode_name(episode.name)[0] for episode in self.episodes}))


def open_store(path: Path) -> Store:
    """Open a store for reading.

    Raises:
        StoreNotFound: nothing is there; stores nearby are named.
        StoreError: something else is there, or its attributes cannot be read.
        FormatTooNew: a later version wrote it.
    """
    if not path.exists():
        nearby = sorted(str(found) for found in path.parent.glob("*.zarr")) if path.parent.is_dir() else []
        raise StoreNotFound(
            f"There is no store at {path}.{did_you_mean(str(path), nearby)} Stores in {path.parent}: {listing(nearby)}. "
            "Make one with vla-capture."
        )
    try:
        attributes = _read_attributes(path)
    except (FileNotFoundError, NotADirectoryError):
        raise StoreError(f"{path} is not a store: it has no zarr.json.") from None
    except (OSError, ValueError, KeyError) as error:
        raise StoreError(f"The store {path} cannot be read: {error}.") from None
    check_format(attributes, path)
    try:
        root = from_json(RootAttributes, attributes)
        names = sorted(entry.name for entry in (path / EPISODES_GROUP).iterdir() if entry.is_dir())
        keyed = sorted((parse_episode_name(name), name) for name in names)
    except (MalformedDocument, OSError, ValueError) as error:
        raise StoreError(f"The store {path} cannot be read: {error}") from None
    return Store(path, root, tuple(StoredEpisode(path / EPISODES_GROUP / name) for _, name in keyed))


def _holds_missing(values: NDArray[Any]) -> bool:
    """Whether numbers that a missing chunk reads as are among the values."""
    if values.dtype.kind == "i":
        return bool((values == -1).any())
    if values.dtype.kind != "f" or not np.isnan(values.sum()):
        return False  # one pass without a temporary array: rows are large
    return bool(np.isnan(values).any())


def _chunk_files(array: zarr.Array) -> Iterator[str]:
    """Paths of the files that hold an array, relative to it."""
    extents = zip(array.shape, array.shards or array.chunks, strict=True)
    for coordinates in itertools.product(*(range(-(-size // extent)) for size, extent in extents)):
        yield array.metadata.encode_chunk_key(coordinates)


def _read_attributes(folder: Path) -> dict[str, Any]:
    return _attributes_of((folder / "zarr.json").read_bytes())


def _attributes_of(group_document: bytes) -> dict[str, Any]:
    document = json.loads(group_document)
    if not isinstance(document, dict) or (document.get("zarr_format"), document.get("node_type")) != (3, "group"):
        raise ValueError("zarr.json does not describe a group of Zarr format 3")
    attributes = document.get("attributes", {})
    if not isinstance(attributes, dict):
        raise ValueError("zarr.json has no attributes")
    return attributes
