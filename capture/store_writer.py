"""Writing a store: the run's root, and episodes that appear whole or not at all.

An episode is written into a folder beside the store, read back, flushed to disk and then renamed into place. Whatever
kills the process in between leaves the store as it was.
"""

from __future__ import annotations

import errno
import hashlib
import os
import shutil
import socket
import uuid
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, NoReturn

import numpy as np
import zarr
from numpy.typing import NDArray

from capture.attention import RecordedRows
from capture.store_arrays import create_blocked, replans_per_block, write_whole
from schemas.digest import ArrayDigest
from schemas.errors import BadArgument, UserError
from schemas.jsonable import MalformedDocument, from_json, to_json
from schemas.layout import Prompt, SiteLayout
from schemas.precision import round_mantissa
from schemas.segments import Segment, merge_segments, segment_masses, segment_members, segments_of
from schemas.store import (
    ATOM_AXES,
    CONTRIBUTION_AXES,
    EPISODES_GROUP,
    PARTIAL_SUFFIX,
    ROW_AXES,
    STORE_SUFFIX,
    ArrayRecord,
    CorruptEpisode,
    EpisodeAttributes,
    RootAttributes,
    RunMismatch,
    StoreError,
    StoreExists,
    check_format,
    episode_name,
    parse_episode_name,
)
from schemas.vocabulary import SceneObject

WriteMode = Literal["new", "resume", "overwrite"]

#: The group of an episode whose attributes hold the sha256 of every `zarr.json` of the episode and of the store's own.
SEAL_GROUP = "seal"


class StoreWriteFailed(StoreError, OSError):
    """The operating system refused a write: the disk is full, a permission is missing, a device failed."""


@dataclass(frozen=True)
class ReplanRecord:
    """Everything stored about one replan.

    `rows` and `key_role` are per site. `state` is (state_dim,), `actions` (horizon, action_dim) as given to the environment,
    `frames` per policy camera (row, column, channel) uint8, `coverage` per policy camera (patch, object) float32.
    """

    env_step: int
    noise_seed: int
    rows: Mapping[str, RecordedRows]
    key_role: Mapping[str, NDArray[np.uint8]]
    prompt: Prompt
    state: NDArray[np.float64]
    actions: NDArray[np.float64]
    frames: Mapping[str, NDArray[np.uint8]] = field(default_factory=dict)
    coverage: Mapping[str, NDArray[np.float32]] = field(default_factory=dict)


@dataclass(frozen=True)
class EpisodeStart:
    """What is known of an episode before its first replan."""

    task_id: int
    task_name: str
    instruction: str
    episode_index: int
    initial_state_index: int
    initial_state_digest: str
    objects: tuple[SceneObject, ...]
    provenance: Mapping[str, str]


class RunStore:
    """A store opened for adding episodes. Any number of processes may hold one; each episode has one writer."""

    def __init__(self, path: Path, attributes: RootAttributes) -> None:
        self.path = path
        self.attributes = attributes

    @property
    def partial_folder(self) -> Path:
        """Where episodes are while they are written: beside the store, on the same file system."""
        return self.path.with_name(self.path.name + PARTIAL_SUFFIX)

    def committed(self) -> set[tuple[int, int]]:
        """(task id, episode index) of every complete episode."""
        return {parse_episode_name(folder.name) for folder in _episode_folders(self.path)}

    @contextmanager
    def episode(
        self, start: EpisodeStart, denoise_times: NDArray[np.float64], max_replans: int
    ) -> Iterator[EpisodeWriter]:
        """Write one episode; leaving the block without `commit` drops it."""
        name = episode_name(start.task_id, start.episode_index)
        folder = self.partial_folder / f"{name}-{_process_tag()}"
        try:
            with _naming_the_failure(f"episode {name} of {self.path}"):
                _make_partial(folder)
                writer = EpisodeWriter(self, folder, start, denoise_times, max_replans)
            yield writer
        finally:
            shutil.rmtree(folder, ignore_errors=True)
            _remove_if_empty(self.partial_folder)


