"""One policy call of `va.record`: what watches it in its block, and what is stored of it afterwards."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import NDArray

from vla_attention.capture.engine.call import PolicyCall, record_of
from vla_attention.capture.interventions.changed_inputs import CallContext
from vla_attention.capture.policies.random_numbers import RandomNumbers
from vla_attention.capture.recording.finite_numbers import all_finite, not_finite
from vla_attention.capture.store.replan_records import RecordedRows, ReplanRecord
from vla_attention.capture.torch_policies.attention_calls import CallShape, RowsRefused
from vla_attention.capture.torch_policies.call_order import CallPlace, CallsDoNotFit
from vla_attention.capture.torch_policies.knockouts import CallBias
from vla_attention.capture.torch_policies.own_setting import BatchRowsMixed
from vla_attention.capture.torch_policies.policy_layout import RecordedSite
from vla_attention.capture.torch_policies.repeated_calls import OWN_NOISE, CallInput, CallToRepeat
from vla_attention.capture.torch_policies.replan_inputs import ReplanInputs, read_actions
from vla_attention.capture.torch_policies.replan_text import PromptIds, ReplanText
from vla_attention.capture.torch_policies.site_recorder import ReplanRecorder, SiteRows, final_contribution
from vla_attention.capture.torch_policies.watch import watch_attention
from vla_attention.capture.torch_policies.words_heard import look_at_words_heard
from vla_attention.schemas.errors import BadArgument, Note
from vla_attention.schemas.layout import Prompt
from vla_attention.schemas.plumbing import Plumbing

if TYPE_CHECKING:
    from vla_attention.capture.torch_policies.recorded_episodes import Episode
    from vla_attention.capture.torch_policies.session import RecordedRun

#: Where it is not known.
NO_STATE = np.zeros(0)


@dataclass(frozen=True)
class RowOfCall:
    """What is an episode's of a policy call.

    row: of the batch. action_place: of its actions among those of several environments; None: they are its own.
    """

    episode: Episode
    inputs: ReplanInputs
    row: int = 0
    action_place: int | None = None

    @property
    def where(self) -> str:
        """The replan in words, before it is added to its episode."""
        step, episode = self.inputs.env_step, self.episode
        return f"replan {episode.num_replans} (environment step {step}) of {episode.name}"

    @property
    def context(self) -> CallContext:
        """The call's place and its scene, before it is added to its episode."""
        facts, replan = self.episode.facts, self.episode.num_replans
        return CallContext(
            facts.task_id, facts.episode_index, replan, objects=facts.objects, coverage=self.inputs.coverage
        )


