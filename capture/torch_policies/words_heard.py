"""Does the instruction get through to a policy of the caller? Looked at once, at the first recorded call of a run."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from msgspec import structs
from numpy.typing import NDArray
from torch import nn

from vla_attention.capture.effects.measurement import MOST_DIFFERENCE
from vla_attention.capture.engine.plumbing import WHOLLY_DIFFERENT, unread_words
from vla_attention.capture.policies.random_numbers import RandomNumbers
from vla_attention.capture.torch_policies.replan_inputs import Repeat, RepeatedCall, read_actions
from vla_attention.capture.torch_policies.replan_text import PromptIds
from vla_attention.schemas.layout import Prompt
from vla_attention.schemas.plumbing import Plumbing


def look_at_words_heard(
    prompt: Prompt,
    told: str,
    actions: NDArray[np.float64] | None,
    repeat: Repeat | None,
    before: RandomNumbers | None,
    embeddings: Mapping[str, nn.Module],
) -> Plumbing | None:
    """Make a call again, unchanged and with a wholly different instruction; None where nothing can be looked at.

    Args:
        prompt, told: of the recorded call; a prompt without pieces shows nothing.
        actions: (horizon, action dim) that it gave.
        repeat, before: makes it again, and the random numbers before it; None where it cannot be made again.
        embeddings: of the policy; what the prompt's one is given is the model's text input.
    """
    found = Plumbing(told, unread=unread_words(prompt, told))
    if repeat is None or before is None or not repeat.takes_call or actions is None:
        why_not = "a call is made again where replan(repeat=lambda call: ...) says how"
        return structs.replace(found, why_not=why_not) if prompt.pieces else None
    after = RandomNumbers()

    def made(instruction: str) -> tuple[NDArray[np.float64], NDArray[np.int64] | None]:
        before.again()
        ids = PromptIds(embeddings, 1)
        with ids.watched():
            given = read_actions(repeat.call(RepeatedCall(instruction, repeat.given.frames)))
        if given is None or given.shape != actions.shape:
            raise ValueError("it returned no actions of the recorded shape")
        return given, ids.ids

    try:
        (again, ids), (changed, other_ids) = made(told), made(WHOLLY_DIFFERENT)
        last, _ = made(told)  # what the other sentence left in the policy is overwritten, and seen
    except Exception as error:  # of the caller's code: an episode never fails for it
        return structs.replace(found, why_not=f"the callable given as repeat failed ({type(error).__name__}: {error})")
    finally:
        after.again()
    away = max(np.abs(one - actions).max() for one in (again, last))
    if not away <= MOST_DIFFERENCE * max(1.0, float(np.abs(actions).max())):
        return structs.replace(found, why_not="the callable given as repeat gives other actions without a change")
    another = None if ids is None or other_ids is None else not np.array_equal(ids, other_ids)
    change = float(np.sqrt(np.mean((changed - actions) ** 2)))
    return structs.replace(found, other=WHOLLY_DIFFERENT, input_changed=another, action_changed=change)