def open_run(path: Path, attributes: RootAttributes, mode: WriteMode) -> RunStore:
    """Create a store, continue one, or replace one.

    Raises:
        StoreExists: something is at `path` and the mode is `new`.
        RunMismatch: the mode is `resume` and the existing run differs; the first differing field is named.
    """
    if path.suffix != STORE_SUFFIX:
        raise BadArgument(f"Cannot write a store at {path}: expected a name that ends with '{STORE_SUFFIX}'.")
    # Episodes are written beside the store itself: beside a link to it may be another file system.
    path = path.resolve() if path.is_symlink() else path
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.exists():
            if mode == "new":
                refuse_existing(path)
            existing = _read_root(path)
            if mode == "overwrite":
                _delete_store(path)
                existing = _create_root(path, attributes)
        else:
            existing = _create_root(path, attributes)
        check_same_run(path, existing, attributes)
        _remove_dead_partials(path)
    except OSError as error:
        if isinstance(error, UserError):
            raise
        raise BadArgument(f"Cannot write a store at {path}: {error.strerror or error}; give another --store.") from None
    return RunStore(path, existing)


def refuse_existing(path: Path) -> NoReturn:
    """Raise `StoreExists` for a store that is in the way (or `StoreError` when what is there is no store)."""
    _read_root(path)
    count = sum(entry.is_dir() for entry in (path / EPISODES_GROUP).iterdir())
    raise StoreExists(
        f"Store {path} exists already and holds {count} episodes; add --resume to continue it, "
        "--overwrite to delete it and begin again, or give another --store."
    )


def check_same_run(path: Path, existing: RootAttributes, wanted: RootAttributes) -> None:
    """Raise `RunMismatch` naming the first field of the run's identity that differs. Provenance may differ; it is kept per episode."""
    # Where the weights lie says nothing about what they are: the digest does.
    moved = replace(wanted, policy=replace(wanted.policy, checkpoint=existing.policy.checkpoint))
    for section in ("format_version", "policy", "protocol", "recording", "sites"):
        difference = _first_difference(to_json(getattr(existing, section)), to_json(getattr(moved, section)), section)
        if difference:
            where, old, new = difference
            raise RunMismatch(
                f"Cannot resume {path}: its {where} is {old!r}, this run's is {new!r}; use the same settings, or another --store."
            )


def _first_difference(old: object, new: object, where: str) -> tuple[str, object, object] | None:
    if isinstance(old, dict) and isinstance(new, dict):
        for key in [*old, *(key for key in new if key not in old)]:
            found = _first_difference(old.get(key), new.get(key), f"{where}.{key}")
            if found:
                return found
        return None
    if isinstance(old, list) and isinstance(new, list) and len(old) == len(new) and where.startswith("sites"):
        pairs = enumerate(zip(old, new, strict=True))
        return next((found for i, (a, b) in pairs if (found := _first_difference(a, b, f"{where}[{i}]"))), None)
    return None if old == new else (where, old, new)


def _episode_folders(path: Path) -> list[Path]:
    folder = path / EPISODES_GROUP
    if not folder.is_dir():
        raise StoreError(f"{path} cannot be used as a store: it has no group '{EPISODES_GROUP}'; give another --store.")
    return [entry for entry in folder.iterdir() if entry.is_dir()]


def _read_root(path: Path) -> RootAttributes:
    if not path.exists():
        raise StoreError(f"The store {path} has been removed.")
    if not (path / "zarr.json").is_file():
        raise StoreError(f"{path} exists and is not a store; give another --store.")
    try:
        attributes = dict(zarr.open_group(path, mode="r", use_consolidated=False).attrs)
    except (OSError, ValueError, KeyError) as error:
        raise StoreError(f"{path} cannot be read as a store: {error}; give another --store.") from None
    check_format(attributes, path)
    try:
        return from_json(RootAttributes, attributes)
    except MalformedDocument as error:
        raise StoreError(f"{path} has attributes that cannot be read: {error}") from None