class WatchedCall(ReplanRecorder):
    """One policy call. calls: those of its batch that are recorded. batch: how many it has.

    Raises:
        BadArgument: its effects are to be measured, and it cannot be repeated.
    """

    def __init__(self, run: RecordedRun, calls: Sequence[RowOfCall], batch: int) -> None:
        where, rows = ", ".join(one.where for one in calls[:2]), [one.row for one in calls]
        super().__init__(run._known, type(run.policy).__name__, run.attributes.recording, batch, rows, where)
        self.changes = run.attributes.interventions.changes_attention
        self._run, self._calls = run, {one.row: one for one in calls}
        self._ids = PromptIds(run._embeddings, batch)
        inputs = {one.row: one.inputs for one in calls}
        self._text = ReplanText(run.layout, run.tokenizer, self._ids, inputs, self.present)
        self.asks_of_axes = not run._asked_of_axes
        self._asks_of_batch = self.asks_of_batch = batch > 1 and not run._asked_of_batch
        #: Of a row of the batch, what changes it: asked at its first call.
        self._bias_of = cache(self._row_bias)
        self._before = self._state_before(calls[0])
        #: Whether it is looked at whether the instruction gets through: at first calls while the store has no episode.
        self._looks = not calls[0].episode.num_replans and not run.store.committed()
        looks = self._looks and calls[0].inputs.repeat is not None
        self._before_first = self._before or (RandomNumbers() if looks else None)

    def _state_before(self, one: RowOfCall) -> RandomNumbers | None:
        """Return the random numbers before a policy call whose effects are measured; None where they are not."""
        planned = self._run.attributes.recording.effects
        if planned is None or one.episode.num_replans % planned.every:
            return None
        if one.inputs.repeat is None:
            raise BadArgument(
                f"Cannot measure effects at environment step {one.inputs.env_step} of {one.episode.name}: the call "
                "cannot be made again. Give episode.replan(repeat=lambda call: ...), which makes it with "
                "call.instruction and call.frames, or record without effects."
            )
        return RandomNumbers()

    @contextmanager
    def watched(self) -> Iterator[None]:
        """Watch the call that is made within the block."""
        with self._ids.watched(), watch_attention(self._run._found, self):
            yield

    def finish(self) -> list[dict[str, SiteRows]]:
        """Return what the sites gave for each row, once the call has ended; errors as `ReplanRecorder.finish`.

        Raises:
            BatchRowsMixed: the rows of the batch are not those of the environments.
            RowsRefused: heads and queries are exchanged.
        """
        try:
            rows_of_sites = super().finish()
        except CallsDoNotFit:
            self._run._found.places.doubt()  # attention may have moved to where it was not watched
            raise
        if self.contributions.turned:
            raise RowsRefused(
                "The rows have heads for queries, and queries for heads: the policy's softmax is over (batch, query, "
                "head, key), with as many queries as heads, which share their values. Compute it over (batch, head, "
                "query, key)."
            )
        self._run._asked_of_axes = self._run._asked_of_axes or not self.asks_of_axes
        if self._asks_of_batch:
            self._check_batch()
        return rows_of_sites

    def _check_batch(self) -> None:
        """Raise `BatchRowsMixed` if the rows of a batch are not those of the environments; say where nothing tells."""
        run, batch = self._run, self.batch
        run._asked_of_batch, apart = True, self.contributions.rows_apart()
        if apart is None:
            run._of_batch = (
                f"the rows of a batch of {batch} may be mixed, if heads are folded outside of the batch: compare them "
                "with a call of one row (va.inspect, first_row=...), or record one environment at a time"
            )
            if not run.attributes.recording.contributions:
                warnings.warn(f"It is not known whether rows are those of their episodes: {run._of_batch}.", Note)
        elif not apart:
            raise BatchRowsMixed(
                f"The rows of a batch of {batch} are not apart: what the attention gave for one is added to others. "
                "The policy folds heads and batch into one axis with the heads outside. Record one environment at a "
                "time, with run.episode."
            )

    def record(self, one: RowOfCall, rows_of_sites: Mapping[str, SiteRows], given_actions: Any) -> ReplanRecord:
        """Return what is stored of a row, with its effects. given_actions: those of all environments.

        Raises:
            NumbersNotFinite: its actions or contributions hold NaN or infinity.
            BadArgument: its effects are to be measured, and its actions are not known.
        """
        run, inputs, text = self._run, one.inputs, self._text
        several = given_actions is not None and one.action_place is not None
        actions = read_actions(given_actions[one.action_place] if several else given_actions)
        for site in run._sites:
            text.check_places(one.row, site, rows_of_sites[site.name].valid)
        prompt = text.prompt(one.row, {name: of_site.valid for name, of_site in rows_of_sites.items()})
        key_role: dict[str, NDArray[np.uint8]] = {}
        stored: dict[str, RecordedRows] = {}
        for site in run._sites:
            of_site = rows_of_sites[site.name]
            key_role[site.name] = roles = text.roles(one.row, site, prompt, of_site.valid)
            stored[site.name] = replace(of_site.rows, contribution=final_contribution(site, of_site, roles))
        if not all_finite(actions, stored):
            wrong = [name for name, rows in stored.items() if not np.isfinite(rows.row_sum).all()]
            found = (
                f"Rows of site '{wrong[0]}' are not"
                if wrong
                else "Its rows are finite, its actions or contributions are not"
            )
            raise not_finite(one.where, found, self.remedy)
        data = inputs.dataset_actions
        if data is not None and actions is not None:
            data = data[: len(actions)]  # beyond the policy's chunk there is nothing to compare
        call = PolicyCall(
            CallInput(
                inputs.frames,
                key_role,
                prompt,
                NO_STATE if inputs.state is None else inputs.state,
                {},
                shown=inputs.shown,
            ),
            OWN_NOISE,
            one.context,
            inputs.env_step,
            one.where,
            dataset_actions=data,
        )
        if self._before is not None:
            call = self._to_be_repeated(call, one, actions, self._before)
        effects = one.episode._effects
        plumbing = self._look_at_words(one, prompt, actions)
        return record_of(call, stored, actions, run.attributes.recording, effects, inputs.noise_seed, plumbing)

    def _look_at_words(self, one: RowOfCall, prompt: Prompt, actions: NDArray[np.float64] | None) -> Plumbing | None:
        """Return whether the instruction gets through; None where that is not asked of this call."""
        run, inputs = self._run, one.inputs
        if not self._looks:
            return None
        found = look_at_words_heard(
            prompt, inputs.instruction, actions, inputs.repeat, self._before_first, run._embeddings
        )
        if found is not None and (said := found.problem):
            warnings.warn(said, Note)
        elif found is not None and found.why_not and inputs.repeat is not None and run._repeats is None:
            warnings.warn(f"Whether other words change the action was not tried: {found.why_not}.", Note)
        return found

    def _to_be_repeated(
        self, call: PolicyCall, one: RowOfCall, actions: NDArray[np.float64] | None, before: RandomNumbers
    ) -> PolicyCall:
        """Return the call as it is repeated, after telling the policy that is repeated."""
        run, repeat = self._run, one.inputs.repeat
        assert run._repeats is not None
        assert repeat is not None
        if actions is None:
            raise BadArgument(f"Cannot measure effects at {one.where}: its actions are not known. Set replan.actions.")
        given = call.policy_input
        # Sites of which no layer is recorded are changed, too.
        others = [site for site in run.layout.sites if site.name not in given.key_role]
        key_role = self._roles(one.row, others, given.prompt) | dict(given.key_role)
        given = replace(cast(CallInput, given), key_role=key_role, call=repeat.given)
        run._repeats.take(CallToRepeat(repeat, given, before, actions, self.present, one.where))
        return replace(call, policy_input=given)

    def early_roles(self, row: int, site: RecordedSite) -> NDArray[np.uint8]:
        """See `ReplanRecorder`."""
        return self._text.early_roles(row, site)

    def bias(self, row: int, place: CallPlace, shape: CallShape) -> NDArray[np.float32] | None:
        """See `ReplanRecorder`."""
        bias = None if place.site is None else self._bias_of(row)
        return None if bias is None else bias(place, shape)

    def _row_bias(self, row: int) -> CallBias | None:
        one = self._calls[row]
        prompt = self._text.prompt(row, {})
        given = CallInput({}, self._roles(row, self._run._sites, prompt), prompt, NO_STATE, {})
        editors = one.episode._changes.editors(self._run.attributes.sites, given, one.context)
        edits = {site: editor.edits for site, editor in (editors or {}).items()}
        return CallBias(self._run.layout, edits, self.present) if edits else None

    def _roles(self, row: int, sites: Sequence[RecordedSite], prompt: Prompt) -> dict[str, NDArray[np.uint8]]:
        """Return the roles of sites' keys, whatever masks hide."""
        return {site.name: self._text.roles(row, site, prompt) for site in sites}
