"""One rerun of a store: the policy is loaded, and the stored calls are made again into stores like any other."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

from msgspec import structs

from vla_attention.capture.effects.conditions import describe_effects
from vla_attention.capture.effects.mean_pictures import MeanPictures
from vla_attention.capture.effects.measurement import measurement_of
from vla_attention.capture.engine.call import Caller, PolicyCall
from vla_attention.capture.engine.faults import Faults
from vla_attention.capture.engine.loop import EpisodeLoop
from vla_attention.capture.engine.plan import root_attributes
from vla_attention.capture.engine.progress import Progress, say
from vla_attention.capture.engine.source import Episode, EpisodeJob, Outcome, Source, episode_start
from vla_attention.capture.environments.base import Task
from vla_attention.capture.interventions.run_changes import RunChanges
from vla_attention.capture.jobs.worker_log import plan_of
from vla_attention.capture.policies.policy import Policy, stored_picture_sizes
from vla_attention.capture.rerun.base_store import families_of, instructions_of
from vla_attention.capture.rerun.fidelity import check_fidelity
from vla_attention.capture.rerun.stored_calls import StoredCalls, read_calls
from vla_attention.capture.store.disk_estimate import describe, estimate_disk
from vla_attention.capture.store.replan_records import EpisodeStart
from vla_attention.capture.store.store_writer import RunStore, WriteMode, open_run, remove_without_episodes
from vla_attention.schemas.interventions import Interventions, RerunSource
from vla_attention.schemas.stop_signals import Termination
from vla_attention.schemas.stores.reader import Store, StoredEpisode
from vla_attention.schemas.stores.store_format import (
    CorruptEpisode,
    Recording,
    RootAttributes,
    StoreError,
)


class BaseDamaged(StoreError):
    """An episode of the store whose calls are made again is damaged: another attempt would find the same."""


def job_of(base: Store, episode: StoredEpisode) -> EpisodeJob:
    """Return what is to be recorded of a stored episode."""
    attributes = episode.attributes
    task = Task(
        suite=base.attributes.protocol.suite,
        task_id=attributes.task_id,
        name=attributes.task_name,
        instruction=attributes.instruction,
        num_initial_states=0,
        task_family=attributes.task_family,
        file_sentence=attributes.provenance.get("task file says", ""),
    )
    return EpisodeJob(task, attributes.episode_index, attributes.num_replans, episode.name)


@dataclass
class StoredEpisodes(Source):
    """The policy calls of a store's episodes, made again.

    episodes: by their names. machine: provenance that is stored with every episode.
    """

    caller: Caller
    store: RunStore
    episodes: Mapping[str, StoredEpisode]
    machine: Mapping[str, str]

    def open(self, job: EpisodeJob) -> EpisodeAgain:
        """Read what the calls of an episode were given."""
        with _reading_the_base():
            calls = read_calls(self.episodes[job.name])
        attributes = calls.attributes
        start = episode_start(
            job,
            self.machine,
            state_digest=attributes.initial_state_digest,
            objects=attributes.objects,
            state_index=attributes.initial_state_index,
            scene_task_id=attributes.scene_task_id,
        )
        keep_actions = not self.store.attributes.interventions.is_none
        return EpisodeAgain(self.caller, calls, start, keep_actions=keep_actions)


@dataclass
class EpisodeAgain(Episode):
    """A stored episode whose calls are made again.

    Outcome, steps, environment steps and object coverage are those of the stored episode: nothing is executed.
    """

    caller: Caller
    calls: StoredCalls
    start: EpisodeStart
    keep_actions: bool
    done: int = 0

    def poll(self) -> PolicyCall | Outcome:
        """Return the next call."""
        attributes = self.calls.attributes
        with _reading_the_base():
            if self.done == self.calls.num_replans:
                # What was told of the base later may be taken back there: it is not sealed here.
                success = attributes.success if self.calls.episode.outcome is None else None
                return Outcome(success, attributes.num_steps, self.calls.steps)
            return self.calls.again(self.caller, self.done, keep_actions=self.keep_actions)


@contextmanager
def _reading_the_base() -> Iterator[None]:
    try:
        yield
    except CorruptEpisode as error:
        raise BaseDamaged(str(error)) from error


@dataclass(frozen=True)
class Rerun:
    """A loaded policy and the store whose calls it makes again.

    recording: what is recorded of the calls. machine: provenance of this process. faults: of the store that it wrote.
    pictures: what cameras' own are exchanged for in effects.
    """

    policy: Policy
    base: Store
    recording: Recording
    machine: Mapping[str, str]
    termination: Termination
    faults: Faults = field(default_factory=Faults)
    pictures: MeanPictures | None = None

    @cached_property
    def instructions(self) -> dict[int, str]:
        """The instruction of each task of the store, by task id."""
        return instructions_of(self.base)

    @cached_property
    def unchanged(self) -> Caller:
        """Makes the calls again as they were. The store's own interventions on attention are made again.

        Its changes of prompt, pictures and noise are in what the calls were given.
        """
        of_attention = structs.replace(self.base.attributes.interventions, prompt=None, images=(), noise=None)
        return self._caller(of_attention, allow_empty=True)

    def _caller(self, interventions: Interventions, *, allow_empty: bool) -> Caller:
        return Caller(self.policy, self.recording, RunChanges(interventions, self.instructions, allow_empty))

    def check(self, limit: int | None) -> None:
        """Make calls of the first episode again as they were, and print how far they are from the stored ones.

        limit: so many calls at most; None: all of the episode.
        """
        if limit == 0:
            say("No policy call was checked, as --check 0 says.")
            return
        calls = read_calls(self.base.episodes[0])
        count = calls.num_replans if limit is None else min(limit, calls.num_replans)
        progress = Progress(1, count, "call")
        episode = progress.begin(calls.episode.name, count)

        def report(done: int) -> None:
            self.termination.check()
            episode.update(done, done)

        try:
            recording = self.base.attributes.recording
            result = check_fidelity(self.unchanged, recording, calls, count, self.machine, report)
        finally:
            progress.close()
        for line in result.describe().splitlines():
            say(line)

    def write(
        self,
        target: Path,
        mode: WriteMode,
        interventions: Interventions,
        *,
        allow_empty: bool = False,
    ) -> int:
        """Make the calls again with interventions, or as they were, into a store; returns the number of new episodes.

        A store that this made and that has no episode in the end is removed after an error or faults.

        Args:
            target: the store.
            mode: what to do if it exists.
            interventions: what is changed, with block indices for layers.
            allow_empty: leave calls unchanged in which a group has no key, or an object is out of view.

        Raises:
            StoreExists: something is at `target` and the mode is `new`.
            RunMismatch: the mode is `resume`, and the store there is of another rerun.
        """
        of_base, is_new = self.base.attributes.interventions, not target.exists()
        store = open_run(target, self._attributes(of_base if interventions.is_none else interventions), mode)
        episodes = {episode.name: episode for episode in self.base.episodes}
        jobs = [job_of(self.base, episode) for episode in episodes.values()]
        todo = [job for job in jobs if not store.has(job.task.task_id, job.episode_index)]
        if len(todo) < len(jobs):
            say(f"{len(jobs) - len(todo)} of {len(jobs)} episodes are complete already; {len(todo)} to run.")
        if not todo:
            return 0
        caller = self.unchanged if interventions.is_none else self._caller(interventions, allow_empty=allow_empty)
        executed = self.base.attributes.protocol.replan_steps
        effects = measurement_of(
            self.recording.effects, self.policy, families_of(self.base), say, self.pictures, executed
        )
        if self.recording.effects is not None:
            say(describe_effects(self.recording.effects))
        caller = replace(caller, effects=effects)
        source = StoredEpisodes(caller, store, episodes, self.machine)
        loop = EpisodeLoop(
            store, plan_of((job.task, job.episode_index) for job in jobs), self.termination, "call", source
        )
        try:
            loop.record_all(todo)
        finally:
            if is_new:
                remove_without_episodes(store.path)
        self.faults.dropped.update({f"{name} of {target}": fault for name, fault in loop.faults.dropped.items()})
        # With the stored prompts this was said before the first call.
        if interventions.prompt is not None and (line := caller.changes.describe_empty()):
            say(line)
        return len(loop.results)

    def describe_disk(self, target: Path, replans: Sequence[int]) -> str:
        """Return the line about the disk space of reruns of episodes with so many policy calls."""
        pictures = stored_picture_sizes(self.policy, self.base.attributes.protocol.image_size)
        longest = max(replans, default=0)
        return describe(estimate_disk(self.recording, self.policy.sites, pictures, longest, len(replans)), target)

    def _attributes(self, interventions: Interventions) -> RootAttributes:
        base = self.base
        return root_attributes(
            self.policy.identity(),
            self.policy.sites,
            base.attributes.protocol,
            self.recording,
            self.machine,
            interventions=interventions,
            rerun_of=RerunSource(run=base.run, name=base.path.name),
            data_set=base.attributes.data_set,
        )