def _create_root(path: Path, attributes: RootAttributes) -> RootAttributes:
    """Create an empty store in one step; returns what it says of itself, which another process may have written."""
    building = path.with_name(f"{path.name}{PARTIAL_SUFFIX}") / f"root-{_process_tag()}"
    try:
        _make_partial(building)
        root = zarr.create_group(building, zarr_format=3)
        root.update_attributes(to_json(attributes))
        root.create_group(EPISODES_GROUP)
        _flush_folder(building)
        building.rename(path)
        _flush_entry(path.parent)
    except OSError:
        # Another process of the same array job was first, unless there is nothing.
        if not path.exists():
            raise
    finally:
        shutil.rmtree(building, ignore_errors=True)
        _remove_if_empty(building.parent)
    return _read_root(path)


def _delete_store(path: Path) -> None:
    # Renamed first, so that a crash while deleting cannot leave half a store under the old name.
    doomed = path.with_name(f"{path.name}{PARTIAL_SUFFIX}") / f"deleted-{_process_tag()}"
    _make_partial(doomed)
    path.rename(doomed)
    shutil.rmtree(doomed)
    _remove_if_empty(doomed.parent)


class EpisodeWriter:
    """Collects replans; keeps at most one block of rows in memory and writes whole shards only."""

    def __init__(
        self, store: RunStore, folder: Path, start: EpisodeStart, denoise_times: NDArray[np.float64], max_replans: int
    ) -> None:
        self.store = store
        self.folder = folder
        self.start = start
        self.denoise_times = denoise_times
        self.name = episode_name(start.task_id, start.episode_index)
        self.what = f"episode {self.name} of {store.path}"
        self.group = zarr.create_group(folder, zarr_format=3)
        self.sites = {site.name: _SiteWriter(self, site, max_replans) for site in store.attributes.sites}
        self.prompts: dict[Prompt, int] = {}
        self.records: list[ReplanRecord] = []
        self.digests: dict[str, ArrayRecord] = {}

    def append(self, record: ReplanRecord) -> None:
        """Add the next replan.

        Raises:
            ValueError: the record does not fit the run or the replans before it, or holds numbers that are not finite.
            StoreWriteFailed: the disk is full, or refuses in another way.
        """
        self._check(record)
        with _naming_the_failure(self.what):
            for name, site in self.sites.items():
                site.append(record.rows[name], record.key_role[name])
        self.prompts.setdefault(record.prompt, len(self.prompts))
        # Rows are on their way to disk; the rest is small and waits for the end.
        self.records.append(replace(record, rows={}))

    def _check(self, record: ReplanRecord) -> None:
        first = self.records[0] if self.records else record
        for what in ("frames", "coverage"):
            given, expected = list(getattr(record, what)), list(getattr(first, what))
            if given != expected:
                raise ValueError(f"a replan has {what} of the cameras {given}, the first one of {expected}")
        numbers: dict[str, NDArray[Any]] = {"state": record.state, "actions": record.actions, **record.coverage}
        for what, values in numbers.items():
            if not np.isfinite(values).all():
                raise ValueError(f"the {what} of a replan are not all finite numbers")

    def commit(self, success: bool, num_steps: int) -> Path:
        """Finish, verify and publish the episode; returns its folder in the store.

        Raises:
            StoreExists: another writer has published the same episode meanwhile.
            RunMismatch: the store has been replaced by one of another run meanwhile.
            StoreWriteFailed: the disk is full, or refuses in another way.
        """
        with _naming_the_failure(self.what):
            self._check_store()
            for site in self.sites.values():
                site.finish()
            self._write_side_arrays()
            self.group.update_attributes(to_json(self._attributes(success, num_steps)))
            self._write_seal()
            self._read_back()
            _flush_folder(self.folder)
            return self._publish()

    def _attributes(self, success: bool, num_steps: int) -> EpisodeAttributes:
        return EpisodeAttributes(
            task_id=self.start.task_id,
            task_name=self.start.task_name,
            instruction=self.start.instruction,
            episode_index=self.start.episode_index,
            initial_state_index=self.start.initial_state_index,
            initial_state_digest=self.start.initial_state_digest,
            success=success,
            num_steps=num_steps,
            num_replans=len(self.records),
            prompts=tuple(self.prompts),
            segments={name: site.segments for name, site in self.sites.items()},
            objects=self.start.objects,
            provenance=dict(self.start.provenance),
            arrays=dict(sorted(self.digests.items())),
        )

    def _check_store(self) -> None:
        # Somebody may have overwritten the store with another run while this episode was rolled out.
        check_same_run(self.store.path, _read_root(self.store.path), self.store.attributes)

    def _publish(self) -> Path:
        self._check_store()
        target = self.store.path / EPISODES_GROUP / self.name
        try:
            self.folder.rename(target)
        except OSError:
            if not target.exists():
                raise
            raise StoreExists(f"Episode {target.name} of {self.store.path} was committed by another process.") from None
        _flush_entry(target.parent)
        return target

    def write(self, name: str, values: NDArray[np.generic], axes: tuple[str, ...]) -> None:
        """Write one complete array of the episode and note its digest."""
        write_whole(self.group, name, values, axes)
        digest = ArrayDigest()
        digest.update(values)
        self.digests[name] = ArrayRecord(values.shape, digest.hexdigest())

    def _write_side_arrays(self) -> None:
        records = self.records
        self.write("env_step", np.array([record.env_step for record in records], dtype=np.int32), ("replan",))
        self.write("noise_seed", np.array([record.noise_seed for record in records], dtype=np.int64), ("replan",))
        index = np.array([self.prompts[record.prompt] for record in records], dtype=np.int32)
        self.write("prompt_index", index, ("replan",))
        self.write("denoise_time", np.asarray(self.denoise_times, dtype=np.float32), ("denoise",))
        self.write("state", np.stack([record.state for record in records]), ("replan", "state_dim"))
        self.write("actions", np.stack([record.actions for record in records]), ("replan", "horizon", "action_dim"))
        for camera in records[0].frames:
            frames = np.stack([record.frames[camera] for record in records])
            self.write(f"frames/{camera}", frames, ("replan", "row", "column", "channel"))
        for camera in records[0].coverage:
            coverage = np.stack([record.coverage[camera] for record in records])
            self.write(f"objects/{camera}", coverage, ("replan", "patch", "object"))

    def _write_seal(self) -> None:
        """Note the digest of every piece of metadata: chunks have checksums, and JSON has none of its own."""
        files = sorted(self.folder.rglob("zarr.json"))
        digests = {file.relative_to(self.folder).as_posix(): _sha256(file) for file in files}
        attributes = {"run": _sha256(self.store.path / "zarr.json"), "files": digests}
        self.group.create_group(SEAL_GROUP, attributes=attributes)

    def _read_back(self) -> None:
        """Read every array from disk and hold it against what was written, block by block."""
        written = zarr.open_group(self.folder, mode="r", use_consolidated=False)
        for name, record in self.digests.items():
            array = written[name]
            assert isinstance(array, zarr.Array)
            digest = ArrayDigest()
            step = (array.shards or array.chunks)[0] if array.ndim else 1
            for first in range(0, array.shape[0], max(1, step)):
                try:
                    digest.update(np.asarray(array[first : first + step]))
                except ValueError as error:
                    raise CorruptEpisode(f"Array {name} cannot be read back from {self.folder}: {error}.") from None
            if tuple(array.shape) != record.shape or digest.hexdigest() != record.sha256:
                raise CorruptEpisode(f"Array {name} read back from {self.folder} differs from what was written.")


