"""Does the instruction get through to the model? Looked at in one episode of each task, at its first policy call."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from msgspec import structs

from vla_attention.capture.engine.call import Caller, PolicyCall, RecordedCall
from vla_attention.capture.policies.policy import PolicyInput, UnitsPolicy
from vla_attention.capture.policies.random_numbers import RandomNumbers
from vla_attention.capture.recording.finite_numbers import NumbersNotFinite
from vla_attention.schemas.errors import UserError
from vla_attention.schemas.groupings.words import folded_words
from vla_attention.schemas.layout import Prompt
from vla_attention.schemas.plumbing import Plumbing

#: Short, so that it is not cut, and without a word of a task of the standard suites.
WHOLLY_DIFFERENT = "wave hello twice"


def look_at_words(
    caller: Caller, calls: Sequence[PolicyCall], made: Sequence[RecordedCall | NumbersNotFinite], row: int
) -> Plumbing | None:
    """Make a call of a batch once more with a wholly different instruction, and hold the rows against single calls.

    None where the call gave no numbers. Nothing of it is recorded, and the random numbers are as before: the run's
    actions are the same to the bit.
    """
    first = made[row]
    if not isinstance(first, RecordedCall):
        return None
    before = RandomNumbers()
    counted = caller.changes.num_replans, caller.changes.num_empty
    try:
        return structs.replace(_changed(caller, calls[row], first), row_of_another=_row_of_another(caller, calls, made))
    finally:
        before.again()
        caller.changes.num_replans, caller.changes.num_empty = counted


def unread_words(prompt: Prompt, instruction: str) -> tuple[str, ...]:
    """Return the words of an instruction that are not in what the prompt's tokens spell; none where it has no tokens.

    A prompt with tokens of which none belongs to an instruction leaves all of them unread.
    """
    if not prompt.pieces:
        return ()
    read = folded_words(prompt.text[prompt.pieces[0].start : max(piece.stop for piece in prompt.pieces)])
    return tuple(word for word in dict.fromkeys(folded_words(instruction)) if word not in read)


def _changed(caller: Caller, call: PolicyCall, made: RecordedCall) -> Plumbing:
    given, policy = call.policy_input, caller.policy
    found = Plumbing(given.prompt.instruction_text, unread=unread_words(given.prompt, given.prompt.instruction_text))
    other, exchanged, why_not = _exchanged(caller, given)
    if exchanged is None:
        return structs.replace(found, why_not=why_not)
    try:
        (again,) = caller.make([replace(call, policy_input=exchanged)])
    except UserError as error:  # words that the run knocks out are not in the other sentence
        return structs.replace(found, why_not=f"the call with '{other}' cannot be made: {error}")
    if not isinstance(again, RecordedCall):
        return structs.replace(found, why_not=f"the call with '{other}' gave numbers that are not finite")
    units = policy.action_units() if isinstance(policy, UnitsPolicy) else np.ones(made.actions.shape[-1])
    change = (again.actions - made.actions) / np.where(units == 0, 1.0, units)
    differences = [np.abs(again.rows[site].rows - rows.rows).max(initial=0.0) for site, rows in made.rows.items()]
    return structs.replace(
        found,
        other=other,
        input_changed=_is_another(given, exchanged),
        rows_changed=float(max(differences)),
        action_changed=float(np.sqrt(np.mean(change**2))),
    )


def _exchanged(caller: Caller, given: PolicyInput) -> tuple[str, PolicyInput | None, str]:
    """Return the call's input with another instruction; another task's where the policy knows the tasks' alone."""
    why_not = ""
    mine = given.prompt.instruction_text
    tasks = [text for text in dict.fromkeys(caller.changes.instructions.values()) if text != mine]
    tasks.sort(key=lambda text: len({*text.split()} & {*mine.split()}))
    for other in (WHOLLY_DIFFERENT, *tasks[:1]):
        try:
            return other, caller.policy.prepare_again(replace(given.given, instruction=other)), ""
        except UserError as error:  # no encoding of it is there
            why_not = why_not or str(error)
    return "", None, why_not


def _is_another(one: PolicyInput, other: PolicyInput) -> bool:
    """Whether two inputs have different tensors."""
    return any(
        values.shape != other.tensors[name].shape or not torch.equal(values, other.tensors[name])
        for name, values in one.tensors.items()
    )


def _row_of_another(
    caller: Caller, calls: Sequence[PolicyCall], made: Sequence[RecordedCall | NumbersNotFinite]
) -> bool | None:
    """Whether the first row that has another instruction than row 0 was answered as if it had row 0's."""
    first = calls[0].policy_input.prompt.instruction_text
    place = next((i for i, one in enumerate(calls) if one.policy_input.prompt.instruction_text != first), None)
    if place is None:
        return None
    call, answered = calls[place], made[place]
    if not isinstance(answered, RecordedCall):
        return None
    mixed = caller.policy.prepare_again(replace(call.policy_input.given, instruction=first))
    try:
        ways = [caller.make([one])[0] for one in (call, replace(call, policy_input=mixed))]
    except UserError:  # as in `_changed`
        return None
    away = [np.abs(way.actions - answered.actions).max() for way in ways if isinstance(way, RecordedCall)]
    return None if len(away) < len(ways) or away[0] == away[1] else bool(away[1] < away[0])
