"""The difference between a policy call as its user makes it and as it is recorded.

Recording runs compiled code eager and switches the fast path of `nn.MultiheadAttention` off: actions may then differ
in their last digits from those of the user's own setting. A call is made both ways, with the same random numbers.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from vla_attention.capture.torch_policies.attention_calls import AttentionCall, CallShape
from vla_attention.capture.torch_policies.watch import RandomNumbers, watch_attention
from vla_attention.schemas.errors import BadArgument


class CannotCompare(BadArgument):
    """A call whose results cannot be compared."""


@dataclass(frozen=True)
class OwnSettingDifference:
    """How far the results of a call are apart: the largest difference, and the largest number of the user's setting."""

    largest_difference: float
    largest_result: float

    def __str__(self) -> str:
        if self.largest_difference == 0:
            return "none (bit-equal)"
        return f"at most {self.largest_difference:.3g}, where the largest number is {self.largest_result:.3g}"


class _Silent:
    """A watcher that keeps nothing; it counts."""

    count = 0

    def change(self, shape: CallShape) -> None:
        return None

    def saw(self, call: AttentionCall) -> None:
        self.count += 1


def difference_to_own_setting(policy: object, call: Callable[[], Any]) -> OwnSettingDifference:
    """Make a policy call in the user's own setting and as it is recorded, and return the difference of the results.

    call: can be repeated; it returns the actions, as a tensor or an array, or several in lists or dictionaries. The
    states of torch's random numbers are as before the first call afterwards.

    Raises:
        CannotCompare: the call returns no numbers, another number of them the second time, or makes no attention call.
    """
    random, watcher = RandomNumbers(), _Silent()
    try:
        plain = arrays_of(call())
        random.again()
        with watch_attention(policy, watcher):
            recorded = arrays_of(call())
    finally:
        random.again()
    if not watcher.count:
        raise CannotCompare(
            "The call given as own_setting made no attention call when it was repeated: a policy that answers from a "
            "queue must be reset in it, as lambda: (policy.reset(), policy.select_action(batch))[1]."
        )
    if not plain or [values.shape for values in plain] != [values.shape for values in recorded]:
        raise CannotCompare(
            f"The call given as own_setting returned arrays of the shapes {[values.shape for values in plain]}, and "
            f"{[values.shape for values in recorded]} when it was repeated; it must return the actions, and always as "
            "many."
        )
    differences = [np.abs(a - b).max(initial=0) for a, b in zip(plain, recorded, strict=True)]
    if any(math.isnan(value) for value in differences):
        raise CannotCompare("The call given as own_setting returned NaN.")
    return OwnSettingDifference(float(max(differences)), float(max(np.abs(values).max(initial=0) for values in plain)))


def arrays_of(result: Any) -> list[NDArray[np.float64]]:
    """Return the arrays of a policy call's result, as float64, in their order."""
    if isinstance(result, torch.Tensor):
        return [result.detach().double().cpu().numpy()]
    if isinstance(result, np.ndarray):
        return [result.astype(np.float64)]
    if isinstance(result, (list, tuple)) and result and all(isinstance(value, (int, float)) for value in result):
        return [np.array(result, dtype=np.float64)]
    inside = result.values() if isinstance(result, Mapping) else result if isinstance(result, (list, tuple)) else ()
    return [array for value in inside for array in arrays_of(value)]