class _SiteWriter:
    """Rows, row sums and atoms of one site."""

    def __init__(self, episode: EpisodeWriter, layout: SiteLayout, max_replans: int) -> None:
        self.episode = episode
        self.layout = layout
        recording = episode.store.attributes.recording
        self.bits = recording.mantissa_bits
        queries = 1 if recording.queries == "mean" else recording.num_action_queries
        self.shape = (len(recording.layers), len(recording.denoise_steps), len(recording.heads), queries)
        self.bytes_per_replan = 4 * self.shape[2] * self.shape[3] * layout.num_keys
        self.block = replans_per_block(self.bytes_per_replan, max_replans)
        self.rows_array: zarr.Array | None = None
        self.rows_digest = ArrayDigest()
        self.pending: list[NDArray[np.float32]] = []
        self.num_written = 0
        self.row_sums: list[NDArray[np.float32]] = []
        self.roles: list[NDArray[np.uint8]] = []
        self.masses: list[tuple[tuple[Segment, ...], NDArray[np.float32]]] = []
        self.contributions: list[NDArray[np.float32]] = []
        self.segments: tuple[Segment, ...] = ()
        episode.group.create_group(layout.name)

    def append(self, recorded: RecordedRows, key_role: NDArray[np.uint8]) -> None:
        expected = (*self.shape, self.layout.num_keys)
        shapes = (recorded.rows.shape, recorded.row_sum.shape, key_role.shape)
        if shapes != (expected, self.shape, expected[-1:]):
            raise ValueError(
                f"site '{self.layout.name}' recorded rows, row sums and key roles of shapes {shapes}, expected {expected} and so on"
            )
        if not np.isfinite(recorded.rows).all() or (recorded.rows < 0).any():
            raise ValueError(
                f"site '{self.layout.name}' recorded rows that are not probabilities: negative or not finite"
            )
        segments = segments_of(self.layout, key_role)
        members = segment_members(self.layout, key_role[None], segments)[0]
        self._take_contribution(recorded.contribution, len(segments))
        # Atoms and sums come from the rows as computed, before rounding: what storage takes away stays known.
        self.masses.append((segments, segment_masses(recorded.rows, members)))
        self.row_sums.append(recorded.row_sum)
        self.roles.append(key_role)
        self.pending.append(round_mantissa(recorded.rows, self.bits))
        if len(self.pending) == self.block:
            self._flush()

    def _take_contribution(self, gram: NDArray[np.float32] | None, num_segments: int) -> None:
        wanted = self.episode.store.attributes.recording.contributions
        expected = (*self.shape[:2], num_segments + 1, num_segments + 1) if wanted else None
        if (None if gram is None else gram.shape) != expected:
            raise ValueError(
                f"site '{self.layout.name}' gave contributions {None if gram is None else gram.shape}, expected {expected}"
            )
        if gram is not None:
            if not np.isfinite(gram).all():
                raise ValueError(f"site '{self.layout.name}' gave contributions that are not all finite")
            self.contributions.append(gram)

    def _flush(self) -> None:
        rows = np.stack(self.pending)
        self.pending.clear()
        total = self.num_written + len(rows)
        if self.rows_array is None:
            block = replans_per_block(self.bytes_per_replan, min(len(rows), self.block))
            shape = (total, *rows.shape[1:])
            self.rows_array = create_blocked(self.episode.group, f"{self.layout.name}/rows", shape, block, ROW_AXES)
        else:
            self.rows_array.resize((total, *rows.shape[1:]))
        self.rows_array[self.num_written : total] = rows
        self.rows_digest.update(rows)
        self.num_written = total

    def finish(self) -> None:
        if self.pending:
            self._flush()
        if self.rows_array is None:
            raise ValueError("an episode without replans cannot be committed")
        name, episode = self.layout.name, self.episode
        episode.digests[f"{name}/rows"] = ArrayRecord(tuple(self.rows_array.shape), self.rows_digest.hexdigest())
        self.segments = merge_segments(self.layout, (segments for segments, _ in self.masses))
        column = {segment: i for i, segment in enumerate(self.segments)}
        atoms = np.zeros((self.num_written, *self.shape, len(self.segments)), dtype=np.float32)
        for replan, (segments, masses) in enumerate(self.masses):
            atoms[replan][..., [column[segment] for segment in segments]] = masses
        episode.write(f"{name}/atoms", atoms, ATOM_AXES)
        if self.contributions:
            self._write_contributions(column)
        episode.write(f"{name}/row_sum", np.stack(self.row_sums), ROW_AXES[:-1])
        episode.write(f"{name}/key_role", np.stack(self.roles), ("replan", "key"))
        recording = episode.store.attributes.recording
        for axis, numbers in (
            ("layer", recording.layers),
            ("denoise", recording.denoise_steps),
            ("head", recording.heads),
        ):
            episode.write(f"{name}/{axis}", np.array(numbers, dtype=np.int32), (axis,))

    def _write_contributions(self, column: dict[Segment, int]) -> None:
        size = len(column) + 1
        grams = np.zeros((self.num_written, *self.shape[:2], size, size), dtype=np.float32)
        for replan, ((segments, _), gram) in enumerate(zip(self.masses, self.contributions, strict=True)):
            # A segment that a replan does not have contributes nothing there; the update is the last part.
            at = [*(column[segment] for segment in segments), size - 1]
            grams[replan][..., np.ix_(at, at)[0], np.ix_(at, at)[1]] = gram
        self.episode.write(f"{self.layout.name}/contribution", grams, CONTRIBUTION_AXES)


