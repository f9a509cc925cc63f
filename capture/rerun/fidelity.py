"""How far policy calls made again are from the stored ones, with nothing changed."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from msgspec import structs
from numpy.typing import NDArray

from vla_attention.capture.engine.call import Caller
from vla_attention.capture.policies.policy import PolicyInput
from vla_attention.capture.recording.finite_numbers import NumbersNotFinite
from vla_attention.capture.rerun.base_store import machine_differences
from vla_attention.capture.rerun.stored_calls import StoredCalls
from vla_attention.schemas.errors import listing
from vla_attention.schemas.precision import FLOAT32_MANTISSA_BITS, as_read
from vla_attention.schemas.stores.store_format import Recording, StoreError

#: Called with the number of policy calls done.
CallReport = Callable[[int], None]


class InputsDiffer(StoreError):
    """What is prepared again is not what the store says that the policy read."""


@dataclass(frozen=True)
class Fidelity:
    """Differences between policy calls made again and the stored ones.

    episode: its name. replans: number of calls. actions: largest absolute difference, in the environment's units.
    actions_relative: the same in units of the stored actions' standard deviation, each dimension in its own; infinite
    where a dimension that never changed differs. rows: largest absolute difference of stored probabilities.
    rows_changed: share of them that differ. mantissa_bits: precision of the stored ones. reasons: what is known to
    differ between the two machines.
    """

    episode: str
    replans: int
    actions: float
    actions_relative: float
    rows: float
    rows_changed: float
    mantissa_bits: int
    reasons: tuple[str, ...] = ()

    @property
    def bit_equal(self) -> bool:
        """Whether all actions and all rows are those of the store."""
        return self.actions == 0 and self.rows == 0

    def describe(self) -> str:
        """Return the result in words, one or two lines."""
        what = f"Check: {self.replans} policy calls of {self.episode}, made again without any change"
        bits = self.mantissa_bits
        stored = "exact" if bits >= FLOAT32_MANTISSA_BITS else f"stored with {bits} bits"
        if self.bit_equal:
            return f"{what}: bit-equal, actions and rows ({stored})."
        relative = f"{self.actions_relative:.2g}" if np.isfinite(self.actions_relative) else "more than any part"
        why = listing(self.reasons) if self.reasons else "nothing that the store knows of"
        return (
            f"{what}: NOT bit-equal. Actions differ by at most {self.actions:.3g} of the environment's units "
            f"({relative} of their standard deviation), rows by at most {self.rows:.3g} of probability "
            f"({100 * self.rows_changed:.2g} % of the numbers, {stored}).\n"
            f"Between the capture and now differ: {why}."
        )


def check_fidelity(
    unchanged: Caller,
    recording: Recording,
    calls: StoredCalls,
    num_replans: int,
    machine: Mapping[str, str],
    report: CallReport = lambda done: None,
) -> Fidelity:
    """Make the first `num_replans` calls of an episode again, unchanged, and compare.

    unchanged: makes calls as they were. recording: of the store. machine: provenance of this process.

    Raises:
        InputsDiffer: the prompt or the roles of the keys are other ones.
    """
    # Contributions are recorded beside the calls, and do not change them.
    caller = replace(unchanged, recording=structs.replace(recording, contributions=False))
    num_replans = min(num_replans, calls.num_replans)
    actions, largest, changed, count = [], 0.0, 0, 0
    for replan in range(num_replans):
        again = calls.again(caller, replan)
        check_same_tokens(calls, replan, again.policy_input)
        (call,) = caller.make([again])
        if isinstance(call, NumbersNotFinite):
            raise call
        actions.append(call.actions)
        for site, recorded in call.rows.items():
            stored = calls.episode.read(f"{site}/rows", replan)
            difference = np.abs(as_read(recorded.rows, recording.mantissa_bits) - stored)
            largest = max(largest, float(difference.max()))
            changed, count = changed + int(np.count_nonzero(difference)), count + difference.size
        report(replan + 1)
    absolute, relative = _action_differences(np.stack(actions), calls.actions)
    return Fidelity(
        episode=calls.episode.name,
        replans=num_replans,
        actions=absolute,
        actions_relative=relative,
        rows=largest,
        rows_changed=changed / count,
        mantissa_bits=recording.mantissa_bits,
        reasons=tuple(machine_differences(calls.attributes.provenance, machine)),
    )


def check_same_tokens(calls: StoredCalls, replan: int, policy_input: PolicyInput) -> None:
    """Raise `InputsDiffer` unless prompt and roles of an unchanged call are those of the store."""
    episode, index = calls.episode, calls.prompt_index[replan]
    if policy_input.prompt != calls.attributes.prompts[index]:
        raise InputsDiffer(
            f"Replan {replan} of {episode.name} gets the prompt {policy_input.prompt.text!r} in other pieces than the "
            "stored one; the tokenizer or the prompt's format is another one than that of the capture."
        )
    for site, roles in policy_input.key_role.items():
        if not np.array_equal(roles, episode.read(f"{site}/key_role", replan)):
            raise InputsDiffer(
                f"Replan {replan} of {episode.name} gives keys of site '{site}' other roles than the stored ones; the "
                "store was made by another version of this program, which it names in its provenance."
            )


def _action_differences(again: NDArray[np.float64], stored: NDArray[np.float64]) -> tuple[float, float]:
    """Return the largest difference of actions (replan, horizon, dim), absolute and in standard deviations.

    again: the first replans. stored: all replans of the episode, which give the standard deviation of each dimension.
    """
    difference = np.abs(again - stored[: len(again)]).max(axis=(0, 1))
    spread = stored.std(axis=(0, 1))
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = np.where(difference == 0, 0.0, difference / spread)
    return float(difference.max()), float(relative.max())
