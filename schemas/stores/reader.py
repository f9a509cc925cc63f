"""Reading stores: the run, its episodes, what their keys are, and their arrays.

Both stages read with this module: analysis, and capture before it publishes an episode.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from msgspec import structs
from numpy.typing import NDArray

from vla_attention.schemas.cached_property import cached_property
from vla_attention.schemas.errors import Note, listing
from vla_attention.schemas.fitted_pictures import border_of_keys
from vla_attention.schemas.groupings.key_counts import stored_uniform_of_roles
from vla_attention.schemas.groupings.vocabulary import EpisodeTokens
from vla_attention.schemas.jsonable import MalformedDocument, from_json
from vla_attention.schemas.layout import Prompt, prompt_at
from vla_attention.schemas.precision import is_half
from vla_attention.schemas.safe_text import visible
from vla_attention.schemas.stores.byte_source import ByteSource
from vla_attention.schemas.stores.content_rules import shape_problems, site_shapes
from vla_attention.schemas.stores.outcomes import LaterOutcome, read_outcomes
from vla_attention.schemas.stores.remote_source import RemoteFailure, at_commit, source_of
from vla_attention.schemas.stores.root import NAMES_FILE, attributes_in, list_episodes, read_run, unlisted_episodes
from vla_attention.schemas.stores.seal import identity_problem, read_seal
from vla_attention.schemas.stores.sealed_files import SealedFiles
from vla_attention.schemas.stores.store_format import (
    NUMBERS,
    CorruptEpisode,
    EpisodeAttributes,
    EpisodeSeal,
    RootAttributes,
    episode_name,
    parse_episode_name,
)
from vla_attention.schemas.stores.store_url import StorePlace, store_place

if TYPE_CHECKING:
    from vla_attention.schemas.stores.stored_array import StoredArray

Read = TypeVar("Read")

#: Decoded bytes of an array that are read at once where all of it is read and a part would do.
READ_AT_ONCE_BYTES = 64_000_000


@dataclass(frozen=True)
class StoredEpisode:
    """One episode in its folder. It is read when it is needed, and nothing is read that its seal does not bind.

    Attributes:
        folder: where it is.
        name: the name of its group, which its seal must have.
        run: digest of the configuration of the run that it must belong to, see `run_digest`.
        outcome: what was told of it after the recording.
    """

    folder: StorePlace
    name: str
    run: str
    outcome: LaterOutcome | None = None

    def __reduce__(self) -> tuple[object, ...]:
        """A pickle holds where the episode is and nothing that was read; another process may run in another folder."""
        return StoredEpisode, (_from_anywhere(self.folder), self.name, self.run, self.outcome)

    @cached_property
    def source(self) -> ByteSource:
        """The episode's files as they are found, not yet compared with the seal."""
        return source_of(self.folder)

    @cached_property
    def attributes(self) -> EpisodeAttributes:
        """The episode's attributes; its success is what was told later, where the recording knew none."""
        document = self.document("zarr.json")
        try:
            attributes = from_json(EpisodeAttributes, attributes_in(document))
        except MalformedDocument as error:
            raise CorruptEpisode(f"Episode {self.name} cannot be read: its attributes are damaged ({error}).") from None
        stated = episode_name(attributes.task_id, attributes.episode_index)
        if stated != self.name:
            raise CorruptEpisode(f"Episode {self.name} cannot be read: its attributes are those of {stated}.")
        if self.outcome is None:
            return attributes
        if not self.is_told:
            told = (
                f"The outcome that was told of {self.name} is of an earlier recording of it, and is not used; tell it "
                "again with vla-attention store outcomes."
            )
            warnings.warn(told, Note, stacklevel=2)
            return attributes
        if attributes.success not in (None, self.outcome.success):
            raise CorruptEpisode(f"Episode {self.name} has an outcome, and another one was told of it later.")
        return structs.replace(attributes, success=self.outcome.success)

    @cached_property
    def seal(self) -> EpisodeSeal:
        """What binds the episode's files to its name and run; `CorruptEpisode` when it is not that of this episode."""
        try:
            seal = read_seal(self.source)
        except (RemoteFailure, CorruptEpisode):
            raise
        except OSError as error:
            lost = error.strerror or error
            raise CorruptEpisode(f"Episode {self.name} cannot be read: it has lost its seal ({lost}).") from None
        except ValueError as error:
            raise CorruptEpisode(f"Episode {self.name} cannot be read: its seal is damaged ({error}).") from None
        problem = identity_problem(seal, self.name, self.run)
        if problem is not None:
            raise CorruptEpisode(f"Episode {self.name} cannot be read: {problem}.")
        return seal

    @property
    def captured(self) -> str:
        """The digest of the seal under which the episode was captured, also of a copy that leaves something out."""
        return self.seal.copied_from or self.seal.digest

    @property
    def is_told(self) -> bool:
        """Whether an outcome was told of it after this recording."""
        return self.outcome is not None and self.outcome.seal == self.captured

    @cached_property
    def files(self) -> SealedFiles:
        """The episode's files, as the seal lists them."""
        return SealedFiles(self.source, self.seal.files)

    def document(self, file: str) -> Any:
        """What one `zarr.json` of the episode says, as its seal repeats it; `CorruptEpisode` when it does not."""
        try:
            return self.seal.documents[file]
        except KeyError:
            raise CorruptEpisode(f"Episode {self.name} is damaged: its seal does not list its {file}.", file) from None

    def copy_file(self, file: str, path: Path) -> int:
        """Write one file of the episode to `path`, and return its bytes; raises as `sealed` does."""
        try:
            return self.files.copy(file, path)
        except CorruptEpisode as error:
            raise CorruptEpisode(f"Episode {self.name} is damaged: {error}.", error.file) from None

    @cached_property
    def _arrays(self) -> dict[str, StoredArray]:
        return {}

    @cached_property
    def _kept(self) -> dict[str, NDArray[Any]]:
        return {}

    def has(self, name: str) -> bool:
        """Whether the episode has an array of that name, or numbers of that name in its attributes."""
        return name in self.attributes.arrays or bool(self._numbers_of(name))

    def array(self, name: str) -> StoredArray:
        """One array, whose `zarr.json` was checked against the format, the attributes and the seal.

        Raises:
            CorruptEpisode: the attributes do not list it, or its metadata are damaged.
        """
        if name not in self._arrays:
            from vla_attention.schemas.stores.array_metadata import array_metadata
            from vla_attention.schemas.stores.stored_array import StoredArray

            if name not in self.attributes.arrays:
                raise CorruptEpisode(f"Episode {self.name} lacks the array {name}: its attributes do not list it.")
            document = self.document(f"{name}/zarr.json")
            metadata = self._readable(name, lambda: array_metadata(document))
            if metadata.shape != (stated := self.attributes.arrays[name].shape):
                raise CorruptEpisode(
                    f"Array {name} of episode {self.name} cannot be read: its zarr.json says the shape "
                    f"{metadata.shape}, and the episode's attributes {stated}.",
                    f"{name}/zarr.json",
                )
            self._arrays[name] = StoredArray(name, metadata, self.files)
        return self._arrays[name]

    def reading_step(self, name: str) -> int:
        """Indices along the first axis of an array that are read at once: all, or of large arrays those of a chunk."""
        about = self.array(name).metadata
        whole = about.read_dtype.itemsize * math.prod(about.shape) <= READ_AT_ONCE_BYTES
        return max(1, about.shape[0]) if whole else about.chunk_shape[0]

    def read(self, name: str, index: int | slice = slice(None)) -> NDArray[Any]:
        """Values of one array, or numbers of the attributes (`NUMBERS`) as one.

        index: along the first axis, one or neighbours; all unless given.

        Raises:
            CorruptEpisode: it is not there, or a chunk of it is missing or not the one that was sealed.
        """
        numbers = self._numbers_as_array(name)
        if numbers is not None:
            return np.asarray(numbers[index])
        indices = range(self.shape_of(name)[0])
        chosen = indices[index] if isinstance(index, slice) else range(indices[index], indices[index] + 1)
        values = self.values_of(name, self.read_stored(name, chosen.start, chosen.stop))
        return values[0] if isinstance(index, int) else values

    def keep(self, name: str) -> NDArray[Any]:
        """As `read`, of a small array that several need; kept until `forget` is called, and not to be changed."""
        if name not in self._kept:
            self._kept[name] = self.read(name)
        return self._kept[name]

    def read_kept(self, name: str) -> NDArray[Any]:
        """What `keep` has kept of an array; read where that is nothing."""
        return self._kept[name] if name in self._kept else self.read(name)

    def forget(self) -> None:
        """Let go of what `keep` has kept."""
        self._kept.clear()

    def read_stored(self, name: str, first: int, stop: int) -> NDArray[Any]:
        """Numbers of one array as they are stored, from one index along the first axis to another; see `values_of`."""
        return self._readable(name, lambda: self.array(name).read_stored(first, max(first, stop)))

    def values_of(self, name: str, stored: NDArray[Any]) -> NDArray[Any]:
        """What the stored numbers of an array stand for; `CorruptEpisode` where a chunk of them is missing."""
        values = self._readable(name, lambda: self.array(name).values_of(stored))
        self.refuse_missing(name, values)
        return values

    def _numbers_of(self, name: str) -> tuple[float, ...]:
        return getattr(self.attributes, name) if name in NUMBERS else ()

    def _numbers_as_array(self, name: str) -> Any:
        """The numbers of that name in the attributes, None without any."""
        numbers = self._numbers_of(name)
        try:
            return np.array(numbers, dtype=NUMBERS[name]) if numbers else None
        except OverflowError as error:
            raise CorruptEpisode(f"Episode {self.name} cannot be read: its {name} are damaged ({error}).") from None

    def shape_of(self, name: str) -> tuple[int, ...]:
        """Shape of one array; raises `CorruptEpisode` for one that its files cannot have."""
        return self.array(name).metadata.shape

    def read_layer(self, name: str, layer: int, denoise: int) -> NDArray[np.float32]:
        """One layer and denoise step (positions) of an array (replan, layer, denoise, ...), without those two axes."""
        values = next(self.read_layers(name, [(layer, denoise)]))
        self.refuse_missing(name, values)
        return values

    def read_layers(
        self, name: str, places: Iterable[tuple[int, int]], keys: range | None = None
    ) -> Iterator[NDArray[np.float32]]:
        """Layers and denoise steps of an array as `read_layer` gives them, one after the other in the same memory.

        Each is gone when the next one is asked for. They are not searched for missing values: give `refuse_missing`
        what is made of them, which has far fewer numbers. keys: whole chunks of them, see `StoredArray.layers`.
        """
        layers = self.array(name).layers(places, keys)
        while (values := self._readable(name, lambda: next(layers, None))) is not None:
            yield values

    def _readable(self, name: str, read: Callable[[], Read]) -> Read:
        try:
            return read()
        except CorruptEpisode as error:
            raise CorruptEpisode(f"Array {name} of episode {self.name} cannot be read: {error}.", error.file) from None
        except MemoryError:
            raise CorruptEpisode(f"Array {name} of episode {self.name} is said to be larger than the memory.") from None

    def refuse_missing(self, name: str, values: NDArray[Any]) -> None:
        """Raise `CorruptEpisode` when values of an array, or sums of them, have the mark of a lost chunk."""
        if _holds_missing(values) or (name.endswith("/key_role") and not values.all()):
            raise CorruptEpisode(f"Array {name} of episode {self.name} has missing values: a chunk is lost.")

    def row_sum(self, site: str) -> NDArray[np.float32]:
        """Sums of the rows as they were computed, (replan, layer, denoise, head, query)."""
        return np.asarray(self.read_kept(f"{site}/atoms")[..., -1])

    def uniform(self, site: str) -> NDArray[np.float32]:
        """What uniform attention gives in the place of each row, with the axes of `SITE/rows`.

        An axis along which nothing changes may have length 1. It is stored where the roles of the keys do not say it.
        """
        name = f"{site}/uniform"
        if self.has(name):
            values: NDArray[np.float32] = self.read(name)
            return values
        return self.uniform_of_roles(site)

    def uniform_of_roles(self, site: str) -> NDArray[np.float32]:
        """`uniform` where every query sees all keys whose roles let it see them, (replan, 1, 1, 1, 1, key)."""
        return stored_uniform_of_roles(self.read(f"{site}/key_role"))

    def check_rows(self, root: RootAttributes, site: str) -> None:
        """Raise `CorruptEpisode` when rows and masses of a site have another type or shape than the run says."""
        stored, bits = self.array(f"{site}/rows").metadata, root.recording.mantissa_bits
        if stored.is_half is not is_half(bits) or f"{site}/row_sum" in self.attributes.arrays:
            raise CorruptEpisode(
                f"Array {site}/rows of episode {self.name} has an earlier form ({stored.dtype.name}); expected "
                f"{'float16' if is_half(bits) else 'float32'}, and its sums behind {site}/atoms. A store of before 30 "
                "November 2026 is brought up to date by: python scripts/convert_store.py STORE (in the repository)."
            )
        segments = len(self.attributes.segments.get(site, ()))
        shapes = site_shapes(root.site(site), root.recording_of(site), self.attributes.num_replans, segments)
        for name in (f"{site}/rows", f"{site}/atoms"):
            for problem in shape_problems(name, self.shape_of(name), shapes[name]):
                raise CorruptEpisode(f"Episode {self.name} cannot be read: {problem}.", f"{name}/zarr.json")

    def tokens(self, root: RootAttributes, site: str) -> EpisodeTokens:
        """What every key of a site is in this episode."""
        self.check_rows(root, site)
        layout = root.site(site)
        roles = self.read(f"{site}/key_role")
        same = bool((roles == roles[:1]).all())
        return EpisodeTokens(
            layout=layout,
            # In memory once where all replans have the same, which are 50 kB an episode.
            key_role=np.broadcast_to(roles[0].copy(), roles.shape) if len(roles) and same else roles,
            prompts=self.prompts(root, site),
            prompt_index=self.read("prompt_index"),
            objects=self.attributes.objects,
            coverage=self.coverage(root, site),
            border=border_of_keys(layout, self.attributes.shown),
        )

    def prompts(self, root: RootAttributes, site: str) -> tuple[Prompt, ...]:
        """The different prompts of the episode, as the keys of a site; none where the site reads no text."""
        layout = root.site(site)
        # A prompt's pieces are keys of the site that reads it; elsewhere (Cosmos's self-attention) there are no words.
        reads = any(span.kind == "text" for span in layout.spans)
        return tuple(prompt_at(root.sites, layout, prompt) for prompt in self.attributes.prompts) if reads else ()

    def coverage(self, root: RootAttributes, site: str) -> Mapping[str, NDArray[np.float32]]:
        """Object coverage (replan, patch, object) by camera of a site; of each camera read when it is asked for."""
        stored = [name.removeprefix("objects/") for name in self.attributes.arrays if name.startswith("objects/")]
        return _StoredCoverage(self, [camera for camera in stored if camera in root.site(site).pictured])


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
    """A store opened for reading: its run, and the episodes that were committed when it was opened.

    Attributes:
        run: the digest of the run's configuration.
        notes: what lies among the episodes and is not read, a sentence each; opening the store says them as `Note`.
    """

    path: StorePlace
    attributes: RootAttributes
    run: str
    episodes: tuple[StoredEpisode, ...]
    notes: tuple[str, ...] = ()

    def __reduce__(self) -> tuple[object, ...]:
        """A pickle is without the episodes: it travels with each of them, of which there may be thousands."""
        return Store, (_from_anywhere(self.path), self.attributes, self.run, ())

    @property
    def suite(self) -> str:
        """The task suite of the run."""
        return self.attributes.protocol.suite

    @property
    def outcomes(self) -> dict[str, LaterOutcome]:
        """What was told of episodes after the recording, by their names."""
        return {one.name: one.outcome for one in self.episodes if one.outcome is not None}

    @property
    def task_ids(self) -> tuple[int, ...]:
        """Ids of the tasks that have at least one episode."""
        return tuple(sorted({parse_episode_name(episode.name)[0] for episode in self.episodes}))


