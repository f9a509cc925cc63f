"""`va.record`: a store filled from the caller's own loop over episodes and policy calls."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from vla_attention.capture.store.episode_writer import EpisodeWriter
from vla_attention.capture.store.replan_records import EpisodeStart
from vla_attention.capture.store.store_writer import RunStore, WriteMode, open_run
from vla_attention.capture.torch_policies.call_order import KnownCalls
from vla_attention.capture.torch_policies.knockouts import changes_of_episode
from vla_attention.capture.torch_policies.policy_layout import PolicyLayout
from vla_attention.capture.torch_policies.policy_modules import find_policy
from vla_attention.capture.torch_policies.policy_weights import policy_digest, weights_state
from vla_attention.capture.torch_policies.prompts import TokenText
from vla_attention.capture.torch_policies.recorded_call import RowOfCall, WatchedCall
from vla_attention.capture.torch_policies.recorded_episodes import (
    Episode,
    EpisodeBatch,
    RecordingStopped,
    Replan,
    check_length,
    rows_of_batch,
)
from vla_attention.capture.torch_policies.repeated_calls import RepeatedPolicy
from vla_attention.capture.torch_policies.replan_inputs import EpisodeFacts
from vla_attention.capture.torch_policies.replan_text import embeddings_of
from vla_attention.capture.torch_policies.watch import noticing_modules
from vla_attention.schemas.errors import BadArgument, UserError
from vla_attention.schemas.stores.store_format import RootAttributes, StoreExists, episode_name


class WeightsChanged(UserError, RuntimeError):
    """A policy whose weights are others than when the run began."""


class ContributionsUnknown(UserError, RuntimeError):
    """Contributions of a policy of which it cannot be said what its keys add to its residual stream."""


@dataclass(eq=False, repr=False)
class RecordedRun:
    """A store that is being filled; `va.record` makes it. Use it in a `with` block.

    Attributes:
        path: the store.
        attributes: what its root says: policy, sites, recording, interventions.
        layout: what the policy's calls are.
        num_dropped: replan blocks in which no attention ran.
        largest_error: largest difference of P·V from a kernel's output, relative to the largest output, of the stored
            episodes.
    """

    path: Path
    policy: object
    layout: PolicyLayout
    attributes: RootAttributes
    mode: WriteMode
    allow_empty: bool = False
    tokenizer: TokenText | None = None
    durable: bool = True
    num_dropped: int = field(default=0, init=False)
    largest_error: float = field(default=0.0, init=False)
    #: None outside of the block.
    _store: RunStore | None = field(default=None, init=False)
    _in_block: bool = field(default=False, init=False)
    #: Whether it was asked if the rows of a batch are apart, and what stands in sentences where that is not known.
    _asked_of_batch: bool = field(default=False, init=False)
    _of_batch: str = field(default="", init=False)
    #: Whether it was looked at whether heads and queries are exchanged.
    _asked_of_axes: bool = field(default=False, init=False)

    def __post_init__(self) -> None:
        """Look for the policy's modules, and at its weights."""
        self._found, self._known = find_policy(self.policy), KnownCalls(self.layout)
        self._weights = weights_state(self.policy)
        self._embeddings = embeddings_of(self._found.modules, self.layout)
        self._sites = tuple(self.layout.site(site.name) for site in self.attributes.sites)
        self._repeats: RepeatedPolicy | None = None
        if self.attributes.recording.effects is not None:
            identity, recording = self.attributes.policy, self.attributes.recording
            self._repeats = RepeatedPolicy(self._found, self._known, identity, recording)

    def __enter__(self) -> RecordedRun:
        self._store = open_run(self.path, self.attributes, self.mode, durable=self.durable)
        self.path = self._store.path
        self._noticing = noticing_modules()
        self._noticing.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._store = None
        self._noticing.__exit__(kind, error, traceback)

    @property
    def store(self) -> RunStore:
        """The store that is written to."""
        if self._store is None:
            raise RecordingStopped("This run is not open; use it as: with va.record(...) as run.")
        return self._store

    def has(self, task_id: int, episode_index: int) -> bool:
        """Whether an episode is in the store already; a resumed loop skips it."""
        return self.store.has(task_id, episode_index)

    @contextmanager
    def episode(
        self,
        *,
        task_id: int,
        episode_index: int,
        instruction: str,
        seed: int | None = None,
        task_name: str | None = None,
        objects: Sequence[Any] = (),
        task_family: str = "",
        siblings: Sequence[str] = (),
        initial_state: str | ArrayLike = "",
    ) -> Iterator[Episode]:
        """Record an episode; leaving the block stores it, an exception drops it.

        Args:
            task_id, episode_index: its place in the store; each pair once.
            instruction: the task in words, as given to the policy.
            seed: that of the policy's noise in all calls; None: not known.
            task_name: short name of the task; None: made of the id.
            objects: `SceneObject` of the scene, for masks and coverage.
            task_family: what tasks of one sentence template share, for instance "put A on B": they are not counted as
                independent; empty: not known.
            siblings: instructions of the other tasks of its family: for effects, each word is exchanged for those that
                stand in its place in them.
            initial_state: what the episode begins with, a simulator's state (an array) or a name: episodes of two runs
                are compared in pairs where it is equal. Its sha256 is stored; empty: not known.

        Raises:
            StoreExists: the episode is in the store already.
            NothingRecorded: no attention was seen in the block.
            WeightsChanged: the policy has other weights than when the run began.
        """
        facts = EpisodeFacts(
            task_id, episode_index, instruction, seed, task_name, tuple(objects), task_family, siblings, initial_state
        )
        with ExitStack() as stack:
            episode = self._begin(stack, facts)
            with _committing([episode]):
                yield episode

    @contextmanager
    def episodes(
        self, episodes: Sequence[Mapping[str, Any]], *, rows: Sequence[int] | None = None, batch: int | None = None
    ) -> Iterator[EpisodeBatch]:
        """Record several episodes whose policy calls are one call with a batch; leaving the block stores them all.

        Args:
            episodes: for each of them the arguments of `episode`.
            rows: the row of the batch of each episode; None: 0, 1, 2 and so on.
            batch: number of rows of a policy call; None: as many as episodes. The other rows are not recorded, and
                knockouts leave them as they are: guidance computes a second row without the instruction.

        Raises:
            BadArgument: rows that the batch does not have, or that two episodes share.
        """
        if self._repeats is not None:
            raise BadArgument(
                "Cannot measure effects of several environments in one call, whose repeats would be of all of them: "
                "record one at a time with run.episode, or leave effects out."
            )
        chosen, size = rows_of_batch(len(episodes), rows, batch)
        with ExitStack() as stack:
            joined = EpisodeBatch(self, stack, chosen, size)
            for facts in episodes:
                joined.append(joined._begin(facts))
            with _committing(joined):
                yield joined

    def _check_weights(self) -> None:
        """Raise `WeightsChanged` if the policy has other weights than when the run began."""
        state = weights_state(self.policy)
        if state == self._weights:
            return
        if policy_digest(self.policy)[0] != self.attributes.policy.digest:
            raise WeightsChanged(
                f"The weights of the policy ({type(self.policy).__name__}) changed since va.record was called, and a "
                "store is of one policy. Record each of its states into a store of its own."
            )
        self._weights = state

    def _begin(self, stack: ExitStack, facts: EpisodeFacts) -> Episode:
        if self.has(facts.task_id, facts.episode_index):
            name = episode_name(facts.task_id, facts.episode_index)
            raise StoreExists(
                f"{name} is in {self.path} already; skip it with run.has(task_id, episode_index), or record into "
                "another store."
            )
        interventions, sites = self.attributes.interventions, self.attributes.sites
        changes = changes_of_episode(interventions, sites, facts, allow_empty=self.allow_empty)
        episode = Episode(self, facts, changes, _stack=stack)
        if self._repeats is not None:
            self._repeats.siblings[facts.task_id] = facts.siblings
            episode._effects = self._repeats.measurement.begin()
        return episode

    def _writer_of(self, facts: EpisodeFacts) -> AbstractContextManager[EpisodeWriter]:
        """Return the writer of an episode whose first policy call was recorded."""
        start = EpisodeStart(
            task_id=facts.task_id,
            task_name=facts.task_name or f"task{facts.task_id}",
            instruction=facts.instruction,
            episode_index=facts.episode_index,
            initial_state_index=facts.episode_index,
            initial_state_digest=facts.initial_state_digest,
            objects=facts.objects,
            provenance=dict(self.attributes.provenance),
            task_family=facts.task_family,
        )
        steps = self.attributes.recording.denoise_steps
        times = self.layout.denoise_times or tuple(float(step) for step in range(self.layout.num_denoise_steps))
        return self.store.episode(start, np.array([times[step] for step in steps]))

    @contextmanager
    def _replan(self, rows: Sequence[RowOfCall], *, batch: int = 1, count: int | None = None) -> Iterator[Replan]:
        """Record one policy call. count: of the environments that it gives actions; None: one."""
        for one in rows:
            if one.episode._ended:
                raise RecordingStopped(
                    f"The block of {one.episode.name} has ended, and nothing can be added to it; begin another episode."
                )
        if self._in_block:
            raise RecordingStopped("A replan block stands inside of another; record one policy call after the other.")
        replan, call = Replan(), WatchedCall(self, rows, batch)
        self._in_block = True
        try:
            with call.watched():
                yield replan
            if call.ran:
                self._store_call(call, rows, replan, count)
            else:
                self.num_dropped += 1
                for one in rows:
                    one.episode.num_dropped += 1
                    one.episode.unmet = call.unmet
        finally:
            self._in_block = False

    def _store_call(self, call: WatchedCall, rows: Sequence[RowOfCall], replan: Replan, count: int | None) -> None:
        rows_of_sites = call.finish()
        self._check_contributions(call)
        call.release()
        if count is not None:
            check_length("actions", replan.actions, count)
        replan.recorded = True
        for one, of_sites in zip(rows, rows_of_sites, strict=True):
            one.episode.largest_error = max(one.episode.largest_error, call.largest_error)
            one.episode.num_whole += call.whole
            one.episode._append(call.record(one, of_sites, replan.actions))

    def _check_contributions(self, call: WatchedCall) -> None:
        """Raise `ContributionsUnknown` if contributions are recorded, and those of a call are not known."""
        unknown, of_batch = call.contributions.unknown(), f"; {self._of_batch}" if self._of_batch else ""
        if unknown is not None and self.attributes.recording.contributions:
            self._found.places.doubt()
            raise ContributionsUnknown(
                "Contributions cannot be recorded, because it is not known what each part of the keys adds to the "
                f"residual stream: {unknown}{of_batch}. Record with contributions=False, or --no-contributions "
                '(docs/my-policy.md, "Contributions"). Nothing of this episode was kept.'
            )


@contextmanager
def _committing(episodes: Sequence[Episode]) -> Iterator[None]:
    """End episodes with the block, and store them if no exception ended it."""
    try:
        yield
    finally:
        for episode in episodes:
            episode._ended = True
    for episode in episodes:
        episode._commit()
