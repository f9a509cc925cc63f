"""One rerun of a store: the policy is loaded, and the stored calls are made again into other stores."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

from vla_attention.capture.jobs.termination import Termination
from vla_attention.capture.policies.policy import Policy, stored_picture_sizes
from vla_attention.capture.rerun.base_store import instructions_of
from vla_attention.capture.rerun.calls import Repeater
from vla_attention.capture.rerun.fidelity import check_fidelity
from vla_attention.capture.rerun.progress import RerunProgress
from vla_attention.capture.rerun.rerun_episodes import rerun_episodes
from vla_attention.capture.rerun.stored_calls import read_calls
from vla_attention.capture.rollout.episode_faults import Faults
from vla_attention.capture.rollout.progress import say
from vla_attention.capture.store.disk_estimate import describe, estimate_disk
from vla_attention.capture.store.store_writer import WriteMode, open_run
from vla_attention.schemas.errors import UserError
from vla_attention.schemas.interventions import Interventions, RerunSource
from vla_attention.schemas.stores.reader import Store, StoredEpisode
from vla_attention.schemas.stores.store_format import (
    FORMAT_NAME,
    STORE_VERSION,
    Recording,
    RootAttributes,
    parse_episode_name,
)

#: Which episodes a rerun takes.
EpisodeFilter = Callable[[StoredEpisode], bool]


@dataclass(frozen=True)
class Rerun:
    """A loaded policy and the store whose calls it makes again.

    recording: what is recorded of the calls. machine: provenance of this process. faults: of all stores that it wrote.
    """

    policy: Policy
    base: Store
    recording: Recording
    machine: Mapping[str, str]
    termination: Termination
    faults: Faults = field(default_factory=Faults)

    @cached_property
    def instructions(self) -> dict[int, str]:
        """The instruction of each task of the store, by task id."""
        return instructions_of(self.base)

    @cached_property
    def unchanged(self) -> Repeater:
        """Makes the calls again as they were. The store's own interventions on attention are made again.

        Its changes of prompt, pictures and noise are in what the calls were given.
        """
        own = replace(self.base.attributes.interventions, prompt=None, images=(), noise=None)
        return Repeater(self.policy, self.recording, own, self.instructions, allow_empty=True)

    def check(self, limit: int | None) -> float | None:
        """Make calls of the first episode again as they were, and print how far they are from the stored ones.

        limit: so many calls at most; None: all of the episode. Returns the seconds of a call; None for a limit of 0.
        """
        if limit == 0:
            say("No policy call was checked, as --check 0 says.")
            return None
        calls = read_calls(self.base.episodes[0])
        count = calls.num_replans if limit is None else min(limit, calls.num_replans)
        progress, begun_at = RerunProgress(1, count), time.monotonic()
        progress.begin(calls.episode.name)

        def report(done: int) -> None:
            self.termination.check()
            progress.update(done, count)

        try:
            recording = self.base.attributes.recording
            result = check_fidelity(self.unchanged, recording, calls, count, self.machine, report)
        finally:
            progress.close()
        say(result.describe())
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
        own, is_new = self.base.attributes.interventions, not target.exists()
        store = open_run(target, self._attributes(own if interventions.is_none else interventions), mode)
        done = store.committed()
        episodes = [episode for episode in self.base.episodes if wanted(episode)]
        todo = [episode for episode in episodes if parse_episode_name(episode.name) not in done]
        if len(todo) < len(episodes):
            say(f"{len(episodes) - len(todo)} of {len(episodes)} episodes are complete already; {len(todo)} to run.")
        repeater = self.unchanged
        if not interventions.is_none:
            repeater = Repeater(self.policy, self.recording, interventions, self.instructions, allow_empty)
        progress = RerunProgress(len(todo), sum(episode.attributes.num_replans for episode in todo))
        try:
            faults = Faults()
            added = rerun_episodes(repeater, store, todo, self.machine, progress, self.termination, faults)
        except UserError:
            if is_new and not store.committed():
                shutil.rmtree(store.path)
            raise
        finally:
            progress.close()
        self.faults.dropped.update({f"{name} of {target}": fault for name, fault in faults.dropped.items()})
        if faults.dropped and is_new and not store.committed():
            shutil.rmtree(store.path)
        # With the stored prompts this was said before the first call.
        if interventions.prompt is not None and (line := repeater.attention.describe_empty()):
            say(line)
        return added

    def describe_disk(self, target: Path, replans: Sequence[int]) -> str:
        """Return the line about the disk space of reruns of episodes with so many policy calls."""
        pictures = stored_picture_sizes(self.policy, self.base.attributes.protocol.image_size)
        longest = max(replans, default=0)
        return describe(estimate_disk(self.recording, self.policy.sites, pictures, longest, len(replans)), target)

    def _attributes(self, interventions: Interventions) -> RootAttributes:
        base = self.base
        return RootAttributes(
            format=FORMAT_NAME,
            store_version=STORE_VERSION,
            policy=self.policy.identity(),
            protocol=base.attributes.protocol,
            recording=self.recording,
            sites=self.policy.sites,
            provenance=dict(self.machine),
            interventions=interventions,
            rerun_of=RerunSource(run=base.run, name=base.path.name),
            data_set=base.attributes.data_set,
        )