def _from_anywhere(place: StorePlace) -> StorePlace:
    return place.absolute() if isinstance(place, Path) else place


def open_store(path: str | StorePlace, *, as_recorded: bool = False) -> Store:
    """Open a store for reading, at a path or an address; its episodes are in the order of task id and episode index.

    What is on the hub is read at one commit, which is in the `path` of the opened store. as_recorded: without outcomes
    that were told later.
    What lies among the episodes and is none is named in a `Note` and ignored.

    Raises:
        StoreNotFound: nothing is there; the error lists the stores nearby.
        StoreError: something else is there, or its attributes cannot be read.
        FormatTooNew: a later version wrote it.
    """
    path = at_commit(store_place(path))
    root, run = read_run(path)
    folders, strays = list_episodes(path)
    notes = []
    if strays:
        notes.append(
            f"Ignored in {path}, among its episodes: {visible(listing(strays))}; they are no episodes. Move them out "
            "of the store."
        )
    if unlisted := unlisted_episodes(path, {folder.name for folder in folders}):
        notes.append(
            f"Ignored in {path}: {listing(unlisted, 4)}, which its {NAMES_FILE} does not list. If they belong to it, "
            "upload a new copy, whose list has them."
        )
    for note in notes:
        warnings.warn(note, Note, stacklevel=2)
    folders.sort(key=lambda folder: parse_episode_name(folder.name))
    told = {} if as_recorded else read_outcomes(path)
    episodes = tuple(StoredEpisode(folder, folder.name, run, told.get(folder.name)) for folder in folders)
    return Store(path, root, run, episodes, tuple(notes))


def _holds_missing(values: NDArray[Any]) -> bool:
    """Whether floats or signed integers contain the fill value that zarr gives for a missing chunk."""
    if values.dtype.kind == "i":
        return bool((values == -1).any())
    if values.dtype.kind != "f":
        return False
    # One pass without a temporary array: rows are large. Squares do not cancel each other, so that their sum is NaN for
    # NaN alone.
    flat = values.reshape(-1)
    with np.errstate(over="ignore"):  # a sum that becomes infinite is no NaN
        return bool(np.isnan(np.dot(flat, flat)))
