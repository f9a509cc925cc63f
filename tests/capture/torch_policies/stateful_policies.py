"""Small policies with a state: noise from generators of every kind, a queue of actions, numbers that calls write to."""

from __future__ import annotations

import random
from collections import deque
from typing import Any

import numpy as np
import torch
from msgspec.structs import replace
from torch import Tensor

from tests.kit.small_torch_policy import HORIZON, PROMPT, SmallPolicy, small_layout
from vla_attention.capture.torch_policies.policy_layout import CallRule, PolicyLayout


def layout_with_prefix(**changes: Any) -> PolicyLayout:
    """The layout of `SmallPolicy`, which says that its pass over the prefix has the tokens of the site."""
    layout = small_layout(**changes)
    prefix = CallRule(r"blocks\.\d+\.attention", None, queries=5 + PROMPT, tokens="joint")
    return replace(layout, rules=(layout.rules[0], prefix))


class SamplingPolicy(SmallPolicy):
    """Draws its own noise from torch's global numbers."""

    def sample(self, pictures: Tensor, texts: list[str], states: Tensor) -> Tensor:
        return self.act(pictures, texts, states, self.noise())

    def noise(self) -> Tensor:
        return torch.randn(1, HORIZON, 2)


class GeneratorPolicy(SamplingPolicy):
    """Draws from generators of its own, of three libraries, and from numpy's and Python's global numbers."""

    def __init__(self) -> None:
        super().__init__()
        self.generator = torch.Generator().manual_seed(4)
        self.others: dict[str, Any] = {"numpy": [np.random.default_rng(4)], "old": np.random.RandomState(4)}
        self.python = random.Random(4)

    def noise(self) -> Tensor:
        drawn = self.others["numpy"][0].normal() + self.others["old"].normal() + self.python.gauss(0, 1)
        drawn += np.random.normal() + random.gauss(0, 1)  # noqa: NPY002
        return torch.randn(1, HORIZON, 2, generator=self.generator) + drawn


class BufferPolicy(SamplingPolicy):
    """Returns the same array at every call, with other numbers."""

    def __init__(self) -> None:
        super().__init__()
        self.buffer = np.zeros((HORIZON, 2))

    def sample(self, pictures: Tensor, texts: list[str], states: Tensor) -> Any:
        self.buffer[:] = super().sample(pictures, texts, states)[0].numpy()
        return self.buffer


class QueuePolicy(SamplingPolicy):
    """Answers from a queue, as LeRobot's policies do; counts its calls in a buffer, in a list and in an attribute."""

    def __init__(self) -> None:
        super().__init__()
        self.queues = {"action": deque(maxlen=HORIZON)}
        self.register_buffer("count", torch.zeros(()))
        self.calls: list[int] = []
        self.last: Tensor | None = None

    def sample(self, pictures: Tensor, texts: list[str], states: Tensor) -> Tensor:
        queue = self.queues["action"]
        if not queue:
            # Earlier calls decide about later ones, in a tensor that is written in place.
            actions = super().sample(pictures, texts, states) * (1 + self.count)
            queue.extend(actions.transpose(0, 1))
            self.count += 1
            self.calls.append(len(self.calls))
            self.last = actions
        return queue.popleft()

    def reset(self) -> None:
        self.queues["action"].clear()
