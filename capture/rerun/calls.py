"""One stored policy call, made again: the same input and noise, or those that interventions make of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

from vla_attention.capture.interventions.changed_inputs import changed_inputs
from vla_attention.capture.interventions.run_changes import RunChanges
from vla_attention.capture.policies.policy import Policy, PolicyInput
from vla_attention.capture.rerun.stored_calls import StoredCalls
from vla_attention.capture.rollout.policy_call import RecordedCall, record_call
from vla_attention.schemas.interventions import Interventions
from vla_attention.schemas.stores.store_format import Recording


@dataclass(frozen=True)
class Repeater:
    """Makes stored policy calls again.

    interventions: what is changed, with block indices for layers. instructions: of the store's tasks, by task id.
    allow_empty: leave calls unchanged in which a group has no key, or an object is out of view.
    """

    policy: Policy
    recording: Recording
    interventions: Interventions = field(default_factory=Interventions)
    instructions: Mapping[int, str] = field(default_factory=dict)
    allow_empty: bool = False

    @cached_property
    def attention(self) -> RunChanges:
        """The changes of attention; it counts the calls without any."""
        return RunChanges(self.interventions, self.instructions, self.allow_empty)

    def prepare(self, calls: StoredCalls, replan: int) -> PolicyInput:
        """Return the model's input of a call."""
        given, policy = calls.given(replan), self.policy
        if self.interventions.changes_input:
            context = calls.context(replan, self.instructions)
            given = changed_inputs(given, self.interventions, policy.sites, context, allow_empty=self.allow_empty)
        return policy.prepare_again(given)

    def noise_seed(self, calls: StoredCalls, replan: int) -> int:
        """Return the seed of a call's noise."""
        noise, attributes = self.interventions.noise, calls.attributes
        if noise is None:
            return int(calls.noise_seed[replan])
        return self.policy.replan_noise_seed(noise.seed, attributes.task_id, attributes.episode_index, replan)

    def call(self, calls: StoredCalls, replan: int, policy_input: PolicyInput) -> RecordedCall:
        """Call the policy."""
        context = calls.context(replan, self.instructions)
        editors = self.attention.editors(self.policy.sites, policy_input, context)
        where = f"replan {replan} (environment step {calls.env_step[replan]}) of the rerun of {calls.episode.name}"
        return record_call(self.policy, policy_input, self.noise_seed(calls, replan), self.recording, where, editors)
