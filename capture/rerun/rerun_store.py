"""One rerun of a store: the policy is loaded, and the stored calls are made again into stores like any other."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
from msgspec.structs import replace

from vla_attention.capture.effects.conditions import describe_effects
from vla_attention.capture.effects.mean_pictures import MeanPictures
from vla_attention.capture.effects.measurement import EffectMeasurement, measurement_of
from vla_attention.capture.environments.base import Task
from vla_attention.capture.jobs.termination import Termination
from vla_attention.capture.policies.policy import Policy, stored_picture_sizes
from vla_attention.capture.rerun.base_store import families_of, instructions_of
from vla_attention.capture.rerun.fidelity import check_fidelity
from vla_attention.capture.rerun.stored_calls import Repeater, read_calls
from vla_attention.capture.rollout.episode_faults import Faults
from vla_attention.capture.rollout.episode_loop import (
    EpisodeJob,
    EpisodeResult,
    EpisodeSource,
    OneByOneLoop,
    StepReport,
    episode_start,
    plan_of,
)
from vla_attention.capture.rollout.policy_call import replan_record
from vla_attention.capture.rollout.progress import Progress, say
from vla_attention.capture.rollout.recording_plan import root_attributes
from vla_attention.capture.store.disk_estimate import describe, estimate_disk
from vla_attention.capture.store.store_writer import RunStore, WriteMode, open_run, remove_without_episodes
from vla_attention.schemas.interventions import Interventions, RerunSource
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
    )
    return EpisodeJob(task, attributes.episode_index, attributes.num_replans, episode.name)


@dataclass(frozen=True)
class StoredCallsSource(EpisodeSource):
    """The policy calls of a store's episodes, made again.

    episodes: by their names. machine: provenance that is stored with every episode. effects: what measures the effects
    of calls; None where they are not recorded.
    """

    repeater: Repeater
    store: RunStore
    episodes: Mapping[str, StoredEpisode]
    machine: Mapping[str, str]
    termination: Termination
    effects: EffectMeasurement | None = None

    def record(self, job: EpisodeJob, report: StepReport) -> EpisodeResult:
        """Rerun an episode and commit it.

        Outcome, steps, environment steps and object coverage are those of the stored episode: nothing is executed. With
        interventions the stored actions are kept beside the changed ones, to know the base by them.
        """
        with _reading_the_base():
            calls = read_calls(self.episodes[job.name])
        attributes, recording, repeater = calls.attributes, self.store.attributes.recording, self.repeater
        start = episode_start(
            job.task,
            job.episode_index,
            self.machine,
            state_digest=attributes.initial_state_digest,
            objects=attributes.objects,
            state_index=attributes.initial_state_index,
        )
        effects = None if self.effects is None else self.effects.begin()
        denoise_times = repeater.policy.denoise_times()[list(recording.denoise_steps)]
        with self.store.episode(start, np.asarray(denoise_times), calls.num_replans) as writer:
            for replan in range(calls.num_replans):
                self.termination.check()
                with _reading_the_base():
                    policy_input = repeater.prepare(calls, replan)
                call, seed = repeater.call(calls, replan, policy_input), repeater.noise_seed(calls, replan)
                measured = None
                if effects is not None:
                    context = calls.context(replan, repeater.instructions)
                    measured = effects.measure(policy_input, seed, call.actions, context)
                writer.append(
                    replan_record(
                        policy_input,
                        call,
                        recording,
                        env_step=int(calls.env_step[replan]),
                        noise_seed=seed,
                        effects=measured,
                        coverage=calls.coverage_of(replan),
                        dataset_actions=calls.dataset_actions_of(replan),
                        base_actions=None if self.store.attributes.interventions.is_none else calls.actions[replan],
                    )
                )
                report(replan + 1, replan + 1)
            with _reading_the_base():
                steps = calls.steps
            folder = writer.commit(attributes.success, attributes.num_steps, steps)
        return EpisodeResult(
            job.task.task_id,
            job.episode_index,
            attributes.success,
            attributes.num_steps,
            calls.num_replans,
            folder,
        )


@contextmanager
def _reading_the_base() -> Iterator[None]:
    try:
        yield
    except CorruptEpisode as error:
        raise BaseDamaged(str(error)) from error


#: Which episodes a rerun takes.
EpisodeFilter = Callable[[StoredEpisode], bool]


@dataclass(frozen=True)
class Rerun:
    """A loaded policy and the store whose calls it makes again.

    recording: what is recorded of the calls. machine: provenance of this process. faults: of all stores that it wrote.
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
    def unchanged(self) -> Repeater:
        """Makes the calls again as they were. The store's own interventions on attention are made again.

        Its changes of prompt, pictures and noise are in what the calls were given.
        """
        of_attention = replace(self.base.attributes.interventions, prompt=None, images=(), noise=None)
        return Repeater(self.policy, self.recording, of_attention, self.instructions, allow_empty=True)

    def check(self, limit: int | None) -> float | None:
        """Make calls of the first episode again as they were, and print how far they are from the stored ones.

        limit: so many calls at most; None: all of the episode. Returns the seconds of a call; None for a limit of 0.
        """
        if limit == 0:
            say("No policy call was checked, as --check 0 says.")
            return None
        calls = read_calls(self.base.episodes[0])
        count = calls.num_replans if limit is None else min(limit, calls.num_replans)
        progress, begun_at = Progress(1, count, "call"), time.monotonic()
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
        return (time.monotonic() - begun_at) / count

    def write(
        self,
        target: Path,
        mode: WriteMode,
        interventions: Interventions,
        wanted: EpisodeFilter = lambda episode: True,
        *,
        allow_empty: bool = False,
    ) -> int:
        """Make the calls again with interventions, or as they were, into a store; returns the number of new episodes.

        A store that this made and that has no episode in the end is removed after an error or faults.

        Args:
            target: the store.
            mode: what to do if it exists.
            interventions: what is changed, with block indices for layers.
            wanted: which episodes.
            allow_empty: as of `Repeater`.

        Raises:
            StoreExists: something is at `target` and the mode is `new`.
            RunMismatch: the mode is `resume`, and the store there is of another rerun.
        """
        of_base, is_new = self.base.attributes.interventions, not target.exists()
        store = open_run(target, self._attributes(of_base if interventions.is_none else interventions), mode)
        episodes = {episode.name: episode for episode in self.base.episodes if wanted(episode)}
        jobs = [job_of(self.base, episode) for episode in episodes.values()]
        todo = [job for job in jobs if not store.has(job.task.task_id, job.episode_index)]
        if len(todo) < len(jobs):
            say(f"{len(jobs) - len(todo)} of {len(jobs)} episodes are complete already; {len(todo)} to run.")
        if not todo:
            return 0
        repeater = self.unchanged
        if not interventions.is_none:
            repeater = Repeater(self.policy, self.recording, interventions, self.instructions, allow_empty)
        effects = measurement_of(self.recording.effects, self.policy, families_of(self.base), say, self.pictures)
        if self.recording.effects is not None:
            say(describe_effects(self.recording.effects))
        source = StoredCallsSource(repeater, store, episodes, self.machine, self.termination, effects)
        loop = OneByOneLoop(store, plan_of(jobs), self.termination, "call", source)
        try:
            loop.record_all(todo)
        finally:
            if is_new:
                remove_without_episodes(store.path)
        self.faults.dropped.update({f"{name} of {target}": fault for name, fault in loop.faults.dropped.items()})
        # With the stored prompts this was said before the first call.
        if interventions.prompt is not None and (line := repeater.attention.describe_empty()):
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
