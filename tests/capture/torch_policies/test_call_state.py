"""What a policy call may change is put back: in the policy, and in what the repeated call names."""

from __future__ import annotations

import random
from collections import deque

import numpy as np
import pytest
import torch
from torch import nn

from vla_attention.capture.torch_policies.call_state import CallState

NOISE = torch.Generator()


class Runner:
    """A loop of the caller that holds the queue and the generator beside the policy."""

    def __init__(self) -> None:
        self.policy = nn.Linear(2, 2)
        self.queue = deque([1, 2, 3], maxlen=3)
        self.stream = random.Random(1)
        self.answers = {"first": [1]}

    def act(self) -> float:
        self.queue.append(4)
        self.answers["first"].append(2)
        self.answers["second"] = []
        return self.stream.random()


def called(runner: Runner):
    return {
        "method": runner.act,
        "closure": lambda: runner.act(),
    }


@pytest.mark.parametrize("kind", called(Runner()))
def test_what_a_repeated_call_names_is_put_back(kind):
    runner = Runner()
    call = called(runner)[kind]
    state = CallState(runner.policy, call)
    first = call()
    assert (list(runner.queue), runner.answers) == ([2, 3, 4], {"first": [1, 2], "second": []})
    state.again()
    assert (list(runner.queue), runner.answers) == ([1, 2, 3], {"first": [1]})
    assert call() == first


def drawn() -> float:
    return torch.rand(1, generator=NOISE).item()


@pytest.mark.parametrize("call", [drawn, lambda: drawn(), lambda: torch.rand(1, generator=NOISE).item()])
def test_global_generators_that_a_call_names_are_put_back_and_seeded(call):
    state = CallState(nn.Linear(1, 1), call)
    first = call()
    state.again()
    assert call() == first
    seeded = []
    for seed in (2, 2, 3):
        state.again()
        state.reseed(seed)
        seeded.append((call(), torch.rand(1).item(), np.random.rand(), random.random()))  # noqa: NPY002
    assert seeded[0] == seeded[1]
    assert all(a != b for a, b in zip(seeded[1], seeded[2], strict=True))


class Held(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("count", torch.zeros(2))
        self.inner = nn.ModuleList([nn.Linear(2, 2)])
        self.inner[0].seen = {1}
        self.array = np.zeros(2)
        self.pair = (torch.zeros(1), [deque([torch.zeros(1)])])
        with torch.inference_mode():
            self.inference = torch.zeros(1)

    def change(self) -> None:
        self.count += 1
        self.inner[0].seen.add(2)
        self.array[0] = 1
        self.pair[0].fill_(2)
        self.pair[1][0][0].fill_(3)
        with torch.inference_mode():
            self.inference.fill_(3)
        self.new = 3
        self.inner[0].weight.data.add_(0)

    def numbers(self) -> list[object]:
        tensors = (self.count, self.pair[0], self.pair[1][0][0], self.inference)
        return [*(tensor.tolist() for tensor in tensors), self.array.tolist(), self.inner[0].seen, hasattr(self, "new")]


@pytest.mark.parametrize("as_method", [False, True])
def test_numbers_and_attributes_of_a_policy_are_put_back(as_method):
    policy = Held()
    before, weights = policy.numbers(), [id(weight) for weight in policy.parameters()]
    versions = [weight._version for weight in policy.parameters()]
    state = CallState(policy.change if as_method else policy, lambda: None)
    policy.change()
    assert policy.numbers() != before
    state.again()
    assert policy.numbers() == before
    assert [id(weight) for weight in policy.parameters()] == weights
    # Weights are neither kept nor written: a run notices where they are.
    assert [weight._version for weight in policy.parameters()] == versions
