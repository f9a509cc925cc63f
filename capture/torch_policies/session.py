"""`va.record`: a store filled from the caller's own loop over episodes and policy calls."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from msgspec import structs
from numpy.typing import NDArray

from vla_attention.capture.interventions.changed_inputs import CallContext
from vla_attention.capture.store.episode_writer import EpisodeWriter
from vla_attention.capture.store.replan_records import EpisodeStart, ReplanEffects, ReplanRecord
from vla_attention.capture.store.store_root import read_existing_root
from vla_attention.capture.store.store_writer import RunStore, WriteMode, make_way, open_run
from vla_attention.capture.torch_policies.batch_rows import BatchRowsMixed, rows_of_module_apart
from vla_attention.capture.torch_policies.call_order import CallsDoNotFit, KnownCalls
from vla_attention.capture.torch_policies.call_state import CallState
from vla_attention.capture.torch_policies.knockouts import ReplanEdits, SessionKnockouts
from vla_attention.capture.torch_policies.policy_layout import PolicyLayout
from vla_attention.capture.torch_policies.policy_modules import OutputProjection, find_policy
from vla_attention.capture.torch_policies.policy_weights import policy_digest, weights_state
from vla_attention.capture.torch_policies.prompts import TokenText
from vla_attention.capture.torch_policies.recorded_episodes import (
    Episode,
    EpisodeBatch,
    RecordingStopped,
    Replan,
    check_length,
    rows_of_batch,
)
from vla_attention.capture.torch_policies.repeated_calls import CallInput, RecordedCall, RepeatedPolicy
from vla_attention.capture.torch_policies.replan_inputs import (
    EpisodeFacts,
    ReplanInputs,
    read_actions,
)
from vla_attention.capture.torch_policies.replan_text import PromptIds, ReplanText, embeddings_of
from vla_attention.capture.torch_policies.site_recorder import ReplanRecorder, SiteRows, final_contribution
from vla_attention.capture.torch_policies.watch import watch_attention
from vla_attention.schemas.errors import BadArgument, Note, UserError
from vla_attention.schemas.stores.locks import Locks
from vla_attention.schemas.stores.store_format import EPISODES_GROUP, RootAttributes, StoreExists, episode_name

#: More replans than any episode has; the writer collects rows in blocks of two megabytes.
_MANY_REPLANS = 1_000_000


_BY_NAMES = (
    "This policy call was watched at the names of torch's attention functions only, since all attention of an earlier "
    "one was called by them. If it is called otherwise here, record again with run.every_function = True."
)


class WeightsChanged(UserError, RuntimeError):
    """A policy whose weights are others than when the run began."""


class ContributionsUnknown(UserError, RuntimeError):
    """Contributions of a policy of which it cannot be said what its keys add to its residual stream."""


class RecordedRun:
    """A store that is being filled; `va.record` makes it. Use it in a `with` block.

    Attributes:
        path: the store.
        attributes: what its root says: policy, sites, recording, interventions.
        layout: what the policy's calls are.
        num_dropped: replan blocks in which no attention ran.
        largest_error: largest difference of P·V from a kernel's output, relative to the largest output, of the stored
            episodes.
        every_function: look at every function of torch at every policy call, which is slower. False: at an episode's
            first, and at all where attention functions are called otherwise than by their names in torch.

    Args:
        undecided: contributions are recorded if the first policy call shows what each part of the keys adds to the
            residual stream. The store, which says whether it has any, is made after that call.
    """

    def __init__(
        self,
        path: Path,
        policy: object,
        layout: PolicyLayout,
        attributes: RootAttributes,
        mode: WriteMode,
        *,
        knockouts: SessionKnockouts,
        tokenizer: TokenText | None,
        projections: Mapping[tuple[str, int], OutputProjection],
        undecided: bool = False,
        durable: bool = True,
    ) -> None:
        self.path = path
        self.policy = policy
        self._known_policy = find_policy(policy)
        self._weights = weights_state(policy)
        self._embeddings = embeddings_of(policy, layout)
        self.layout = layout
        self._known = KnownCalls(layout)
        self.attributes = attributes
        self.num_dropped = 0
        self.largest_error = 0.0
        self.knockouts = knockouts
        self._mode = mode
        self._tokenizer = tokenizer
        self._projections = projections
        self._undecided = undecided
        self._durable = durable
        self._store: RunStore | None = None
        #: Of whoever records with this run; None: the run has its own.
        self.locks: Locks | None = None
        self._entered = False
        self._in_block = False
        self.every_function = False
        #: Whether it is not known yet that names are enough.
        self._names_unknown = True
        #: Whether it was asked if the rows of a batch are apart, and what stands in sentences where that is not known.
        self._asked_of_batch, self._of_batch = False, ""
        self._sites = tuple(layout.site(site.name) for site in attributes.sites)
        self._repeats: RepeatedPolicy | None = None
        if attributes.recording.effects is not None:
            self._repeats = RepeatedPolicy(self._known_policy, self._known, attributes.policy, attributes.recording)

    def __enter__(self) -> RecordedRun:
        self._entered = True
        if self._undecided and self._mode == "resume" and self.path.exists():
            # The policy calls that are stored there have shown it.
            self._decide(contributions=read_existing_root(self.path).recording.contributions)
        if self._undecided:
            self.path = make_way(self.path, self._mode)
            self._mode = "new" if self._mode == "new" else "resume"
        else:
            self._open()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._store = None
        self._entered = False

    def _open(self) -> None:
        self._store = open_run(self.path, self.attributes, self._mode, durable=self._durable)
        self.path = self._store.path
        if self.locks is not None:
            self._store.locks = self.locks

    def _decide(self, *, contributions: bool, because: str = "") -> None:
        """Note whether contributions are recorded; because: for the store."""
        self._undecided = False
        self.attributes = structs.replace(
            self.attributes,
            recording=structs.replace(self.attributes.recording, contributions=contributions),
            provenance={**self.attributes.provenance, **({"contributions": because} if because else {})},
        )

    def has(self, task_id: int, episode_index: int) -> bool:
        """Whether an episode is in the store already; a resumed loop skips it."""
        self._check_entered()
        return (self.path / EPISODES_GROUP / episode_name(task_id, episode_index)).is_dir()

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

        Raises:
            StoreExists: the episode is in the store already.
            NothingRecorded: no attention was seen in the block.
            WeightsChanged: the policy has other weights than when the run began.
        """
        facts = EpisodeFacts(
            task_id, episode_index, instruction, seed, task_name, tuple(objects), task_family, siblings
        )
        with ExitStack() as stack:
            episode = self._begin(stack, facts)
            try:
                yield episode
            finally:
                episode._ended = True
            episode._commit()

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
                joined._episodes.append(joined._begin(facts))
            try:
                yield joined
            finally:
                for episode in joined:
                    episode._ended = True
            for episode in joined:
                episode._commit()

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

    def _check_entered(self) -> None:
        if not self._entered:
            raise RecordingStopped("This run is not open; use it as: with va.record(...) as run.")

    def _begin(self, stack: ExitStack, facts: EpisodeFacts) -> Episode:
        if self.has(facts.task_id, facts.episode_index):
            name = episode_name(facts.task_id, facts.episode_index)
            raise StoreExists(
                f"{name} is in {self.path} already; skip it with run.has(task_id, episode_index), or record into "
                "another store."
            )
        self.knockouts.check_names(self.attributes.sites, facts.instruction, facts.objects)
        self._names_unknown = True
        episode = Episode(self, facts, _stack=stack)
        if self._repeats is not None:
            self._repeats.siblings[facts.task_id] = facts.siblings
            episode._effects = self._repeats.measurement.begin()
        return episode

    def _writer_of(self, facts: EpisodeFacts) -> AbstractContextManager[EpisodeWriter]:
        """Return the writer of an episode whose first policy call was recorded."""
        assert self._store is not None
        start = EpisodeStart(
            task_id=facts.task_id,
            task_name=facts.task_name or f"task{facts.task_id}",
            instruction=facts.instruction,
            episode_index=facts.episode_index,
            initial_state_index=facts.episode_index,
            initial_state_digest="",
            objects=facts.objects,
            provenance=dict(self.attributes.provenance),
            task_family=facts.task_family,
        )
        steps = self.attributes.recording.denoise_steps
        times = self.layout.denoise_times or tuple(float(step) for step in range(self.layout.num_denoise_steps))
        return self._store.episode(start, np.array([times[step] for step in steps]), _MANY_REPLANS)

    @contextmanager
    def _replan(
        self,
        episodes: Sequence[Episode],
        given: Sequence[ReplanInputs],
        *,
        batch: int,
        rows: Sequence[int],
        places: Sequence[int] = (0,),
        count: int = 1,
    ) -> Iterator[Replan]:
        """Record one policy call of some rows of a batch.

        places: where the actions of each episode are among those of all `count` episodes.
        """
        self._check_entered()
        for episode in episodes:
            if episode._ended:
                raise RecordingStopped(
                    f"The block of {episode.name} has ended, and nothing can be added to it; begin another episode."
                )
        if self._in_block:
            raise RecordingStopped("A replan block stands inside of another; record one policy call after the other.")
        ids = PromptIds(self._embeddings, batch)
        text = ReplanText(self.layout, self._tokenizer, ids, dict(zip(rows, given, strict=True)))
        edits = ReplanEdits(self, dict(zip(rows, zip(episodes, given, strict=True), strict=True)), text)
        recorder = ReplanRecorder(
            self._known,
            type(self.policy).__name__,
            self.attributes.recording,
            batch,
            rows,
            self._projections,
            text.early_roles,
            edits.bias if self.knockouts.any else None,
        )
        edits.recorder = recorder
        recorder.keeps_module = batch > 1 and not self._asked_of_batch
        text.present = recorder.order.present
        replan = Replan()
        before = self._state_before(episodes[0], given[0])
        self._in_block = True
        try:
            every_function = self.every_function or self._names_unknown
            seen = watch_attention(self._known_policy, recorder, every_function=every_function)
            with ids.watched(), seen as functions:
                yield replan
        finally:
            self._in_block = False
        if recorder.saw_attention:
            self._names_unknown = not functions.by_names
        try:
            self._store_replan(replan, recorder, text, episodes, given, rows, places, count, before)
        except CallsDoNotFit as error:
            # Where there were fewer tokens, nothing was called otherwise.
            if every_function or recorder.order.fewer_tokens:
                raise
            raise CallsDoNotFit(f"{error}\n{_BY_NAMES}") from None

    def _store_replan(
        self,
        replan: Replan,
        recorder: ReplanRecorder,
        text: ReplanText,
        episodes: Sequence[Episode],
        given: Sequence[ReplanInputs],
        rows: Sequence[int],
        places: Sequence[int],
        count: int,
        before: CallState | None,
    ) -> None:
        if not recorder.saw_attention:
            self.num_dropped += 1
            for episode in episodes:
                episode.num_dropped += 1
            return
        where = ", ".join(
            f"replan {episode.num_replans} (environment step {inputs.env_step}) of {episode.name}"
            for episode, inputs in list(zip(episodes, given, strict=True))[:2]
        )
        rows_of_sites = recorder.finish(where)
        if recorder.keeps_module:
            self._check_batch(recorder)
        self._check_contributions(recorder)
        if self._store is None:
            self._open()
        if count > 1:
            check_length("actions", replan.actions, count)
        replan.recorded = True
        for position, (row, episode, inputs) in enumerate(zip(rows, episodes, given, strict=True)):
            episode.largest_error = max(episode.largest_error, recorder.largest_error)
            actions = replan.actions
            if actions is not None and count > 1:
                actions = actions[places[position]]
            record = self._record(rows_of_sites[position], text, row, inputs, read_actions(actions))
            if before is not None:
                record = replace(record, effects=self._effects(episode, inputs, record, recorder, text, before, where))
            episode._append(record)

    def _state_before(self, episode: Episode, inputs: ReplanInputs) -> CallState | None:
        """Return the state before a policy call whose effects are measured; None where they are not."""
        planned = self.attributes.recording.effects
        if planned is None or episode.num_replans % planned.every:
            return None
        if inputs.repeat is None:
            raise BadArgument(
                f"Cannot measure effects at environment step {inputs.env_step} of {episode.name}: the call cannot be "
                "made again. Give episode.replan(repeat=lambda call: ...), which makes it with call.instruction and "
                "call.frames, or record without effects."
            )
        return CallState(self.policy, inputs.repeat.call)

    def _effects(
        self,
        episode: Episode,
        inputs: ReplanInputs,
        record: ReplanRecord,
        recorder: ReplanRecorder,
        text: ReplanText,
        before: CallState,
        where: str,
    ) -> ReplanEffects | None:
        """Return the effects of the policy call that was just recorded, from calls that are made again."""
        assert self._repeats is not None
        assert episode._effects is not None
        assert inputs.repeat is not None
        if record.actions is None:
            raise BadArgument(f"Cannot measure effects at {where}: its actions are not known. Set replan.actions.")
        present = recorder.order.present
        # Sites of which no layer is recorded are changed, too.
        roles = {
            site.name: text.roles(0, site, record.prompt, present.get(site.name), None) for site in self.layout.sites
        } | dict(record.key_role)
        state = np.zeros(0) if record.state is None else record.state
        given = CallInput(inputs.frames, roles, record.prompt, state, {}, call=inputs.repeat.given)
        every_function = self.every_function or self._names_unknown
        call = RecordedCall(inputs.repeat, given, before, record.actions, present, every_function, where)
        facts = episode.facts
        context = CallContext(
            facts.task_id, facts.episode_index, episode.num_replans, {}, facts.objects, inputs.coverage
        )
        self._in_block = True
        try:
            return self._repeats.measure(episode._effects, call, context)
        finally:
            self._in_block = False

    def _check_batch(self, recorder: ReplanRecorder) -> None:
        """Raise `BatchRowsMixed` if the rows of a batch are not those of the environments; say where nothing tells."""
        self._asked_of_batch, call = True, recorder.module_call
        if self.attributes.recording.contributions and recorder.contributions.unknown() is None:
            return  # the output projections were given the rows in the order of the batch
        apart = None if call is None else rows_of_module_apart(self._known_policy, call)
        if apart is None:
            self._of_batch = (
                f"the rows of a batch of {recorder.batch} may be mixed, if heads are folded outside of the batch: "
                "compare them with a call of one row (va.inspect, first_row=...), or record one environment at a time"
            )
            if not self.attributes.recording.contributions:
                warnings.warn(f"It is not known whether rows are those of their episodes: {self._of_batch}.", Note)
        elif not apart:
            assert call is not None
            raise BatchRowsMixed(
                f"The rows of a batch of {recorder.batch} are not apart in module '{call.shape.module}': called again "
                "with another first row, it changes the attention of other rows. It folds heads and batch into one "
                "axis with the heads outside. Record one environment at a time, with run.episode."
            )

    def _check_contributions(self, recorder: ReplanRecorder) -> None:
        """Raise `ContributionsUnknown` if a call's contributions are not known; at the first one, decide about them."""
        unknown, of_batch = recorder.contributions.unknown(), f"; {self._of_batch}" if self._of_batch else ""
        if not self._undecided:
            if unknown is not None:
                raise ContributionsUnknown(
                    "Contributions cannot be recorded, because it is not known what each part of the keys adds to the "
                    f"residual stream: {unknown}{of_batch}. Name another projection in the layout, or record with "
                    "contributions=False. Nothing of this episode was kept."
                )
            return
        if unknown is None:
            between = recorder.contributions.describe()
            self._decide(contributions=True, because=f"what is added to the residual stream ({between})")
            return
        self._decide(contributions=False, because=f"none: {unknown}")
        warnings.warn(
            "The store has no contributions, because it is not known what each part of the keys adds to the residual "
            f"stream: {unknown}. The rows are recorded{of_batch}. Name another projection in the layout if this is not "
            'the output projection (docs/your-policy.md, "Contributions"), or record with contributions=False.',
            Note,
            stacklevel=2,
        )

    def _record(
        self,
        rows_of_sites: Mapping[str, SiteRows],
        text: ReplanText,
        row: int,
        inputs: ReplanInputs,
        actions: NDArray[np.float64] | None,
    ) -> ReplanRecord:
        for site in self._sites:
            text.check_places(row, site, rows_of_sites[site.name].present, rows_of_sites[site.name].valid)
        prompt = text.prompt(row, rows_of_sites)
        key_role, stored = {}, {}
        for site in self._sites:
            site_rows = rows_of_sites[site.name]
            roles = text.roles(row, site, prompt, site_rows.present, site_rows.valid)
            stored[site.name] = replace(site_rows.rows, contribution=final_contribution(site, site_rows, roles))
            key_role[site.name] = roles
        recorded = inputs.dataset_actions
        if recorded is not None and actions is not None:
            recorded = recorded[: len(actions)]  # beyond the policy's chunk there is nothing to compare
        return ReplanRecord(
            env_step=inputs.env_step,
            noise_seed=inputs.noise_seed,
            rows=stored,
            key_role=key_role,
            prompt=prompt,
            state=inputs.state,
            actions=actions,
            frames=inputs.frames if self.attributes.recording.frames else {},
            coverage=inputs.coverage,
            dataset_actions=recorded,
        )
