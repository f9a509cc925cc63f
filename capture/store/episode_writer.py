"""Writing one episode: it is written into a folder in `.writing`, sealed, read back, and renamed into place."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import zarr
from numpy.typing import NDArray

from vla_attention.capture.store.codecs import write_whole
from vla_attention.capture.store.replan_records import EpisodeStart, RecordedSteps, ReplanRecord
from vla_attention.capture.store.site_writer import SiteWriter
from vla_attention.capture.store.store_root import check_same_run, read_existing_root
from vla_attention.schemas.effects import CHANGE, CUT, EpisodeEffects
from vla_attention.schemas.errors import UserError, listing
from vla_attention.schemas.jsonable import to_json
from vla_attention.schemas.layout import Prompt, prompt_at
from vla_attention.schemas.stores.content_rules import (
    camera_picture_problems,
    counter_problems,
    coverage_problems,
    cut_problems,
    effect_problems,
    picture_problems,
    prompt_problems,
    sites_with_text,
)
from vla_attention.schemas.stores.digest import ArrayDigest
from vla_attention.schemas.stores.durable_files import publish
from vla_attention.schemas.stores.episode_checks import content_problems
from vla_attention.schemas.stores.locks import Locks
from vla_attention.schemas.stores.reader import StoredEpisode
from vla_attention.schemas.stores.root import read_run
from vla_attention.schemas.stores.seal import seal_episode
from vla_attention.schemas.stores.store_format import (
    EPISODES_GROUP,
    ArrayRecord,
    CorruptEpisode,
    EpisodeAttributes,
    RootAttributes,
    StoreError,
    StoreExists,
    episode_name,
)
from vla_attention.schemas.stores.store_place import why_refused


class StoreWriteFailed(StoreError, OSError):
    """The operating system refused a write: the disk is full, a permission is missing, a device failed."""


@contextmanager
def naming_the_failure(what: str, place: Path) -> Iterator[None]:
    """Turn an error of the operating system into one sentence with what was being written. place: the store's."""
    try:
        yield
    except OSError as error:
        if isinstance(error, UserError):
            raise
        raise StoreWriteFailed(
            f"Cannot write {what}: {why_refused(error, place)}. Nothing of this episode was kept, and the episodes "
            "before it are unharmed; remove the cause and go on with --resume."
        ) from error


#: What an episode's provenance calls the cameras whose picture is of one colour at every replan.
CONSTANT_CAMERAS = "constant_cameras"


class ReplanRefused(StoreError):
    """A replan whose numbers cannot be right; nothing of it is added to the episode."""


class EpisodeTaken(StoreExists):
    """Another process took an episode over, because this one seemed to have ended."""


