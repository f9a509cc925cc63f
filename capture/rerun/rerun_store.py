"""One rerun of a store: the policy is loaded, and the stored calls are made again into other stores."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

from vla_attention.capture.jobs.termination import Termination
from vla_attention.capture.policies.policy import Policy, stored_picture_sizes
from vla_attention.capture.rerun.base_store import instructions_of
from vla_attention.capture.rerun.calls import Repeater
from vla_attention.capture.rerun.progress import RerunProgress
from vla_attention.capture.rerun.rerun_episodes import rerun_episodes
from vla_attention.capture.rollout.progress import say
from vla_attention.capture.store.disk_estimate import describe, estimate_disk
from vla_attention.capture.store.store_writer import WriteMode, open_run
from vla_attention.schemas.interventions import Interventions, RerunSource
from vla_attention.schemas.stores.reader import Store, StoredEpisode
from vla_attention.schemas.stores.store_format import (
    FORMAT_NAME,
    FORMAT_VERSION,
    Recording,
    RootAttributes,
    parse_episode_name,
)

#: Which episodes a rerun takes.
EpisodeFilter = Callable[[StoredEpisode], bool]


@dataclass(frozen=True)
class Rerun:
    """A loaded policy and the store whose calls it makes again.

    recording: what is recorded of the calls. machine: provenance of this process.
    """

    policy: Policy
    base: Store
    recording: Recording
    machine: Mapping[str, str]
    termination: Termination

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
        return Repeater(self.policy, self.recording, own, self.instructions)

    def write(
        self,
        target: Path,
        mode: WriteMode,
        interventions: Interventions,
        wanted: EpisodeFilter = lambda episode: True,
    ) -> int:
        """Make the calls again with interventions, or as they were, into a store; returns the number of new episodes.

        Raises:
            StoreExists: something is at `target` and the mode is `new`.
            RunMismatch: the mode is `resume`, and the store there is of another rerun.
        """
        own = self.base.attributes.interventions
        store = open_run(target, self._attributes(own if interventions.is_none else interventions), mode)
        done = store.committed()
        episodes = [episode for episode in self.base.episodes if wanted(episode)]
        todo = [episode for episode in episodes if parse_episode_name(episode.name) not in done]
        replans = [episode.attributes.num_replans for episode in todo]
        if not interventions.is_none:
            say(f"Interventions: {interventions.describe()}.")
        if len(todo) < len(episodes):
            say(f"{len(episodes) - len(todo)} of {len(episodes)} episodes are complete already; {len(todo)} to run.")
        if not todo:
            return 0
        pictures = stored_picture_sizes(self.policy, self.base.attributes.protocol.image_size)
        estimate = estimate_disk(self.recording, self.policy.sites, pictures, max(replans), len(todo))
        say(describe(estimate, store.path))
        repeater = self.unchanged
        if not interventions.is_none:
            repeater = Repeater(self.policy, self.recording, interventions, self.instructions)
        progress = RerunProgress(len(todo), sum(replans))
        try:
            return rerun_episodes(repeater, store, todo, self.machine, progress, self.termination)
        finally:
            progress.close()

    def _attributes(self, interventions: Interventions) -> RootAttributes:
        base = self.base
        return RootAttributes(
            format=FORMAT_NAME,
            format_version=FORMAT_VERSION,
            policy=self.policy.identity(),
            protocol=base.attributes.protocol,
            recording=self.recording,
            sites=self.policy.sites,
            provenance=dict(self.machine),
            interventions=interventions,
            rerun_of=RerunSource(run=base.run, name=base.path.name),
        )
