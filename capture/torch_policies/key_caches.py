"""Caches whose keys have no place of their own: sliding ones, whose first keys leave, and static ones that fill up.

A layout names keys by their position, which is the same in every call of a replan. Both kinds are told by what the
calls of one module are given, one after another, and not by a cache's class.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, field

import torch
from torch import Tensor

from vla_attention.capture.torch_policies.attention_calls import AttentionCall

LOAD_WITH_DYNAMIC_CACHE = (
    "load the policy with a dynamic cache, which keeps all keys and has no empty ones (in transformers: "
    "cache_implementation=None, and no sliding_window)"
)


@dataclass
class _Calls:
    """Of the calls of one block: their numbers of keys; the last one's first values, and keys that its query may see.

    seen: (batch, key) bool; None after a call of several queries.
    """

    keys: list[int] = field(default_factory=list)
    first: Tensor | None = None
    seen: Tensor | None = None


class KeyCaches:
    """Follows the keys of each block, or module, from call to call."""

    def __init__(self) -> None:
        self._blocks: defaultdict[object, _Calls] = defaultdict(_Calls)

    def problem(self, call: AttentionCall, block: object) -> str:
        """Return why no layout can name the keys of the next call of a block, in words; "" where one can."""
        shape, calls = call.shape, self._blocks[block]
        calls.keys.append(shape.keys)
        before, calls.first = calls.first, call.value[:, :, :2].detach().clone()
        seen_before, calls.seen = calls.seen, call.allowed()[:, 0] if shape.queries == 1 else None
        if before is None or calls.seen is None:
            return ""
        now, first = calls.first, before[:, :, 0]
        two = before.shape == now.shape and before.shape[2] > 1
        if two and torch.equal(now[:, :, 0], before[:, :, 1]) and not torch.equal(now[:, :, 0], first):
            return (
                f"its cache of {shape.keys} keys loses its first key at each call (a sliding window), so that no key "
                f"has a place of its own: {LOAD_WITH_DYNAMIC_CACHE}"
            )
        others = [keys for keys in calls.keys if keys != shape.keys]
        if seen_before is None or seen_before.shape != calls.seen.shape or not others:
            return ""
        if bool((calls.seen & ~seen_before).any()) and not bool((seen_before & ~calls.seen).any()):
            return (
                f"its static cache fills up: the calls have {shape.keys} keys, some of them empty, and an earlier one "
                f"had {others[0]} without the empty ones: {LOAD_WITH_DYNAMIC_CACHE}"
            )
        return ""
