"""Small policies with a state: noise from random numbers, a queue of actions, an array that calls write to."""

from __future__ import annotations

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
    """Draws from a generator of its own."""

    def __init__(self) -> None:
        super().__init__()
        self.generator = torch.Generator().manual_seed(4)

    def noise(self) -> Tensor:
        return torch.randn(1, HORIZON, 2, generator=self.generator)


class BufferPolicy(SamplingPolicy):
    """Returns the same array at every call, with other numbers."""

    def __init__(self) -> None:
        super().__init__()
        self.buffer = np.zeros((HORIZON, 2))

    def sample(self, pictures: Tensor, texts: list[str], states: Tensor) -> Any:
        self.buffer[:] = super().sample(pictures, texts, states)[0].numpy()
        return self.buffer


class QueuePolicy(SamplingPolicy):
    """Answers from a queue, as LeRobot's policies do."""

    def __init__(self) -> None:
        super().__init__()
        self.queue: deque[Tensor] = deque(maxlen=HORIZON)

    def sample(self, pictures: Tensor, texts: list[str], states: Tensor) -> Tensor:
        if not self.queue:
            self.queue.extend(super().sample(pictures, texts, states).transpose(0, 1))
        return self.queue.popleft()