def _process_tag() -> str:
    return f"{socket.gethostname()}-{os.getpid()}-{uuid.uuid4().hex[:8]}"


def _remove_dead_partials(store: Path) -> None:
    """Remove what killed processes of this machine left beside the store. Other machines' processes cannot be judged from here."""
    partial = store.with_name(store.name + PARTIAL_SUFFIX)
    for folder in partial.glob("*"):
        host, _, process = folder.name.partition("-")[2].rpartition("-")[0].rpartition("-")
        if host == socket.gethostname() and process.isdigit() and not _is_running(int(process)):
            shutil.rmtree(folder, ignore_errors=True)
    _remove_if_empty(partial)


def _is_running(process: int) -> bool:
    try:
        os.kill(process, 0)  # signal 0 asks, and does nothing
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


@contextmanager
def _naming_the_failure(what: str) -> Iterator[None]:
    """Turn an error of the operating system into one sentence that says what was being written."""
    try:
        yield
    except OSError as error:
        if isinstance(error, UserError):
            raise
        raise StoreWriteFailed(
            f"Cannot write {what}: {error.strerror or error}. Nothing of this episode was kept, and the episodes before it are "
            "unharmed; remove the cause and go on with --resume."
        ) from error


def _make_partial(folder: Path) -> None:
    """Create a folder for what is being written; another process may be removing the (empty) parent at this moment."""
    while True:
        folder.parent.mkdir(exist_ok=True)
        try:
            folder.mkdir()
        except FileNotFoundError:
            continue
        return


def _remove_if_empty(folder: Path) -> None:
    try:
        folder.rmdir()
    except OSError:
        return  # another writer's episode is in it, or it is gone


def _flush_folder(folder: Path) -> None:
    """Force every file and directory below `folder` to disk: a rename must not become durable before its content."""
    for parent, _, files in os.walk(folder):
        for file in files:
            _flush_entry(Path(parent) / file)
        _flush_entry(Path(parent))


def _flush_entry(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    except OSError as error:
        # Some network file systems cannot flush directories; they have nothing to offer instead.
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):
            raise
    finally:
        os.close(handle)


def _sha256(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()


__all__ = [
    "EpisodeStart",
    "EpisodeWriter",
    "ReplanRecord",
    "RunStore",
    "StoreWriteFailed",
    "check_same_run",
    "open_run",
    "refuse_existing",
]
