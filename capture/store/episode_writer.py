"""Writing one episode: it is written into a folder in `.writing`, sealed, read back, and renamed into place."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from msgspec import structs
from numpy.typing import NDArray

from vla_attention.capture.store.codecs import write_whole
from vla_attention.capture.store.growing_arrays import GrowingArray
from vla_attention.capture.store.replan_records import (
    CHUNK_AXES,
    EpisodeStart,
    RecordedSteps,
    ReplanMap,
    ReplanRecord,
)
from vla_attention.capture.store.site_writer import SiteWriter
from vla_attention.capture.store.store_root import check_same_run, read_existing_root
from vla_attention.capture.store.unpublished import UnpublishedFolder
from vla_attention.schemas.effects import EffectMap, EpisodeEffects
from vla_attention.schemas.errors import UserError, listing
from vla_attention.schemas.jsonable import to_json
from vla_attention.schemas.layout import Prompt
from vla_attention.schemas.precision import FLOAT32_MANTISSA_BITS
from vla_attention.schemas.segments import segments_of
from vla_attention.schemas.stores.content_rules import (
    Block,
    counter_problems,
    effect_shapes,
    map_shapes,
    piece_role_problems,
    prompt_problems,
    shape_problems,
    site_shapes,
    value_problems,
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
    StoreNotFound,
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
        _check_exists(place)
        raise StoreWriteFailed(
            f"Cannot write {what}: {why_refused(error, place)}. Nothing of this episode was kept, and the episodes "
            "before it are unharmed; remove the cause and go on with --resume."
        ) from error


def _check_exists(store: Path) -> None:
    if not store.exists():
        raise StoreNotFound(
            f"The store {store} was moved or deleted while an episode was written, of which nothing was kept. "
            "Put it back and go on with --resume, or begin a new one."
        )


#: What an episode's provenance calls the cameras whose picture is of one colour at every replan.
CONSTANT_CAMERAS = "constant_cameras"


class ReplanRefused(StoreError):
    """A replan whose numbers cannot be right; nothing of it is added to the episode."""


class EpisodeTaken(StoreExists):
    """Another process took an episode over, because this one seemed to have ended."""


class EpisodeWriter:
    """Writes the replans of an episode as they come: what is in memory does not grow with their number."""

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
        # The rules are for rows as computed; they are rounded after that.
        exact = structs.replace(run.recording, mantissa_bits=FLOAT32_MANTISSA_BITS)
        self.run_as_computed = structs.replace(run, recording=exact)
        self.folder = folder
        self.start = start
        self.denoise_times = denoise_times
        self.locks = locks
        self.durable = durable
        self.name = episode_name(start.task_id, start.episode_index)
        self.what = f"episode {self.name} of {store}"
        self.digests: dict[str, ArrayRecord] = {}
        with self._as_its_holder():
            self.group = zarr.create_group(UnpublishedFolder(folder), zarr_format=3)
            self.sites = {
                site.name: SiteWriter(self.group, folder, site, run.recording.of_site(site)) for site in run.sites
            }
        self.prompts: dict[Prompt, int] = {}
        #: Of the replans, without what is written.
        self.records: list[ReplanRecord] = []
        #: Whether a part of a replan was written and the rest was not.
        self._broken = False
        self._shapes: dict[str, tuple[int, ...]] = {}
        self._growing: dict[str, GrowingArray] = {}
        #: (1, step, action_dim) of each replan, as many steps as the data set has from there on.
        self._dataset_actions: list[NDArray[np.float64]] = []

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
        with self._as_its_holder(), self._wholly():
            for name, site in self.sites.items():
                site.append(record.rows[name], record.key_role[name])
            for name, (values, axes) in record.arrays.items():
                if name == "dataset_actions":
                    self._dataset_actions.append(values)
                    continue
                if name not in self._growing:
                    self._growing[name] = GrowingArray(self.group, self.folder, name, axes)
                self._growing[name].append(values)
        self.prompts.setdefault(record.prompt, len(self.prompts))
        self._shapes = self._shapes or _shapes_of_replan(record)
        self.records.append(self._without_arrays(record))

    @contextmanager
    def _wholly(self) -> Iterator[None]:
        """Refuse every further replan, and the end of the episode, if what is written in the block fails."""
        if self._broken:
            raise StoreWriteFailed(f"A replan of {self.what} was not written wholly; nothing can be added to it.")
        self._broken = True
        yield
        self._broken = False

    def close(self) -> None:
        """Give back what waits on the disk; called once, whether or not the episode was committed."""
        for site in self.sites.values():
            site.close()

    def _without_arrays(self, record: ReplanRecord) -> ReplanRecord:
        """The facts of a replan alone; conditions of effects are those of the replans before it."""
        effects = record.effects
        if effects is not None:
            before = (self.records[0].effects if self.records else None) or effects
            empty = np.zeros((0, 0, 0), dtype=np.float32)
            no_map = effects.map and replace(effects.map, sizes=empty.ravel(), change=empty)
            effects = replace(
                effects, conditions=before.conditions, items=before.items, change=empty, cut={}, map=no_map
            )
        return replace(
            record, rows={}, key_role={}, state=None, actions=None, frames={}, camera_frames={}, coverage={},
            dataset_actions=None, base_actions=None, effects=effects,
        )  # fmt: skip

    def _problems(self, record: ReplanRecord) -> Iterator[str]:
        """What forbids adding a replan. The first sentence counts: later ones may rest on what it says is broken."""
        replan, sites, effects = len(self.records), self.run.sites, record.effects
        cut = dict.fromkeys(self.sites) if effects is None else effects.cut
        for what, given in (("rows", record.rows), ("key roles", record.key_role), ("effects", cut)):
            if set(given) != set(self.sites):
                yield f"it has {what} of the sites {listing(given)}; expected {listing(self.sites)}"
        for name, site in self.sites.items():
            roles = record.key_role[name]
            shapes = site_shapes(site.layout, site.recording, 1, 0)
            yield from self._broken_rules({f"{name}/key_role": roles[None]}, shapes)
            yield from piece_role_problems(sites, site.layout, roles, record.prompt, replan)
            shapes = site_shapes(site.layout, site.recording, 1, len(segments_of(site.layout, roles)))
            shapes[f"{name}/row_sum"] = shapes[f"{name}/rows"][:-1]
            arrays, gram = site.arrays(record.rows[name], roles), f"{name}/contribution"
            if (gram in shapes) is not (gram in arrays):
                yield f"it has {'no' if gram in shapes else 'an unplanned'} {gram}"
            yield from self._broken_rules(arrays, shapes)
        if record.prompt not in self.prompts:
            yield from prompt_problems(sites, record.prompt)
        shapes = {}
        if effects is not None:
            horizon = self.run.policy.action_horizon if record.actions is None else len(record.actions)
            shapes = effect_shapes(sites, len(effects.measured), horizon, len(effects.units))
            if effects.map is not None:
                shapes |= map_shapes(_map_of([(replan, effects.map)]), horizon, len(effects.units))
        yield from self._broken_rules({name: values for name, (values, _) in record.arrays.items()}, shapes)
        yield from self._misfits(record)
        steps = [*(earlier.env_step for earlier in self.records[-1:]), record.env_step]
        seeds = [] if record.noise_seed is None else [record.noise_seed]
        yield from counter_problems(np.array(steps), np.array(seeds, dtype=np.int64))

    def _broken_rules(self, arrays: Mapping[str, NDArray[Any]], shapes: Mapping[str, tuple[int, ...]]) -> Iterator[str]:
        """What is wrong with arrays of the next replan; `shapes` has those that are known in advance."""
        num_objects, replan = len(self.start.objects), len(self.records)
        for name, values in arrays.items():
            yield from shape_problems(name, values.shape, shapes.get(name, values.shape))
            beside = arrays.__getitem__
            yield from value_problems(Block(self.run_as_computed, num_objects, name, values, beside, replan))

    def _misfits(self, record: ReplanRecord) -> Iterator[str]:
        """Where a replan differs in form from the run's plan or the first one, so that arrays could not be stacked."""
        first = self.records[0] if self.records else record
        if record.shown != first.shown:
            yield f"its pictures show the parts {dict(record.shown)} of their frames, and before {dict(first.shown)}"
        given = _shapes_of_replan(record)
        before = self._shapes or given
        for name in sorted(given.keys() | before.keys()):
            here, there = (f"of the shape {of[name]}" if name in of else "not given" for of in (given, before))
            if here != there:
                yield f"{name} is {here}, at the first replan {there}"
        for name, (values, axes) in record.arrays.items():
            if values.ndim != len(axes) or (name == "dataset_actions" and not values.shape[1]):
                yield f"{name} has the shape {values.shape[1:]}; expected {listing(axes[1:])}, of at least one step"
        planned, effects = self.run.recording.effects, record.effects
        wanted = planned is not None and len(self.records) % planned.every == 0
        if wanted is not (effects is not None):
            yield f"it has {'no ' if wanted else ''}effects, other than the run says"
        earlier = first.effects  # a run that measures effects does so at the first replan
        if effects and effects.map and planned and "map" not in planned.items:
            yield "it has a map of patches, other than the run says"
        if effects and effects.map and earlier and earlier.map and effects.map.form != earlier.map.form:
            yield "its map is of other patches, or made in another way, than those of the replans before it"
        if effects and earlier and (effects.conditions, effects.units) != (earlier.conditions, earlier.units):
            yield "its effects are of other conditions, or in other units, than those of the replans before it"

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
        with self._as_its_holder(), self._wholly():
            self._check_store()
            self._check_lock()
            for site in self.sites.values():
                self.digests |= site.finish()
            self.digests |= {name: array.finish() for name, array in self._growing.items()}
            if self._dataset_actions:
                longest = max(values.shape[1] for values in self._dataset_actions)
                filled = [np.pad(of, ((0, 0), (0, longest - of.shape[1]), (0, 0))) for of in self._dataset_actions]
                self.write("dataset_actions", np.concatenate(filled), CHUNK_AXES)
            for name, (values, axes) in ({} if steps is None else steps.arrays).items():
                self.write(name, values, axes)
            self.group.update_attributes(to_json(self._attributes(success, num_steps, steps)))
            run = read_run(self.store)[1]
            seal_episode(self.folder, self.name, run)
            self._read_back(run)
            self._check_store()
            target = self.store / EPISODES_GROUP / self.name
            try:
                publish(self.folder, target, self.durable)
            except OSError:
                self._refuse_committed()
                raise
            return target

    def _attributes(self, success: bool | None, num_steps: int, steps: RecordedSteps | None) -> EpisodeAttributes:
        records = self.records
        constant = frozenset.intersection(*(record.constant_cameras for record in records))
        facts = {CONSTANT_CAMERAS: ", ".join(sorted(constant))} if constant else {}
        measured = [(replan, of) for replan, record in enumerate(records) if (of := record.effects) is not None]
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
            dataset_action_count=tuple(values.shape[1] for values in self._dataset_actions),
            denoise_time=tuple(float(time) for time in self.denoise_times),
            effects=None
            if not measured
            else EpisodeEffects(
                measured[0][1].conditions,
                measured[0][1].items,
                measured[0][1].units,
                tuple(replan for replan, of in measured for _ in of.measured),
                tuple(number for _, of in measured for number in of.measured),
                measured[0][1].silent_blocks,
                _map_of(maps)
                if (maps := [(replan, of.map) for replan, of in measured if of.map is not None])
                else None,
            ),
            steps=None if steps is None else steps.attributes,
            plumbing=next((record.plumbing for record in records if record.plumbing is not None), None),
            shown=dict(records[0].shown),
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
        _check_exists(self.store)
        check_same_run(self.store, read_existing_root(self.store), self.run)

    def write(self, name: str, values: NDArray[np.generic], axes: tuple[str, ...]) -> None:
        """Write one complete array of the episode and note its digest."""
        write_whole(self.group, name, values, axes)
        digest = ArrayDigest()
        digest.update(values)
        self.digests[name] = ArrayRecord(values.shape, digest.hexdigest())

    def _read_back(self, run: str) -> None:
        """Read everything back from disk, with the checks of `vla-attention store verify`."""
        for problem in content_problems(self.run, StoredEpisode(self.folder, self.name, run)):
            raise CorruptEpisode(f"Episode {self.name}, read back from {self.folder}, is damaged: {problem.text}.")


def _map_of(maps: Sequence[tuple[int, ReplanMap]]) -> EffectMap:
    """What is said of the maps of some replans, which are of the same patches."""
    form, replans = maps[0][1].form, tuple(replan for replan, _ in maps)
    if len({of.patches for _, of in maps}) == 1 and not any(any(of.drawn) for _, of in maps):
        return structs.replace(form, replan=replans, patch=maps[0][1].patches)
    return structs.replace(
        form,
        replan=replans,
        patch_replan=tuple(replan for replan, of in maps for _ in of.patches),
        patch=tuple(patch for _, of in maps for patch in of.patches),
        drawn=tuple(drawn for _, of in maps for drawn in of.drawn),
    )


def _shapes_of_replan(record: ReplanRecord) -> dict[str, tuple[int, ...]]:
    """Shapes of what every replan of an episode has, or none."""
    shapes = {name: values.shape[1:] for name, (values, axes) in record.arrays.items() if axes[0] == "replan"}
    if "dataset_actions" in shapes:  # fewer at the end of the data set's episode
        shapes["dataset_actions"] = shapes["dataset_actions"][1:]
    return shapes if record.noise_seed is None else shapes | {"noise_seed": ()}