class EpisodeWriter:
    """Collects replans; has at most one block of rows in memory and writes whole shards only."""

    def __init__(
        self,
        store: Path,
        run: RootAttributes,
        folder: Path,
        start: EpisodeStart,
        denoise_times: NDArray[np.float64],
        locks: Locks,
        durable: bool,
    ) -> None:
        self.store = store
        self.run = run
        self.folder = folder
        self.start = start
        self.denoise_times = denoise_times
        self.locks = locks
        self.durable = durable
        self.name = episode_name(start.task_id, start.episode_index)
        self.what = f"episode {self.name} of {store}"
        self.group = zarr.create_group(folder, zarr_format=3)
        self.digests: dict[str, ArrayRecord] = {}
        self.sites = {
            site.name: SiteWriter(self.group, folder, self.write, site, run.recording.of_site(site))
            for site in run.sites
        }
        self.prompts: dict[Prompt, int] = {}
        self.records: list[ReplanRecord] = []

    def append(self, record: ReplanRecord) -> None:
        """Add the next replan, or none of it.

        Raises:
            ReplanRefused: the record does not fit the run or the replans before it, or breaks a rule of `verify`.
            StoreWriteFailed: the disk is full, or refuses in another way.
            EpisodeTaken: as for `commit`.
        """
        for problem in self._problems(record):
            raise ReplanRefused(
                f"Cannot store replan {len(self.records)} (environment step {record.env_step}) of {self.what}: "
                f"{problem}."
            )
        with self._as_its_holder():
            for name, site in self.sites.items():
                site.append(record.rows[name], record.key_role[name])
        self.prompts.setdefault(record.prompt, len(self.prompts))
        # The site writers have the rows; the rest is small and is written at the end.
        self.records.append(replace(record, rows={}))

    def _problems(self, record: ReplanRecord) -> Iterator[str]:
        """What forbids adding a replan."""
        replan, sites = len(self.records), self.run.sites
        for what, given in (("rows", record.rows), ("key roles", record.key_role)):
            if set(given) != set(self.sites):
                yield f"it has {what} of the sites {listing(given)}; expected {listing(self.sites)}"
                return
        yield from self._misfits(record)
        only_site = len(sites_with_text(sites)) == 1
        for name, site in self.sites.items():
            prompt = prompt_at(sites, site.layout, record.prompt)
            yield from site.problems(record.rows[name], record.key_role[name], prompt, replan, only_site=only_site)
        if record.prompt not in self.prompts:
            yield from prompt_problems(sites, record.prompt)
        for camera, frame in record.frames.items():
            yield from picture_problems(sites, camera, frame.shape, frame.dtype)
        for camera, frame in record.camera_frames.items():
            yield from camera_picture_problems(sites, camera, frame.shape, frame.dtype)
        for camera, coverage in record.coverage.items():
            yield from coverage_problems(sites, camera, coverage[None], len(self.start.objects), replan)
        yield from self._effect_problems(record, replan)
        steps = [*(earlier.env_step for earlier in self.records[-1:]), record.env_step]
        seeds = [] if record.noise_seed is None else [record.noise_seed]
        yield from counter_problems(np.array(steps), np.array(seeds, dtype=np.int64))

    def _effect_problems(self, record: ReplanRecord, replan: int) -> Iterator[str]:
        """Effects at the replans that the run says, of the conditions that the episode has."""
        planned, given = self.run.recording.effects, record.effects
        wanted = planned is not None and replan % planned.every == 0
        if wanted is not (given is not None):
            yield f"it has {'no ' if wanted else ''}effects, other than the run says"
        if given is None:
            return
        first = next((earlier.effects for earlier in self.records if earlier.effects is not None), given)
        if (given.conditions, given.units) != (first.conditions, first.units):
            yield "its effects are of other conditions, or in other units, than those of the replans before it"
        horizon = self.run.policy.action_horizon if record.actions is None else len(record.actions)
        shapes: dict[str, tuple[NDArray[np.float32], tuple[int, ...]]]
        shapes = {CHANGE: (given.change, (horizon, len(given.units)))}
        shapes |= {f"{name}/{CUT}": (given.cut[name], (site.layout.num_keys,)) for name, site in self.sites.items()}
        for name, (values, rest) in shapes.items():
            expected = (len(given.measured), *rest)
            if (values.shape, values.dtype) != (expected, np.dtype(np.float32)):
                yield f"{name} has the shape {values.shape} and type {values.dtype}; expected {expected} and float32"
            else:
                yield from (effect_problems if name == CHANGE else cut_problems)(name, values)

    def _misfits(self, record: ReplanRecord) -> Iterator[str]:
        """Where a replan differs in form from the first one, so that their arrays could not be stacked."""
        first = self.records[0] if self.records else record
        for what in ("frames", "camera_frames", "coverage"):
            given, expected = list(getattr(record, what)), list(getattr(first, what))
            if given != expected:
                yield f"it has {what} of the cameras {listing(given)}, the first replan of {listing(expected)}"
        for what in ("noise_seed", "state", "actions", "dataset_actions", "base_actions"):
            values, before = getattr(record, what), getattr(first, what)
            if (values is None) is not (before is None):
                yield f"it has {'no' if values is None else 'a'} {what}, other than the first replan"
            if values is None or before is None or what == "noise_seed":
                continue
            # A data set may have fewer actions at the end of its episode.
            axes = slice(1, None) if what == "dataset_actions" else slice(None)
            if values.shape[axes] != before.shape[axes] or values.ndim != before.ndim:
                yield f"{what} has the shape {values.shape}; that of the first replan is {before.shape}"
            if what == "dataset_actions" and (values.ndim != 2 or not len(values)):
                yield f"{what} has the shape {values.shape}; expected (steps, action_dim) with at least one step"
            if not np.isfinite(values).all():
                yield f"{what} holds numbers that are NaN or infinite"

    def commit(self, success: bool | None, num_steps: int, steps: RecordedSteps | None = None) -> Path:
        """Finish, verify and publish the episode; returns its folder in the store.

        success: None where nobody knows it. num_steps: 0 where it is not known. steps: None where no simulator of ours
        told them.

        Raises:
            StoreExists: another writer has published the same episode meanwhile.
            EpisodeTaken: this process stood still for so long that another one has taken the episode.
            RunMismatch: the store has been replaced by one of another run meanwhile.
            StoreWriteFailed: the disk is full, or refuses in another way.
        """
        with self._as_its_holder():
            self._check_store()
            self._check_lock()
            for site in self.sites.values():
                self.digests |= site.finish()
            self._write_side_arrays()
            for name, (values, axes) in ({} if steps is None else steps.arrays).items():
                self.write(name, values, axes)
            self.group.update_attributes(to_json(self._attributes(success, num_steps, steps)))
            run = read_run(self.store)[1]
            seal_episode(self.folder, self.name, run)
            self._read_back(run)
            return self._publish()

    def _attributes(self, success: bool | None, num_steps: int, steps: RecordedSteps | None) -> EpisodeAttributes:
        records = self.records
        constant = frozenset.intersection(*(record.constant_cameras for record in records))
        facts = {CONSTANT_CAMERAS: ", ".join(sorted(constant))} if constant else {}
        return EpisodeAttributes(
            **vars(replace(self.start, provenance=self.start.provenance | facts)),
            success=success,
            num_steps=num_steps,
            num_replans=len(records),
            prompts=tuple(self.prompts),
            segments={name: site.segments for name, site in self.sites.items()},
            arrays=dict(sorted(self.digests.items())),
            env_step=tuple(int(record.env_step) for record in records),
            prompt_index=tuple(self.prompts[record.prompt] for record in records),
            noise_seed=tuple(int(record.noise_seed) for record in records if record.noise_seed is not None),
            dataset_action_count=tuple(len(r.dataset_actions) for r in records if r.dataset_actions is not None),
            denoise_time=tuple(float(time) for time in self.denoise_times),
            effects=self._effects(),
            steps=None if steps is None else steps.attributes,
        )

    @contextmanager
    def _as_its_holder(self) -> Iterator[None]:
        """Name failures; those of a process whose files another one has removed are no failures of the disk."""
        with naming_the_failure(self.what, self.store):
            try:
                yield
            except (OSError, CorruptEpisode) as error:
                if not isinstance(error, StoreExists) and self.store.exists():
                    self._check_lock()
                raise

    def _check_lock(self) -> None:
        if self.locks.holds(self.name):
            return
        self._refuse_committed()
        raise EpisodeTaken(
            f"Episode {self.name} of {self.store} was taken over by another process, because this one stood still."
        )

    def _refuse_committed(self) -> None:
        if (self.store / EPISODES_GROUP / self.name).exists():
            raise StoreExists(f"Episode {self.name} of {self.store} was committed by another process.")

    def _check_store(self) -> None:
        # Somebody may have removed the store, or replaced it by another run's, while this episode was rolled out.
        if not self.store.exists():
            raise StoreError(f"The store {self.store} has been removed.")
        check_same_run(self.store, read_existing_root(self.store), self.run)

    def _publish(self) -> Path:
        self._check_store()
        target = self.store / EPISODES_GROUP / self.name
        try:
            publish(self.folder, target, self.durable)
        except OSError:
            self._refuse_committed()
            raise
        return target

    def write(self, name: str, values: NDArray[np.generic], axes: tuple[str, ...]) -> None:
        """Write one complete array of the episode and note its digest."""
        write_whole(self.group, name, values, axes)
        digest = ArrayDigest()
        digest.update(values)
        self.digests[name] = ArrayRecord(values.shape, digest.hexdigest())

    def _write_side_arrays(self) -> None:
        records, action_axes = self.records, ("replan", "horizon", "action_dim")
        for name, axes in (("state", ("replan", "state_dim")), ("actions", action_axes), ("base_actions", action_axes)):
            known = [values for record in records if (values := getattr(record, name)) is not None]
            if known:
                self.write(name, np.stack(known), axes)
        self._write_effects()
        self._write_dataset_actions([r.dataset_actions for r in records if r.dataset_actions is not None])
        pixels = ("replan", "row", "column", "channel")
        for what, group, names in (
            ("frames", "frames", pixels),
            ("camera_frames", "camera_frames", pixels),
            ("coverage", "objects", ("replan", "patch", "object")),
        ):
            for camera in getattr(records[0], what):
                self.write(f"{group}/{camera}", np.stack([getattr(record, what)[camera] for record in records]), names)

    def _effects(self) -> EpisodeEffects | None:
        """What the arrays of effects are of."""
        if self.run.recording.effects is None:
            return None
        measured = [(replan, of) for replan, record in enumerate(self.records) if (of := record.effects) is not None]
        first = measured[0][1]
        entries = [(replan, number) for replan, of in measured for number in of.measured]
        return EpisodeEffects(
            first.conditions,
            first.units,
            tuple(replan for replan, _ in entries),
            tuple(number for _, number in entries),
        )

    def _write_effects(self) -> None:
        measured = [record.effects for record in self.records if record.effects is not None]
        if not any(of.measured for of in measured):
            return
        self.write(CHANGE, np.concatenate([of.change for of in measured]), ("entry", "horizon", "action_dim"))
        for site in self.run.sites:
            cut = np.concatenate([of.cut[site.name] for of in measured])
            self.write(f"{site.name}/{CUT}", cut, ("entry", "key"))

    def _write_dataset_actions(self, actions: Sequence[NDArray[np.float64]]) -> None:
        if not actions:
            return
        stacked = np.zeros((len(actions), max(map(len, actions)), actions[0].shape[1]))
        for replan, steps in enumerate(actions):
            stacked[replan, : len(steps)] = steps
        self.write("dataset_actions", stacked, ("replan", "horizon", "action_dim"))

    def _read_back(self, run: str) -> None:
        """Read everything back from disk, with the checks of `vla-attention store verify`."""
        for problem in content_problems(self.run, StoredEpisode(self.folder, self.name, run)):
            raise CorruptEpisode(f"Episode {self.name}, read back from {self.folder}, is damaged: {problem.text}.")
