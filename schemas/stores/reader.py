"""Reading stores: the run, its episodes, what their keys are, and their arrays.

Both stages read with this module: analysis, and capture before it publishes an episode. zarr is imported when an array
is opened.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.groupings.vocabulary import EpisodeTokens
from vla_attention.schemas.jsonable import from_json
from vla_attention.schemas.stores.digest import document_digest
from vla_attention.schemas.stores.root import episode_folders, group_attributes, read_root
from vla_attention.schemas.stores.store_format import (
    SEAL_GROUP,
    CorruptEpisode,
    EpisodeAttributes,
    EpisodeSeal,
    RootAttributes,
    StoreError,
    parse_episode_name,
)

if TYPE_CHECKING:
    import zarr

    from vla_attention.schemas.stores.shards import ShardedLayers


@dataclass(frozen=True)
class StoredEpisode:
    """One episode in its folder. It is read when it is needed, and its metadata is then checked against the seal."""

    folder: Path

    @property
    def name(self) -> str:
        """The episode's group name."""
        return self.folder.name

    @cached_property
    def attributes(self) -> EpisodeAttributes:
        """The episode's attributes."""
        document = self.sealed("zarr.json")
        try:
            return from_json(EpisodeAttributes, group_attributes(document))
        except ValueError as error:
            raise CorruptEpisode(f"Episode {self.name} cannot be read: its attributes are damaged ({error}).") from None

    @cached_property
    def seal(self) -> EpisodeSeal:
        """The digests of the episode's metadata."""
        try:
            document = (self.folder / SEAL_GROUP / "zarr.json").read_bytes()
            return from_json(EpisodeSeal, group_attributes(document))
        except (OSError, ValueError) as error:
            raise CorruptEpisode(f"Episode {self.name} cannot be read: its seal is damaged ({error}).") from None

    def sealed(self, file: str) -> bytes:
        """Read one `zarr.json` of the episode; raises `CorruptEpisode` when its digest is not the one in the seal."""
        try:
            content = (self.folder / file).read_bytes()
        except OSError as error:
            raise CorruptEpisode(f"Episode {self.name} lacks its {file} ({error.strerror}).") from None
        if document_digest(content) != self.seal.files.get(file):
            raise CorruptEpisode(f"Episode {self.name} is damaged: its {file} does not agree with its seal.")
        return content

    @property
    def is_of_this_run(self) -> bool:
        """Whether the `zarr.json` of the store is, to the byte, the one under which the episode was recorded."""
        run = self.folder.parents[1] / "zarr.json"
        return document_digest(run.read_bytes()) == self.seal.run

    @cached_property
    def _opened(self) -> dict[str, zarr.Array[Any]]:
        return {}

    @cached_property
    def _layers(self) -> dict[str, ShardedLayers | None]:
        return {}

    def array(self, name: str) -> zarr.Array[Any]:
        """Open one array; raises `CorruptEpisode` when it lacks a file or has another shape than in the attributes."""
        if name not in self._opened:
            self._opened[name] = self._open(name)
        return self._opened[name]

    def _open(self, name: str) -> zarr.Array[Any]:
        import zarr
        from zarr.storage import LocalStore, StorePath

        recorded = self.attributes.arrays.get(name)
        if recorded is None:
            raise CorruptEpisode(f"Episode {self.name} lacks the array {name}: its attributes do not list it.")
        document = self.sealed(f"{name}/zarr.json")
        try:
            # Opened from the bytes that were checked against the seal: zarr does not read the file a second time.
            place = StorePath(LocalStore(self.folder / name, read_only=True))
            array: zarr.Array[Any] = zarr.Array(zarr.AsyncArray(metadata=json.loads(document), store_path=place))
        except (KeyError, TypeError, ValueError) as error:
            raise CorruptEpisode(f"Episode {self.name} lacks the array {name} ({error}).") from None
        if tuple(array.shape) != recorded.shape:
            raise CorruptEpisode(f"Array {name} of episode {self.name} has another shape than its attributes say.")
        # zarr reads a missing file as the fill value, which is a valid number in a picture.
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
        if name.endswith("/key_role") and not values.all():
            raise _lost_chunk(self, name)
        return self._without_missing(name, values)

    def read_layer(self, name: str, layer: int, denoise: int) -> NDArray[np.float32]:
        """One layer and denoise step (positions) of an array (replan, layer, denoise, ...), without those two axes."""
        if name not in self._layers:
            from vla_attention.schemas.stores.shards import ShardedLayers

            self._layers[name] = ShardedLayers.of(self.folder / name, dict(self.array(name).metadata.to_dict()))
        layers = self._layers[name]
        if layers is None:
            return self.read(name, (slice(None), layer, denoise))
        try:
            values = layers.read(layer, denoise)
        except CorruptEpisode as error:
            raise CorruptEpisode(f"Array {name} of episode {self.name} cannot be read: {error}") from None
        return self._without_missing(name, values)

    def _without_missing(self, name: str, values: NDArray[Any]) -> NDArray[Any]:
        if _holds_missing(values):
            raise _lost_chunk(self, name)
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
    """Open a store for reading; its episodes are in the order of task id and episode index.

    Raises:
        StoreNotFound: nothing is there; the error lists the stores nearby.
        StoreError: something else is there, or its attributes cannot be read.
        FormatTooNew: a later version wrote it.
    """
    root = read_root(path)
    try:
        folders = sorted(episode_folders(path), key=lambda folder: parse_episode_name(folder.name))
    except BadArgument as error:
        raise StoreError(f"The store {path} cannot be read: {error}") from None
    return Store(path, root, tuple(StoredEpisode(folder) for folder in folders))


def _lost_chunk(episode: StoredEpisode, name: str) -> CorruptEpisode:
    return CorruptEpisode(f"Array {name} of episode {episode.name} has missing values: a chunk is lost.")


def _holds_missing(values: NDArray[Any]) -> bool:
    """Whether floats or signed integers contain the fill value that zarr gives for a missing chunk."""
    if values.dtype.kind == "i":
        return bool((values == -1).any())
    if values.dtype.kind != "f" or not np.isnan(values.sum()):
        return False  # one pass without a temporary array: rows are large
    return bool(np.isnan(values).any())


def _chunk_files(array: zarr.Array[Any]) -> Iterator[str]:
    """Paths of the files that hold an array, relative to it."""
    extents = zip(array.shape, array.shards or array.chunks, strict=True)
    for coordinates in itertools.product(*(range(-(-size // extent)) for size, extent in extents)):
        yield array.metadata.encode_chunk_key(coordinates)
