"""Attention functions under their names and otherwise: both ways see the same calls, and leave nothing behind."""

from __future__ import annotations

import pytest
import torch
from torch import nn
from torch.nn import functional
from torch.nn.functional import scaled_dot_product_attention as imported_by_name
from torch.overrides import TorchFunctionMode, _get_current_function_mode_stack

import vla_attention as va
from tests.capture.torch_policies.test_odd_policies import OddPolicy, layout
from tests.kit.attention_modules import Attention, Policy, Seen
from vla_attention.capture.torch_policies import seen_functions
from vla_attention.capture.torch_policies.watch import watch_attention
from vla_attention.schemas.stores.reader import open_store

HIDDEN, MEMORY = torch.randn(2, 5, 32), torch.randn(2, 7, 32)
NAMES = [(owner, name, getattr(owner, name)) for owner, name in seen_functions._NAMES]


def by_hand(query, key, value, mask):
    return functional.softmax(query @ key.transpose(-1, -2), dim=-1) @ value


def small_policy(attend, **options):
    torch.manual_seed(0)
    return Policy(attend, **options).eval().requires_grad_(False)


def nothing_left():
    return all(getattr(owner, name) is before for owner, name, before in NAMES) and not any(
        isinstance(mode, seen_functions._EveryFunction) for mode in _get_current_function_mode_stack()
    )


class Scaled(TorchFunctionMode):
    """A mode of the policy's own; it counts the functions that it sees."""

    def __init__(self) -> None:
        super().__init__()
        self.count = 0

    def __torch_function__(self, func, types, args=(), kwargs=None):
        self.count += 1
        return func(*args, **(kwargs or {}))


@pytest.mark.parametrize("place", ["around both", "left before the product"])
def test_modes_of_the_policy_stay_as_they_are(place):
    """They are entered and left while a softmax is followed, and leave the stack from its top."""

    def attend(query, key, value, mask):
        logits, mode = query @ key.transpose(-1, -2), Scaled()
        if place == "around softmax":
            with mode:
                rows = logits.softmax(-1)
            mixed = rows @ value
        elif place == "around product":
            rows = logits.softmax(-1)
            with mode:
                mixed = rows @ value
        elif place == "around both":
            with mode:
                mixed = logits.softmax(-1) @ value
        else:
            with mode, torch.device("cpu"):
                rows = logits.softmax(-1)
                rows = rows.to(torch.float32)
            mixed = rows @ value
        counts.append(mode.count)
        stacks.append(list(_get_current_function_mode_stack()))
        return mixed

    counts: list[int] = []
    stacks: list[list[object]] = []
    policy, seen = small_policy(attend), Seen()
    expected = policy(HIDDEN, MEMORY)
    with watch_attention(policy, seen, every_function=False):
        assert torch.equal(policy(HIDDEN, MEMORY), expected)
    assert len(seen.shapes) == 2
    assert min(counts[2:]) >= min(counts[:2]) > 0
    assert not any(isinstance(mode, Scaled) for modes in stacks for mode in modes)
    assert nothing_left()
    assert not _get_current_function_mode_stack()


def test_an_error_of_the_policy_leaves_nothing_behind():
    def fails(query, key, value, mask):
        torch.softmax(query @ key.transpose(-1, -2), -1)
        raise RuntimeError("no memory")

    for every_function in (True, False):
        policy = small_policy(fails)
        with (
            pytest.raises(RuntimeError, match="no memory"),
            watch_attention(policy, Seen(), every_function=every_function),
        ):
            policy(HIDDEN, MEMORY)
        assert nothing_left()


@pytest.mark.parametrize(("function", "ways"), [(None, [True, False] * 2), (imported_by_name, [True] * 4)])
def test_a_session_looks_at_every_function_until_it_knows_better(tmp_path, monkeypatch, function, ways):
    """At the first policy call of each episode, and always where a policy calls functions by other names."""
    asked: list[bool] = []
    own = seen_functions.SeenFunctions.__init__

    def noted(self, block, *, every_function):
        asked.append(every_function)
        own(self, block, every_function=every_function)

    monkeypatch.setattr(seen_functions.SeenFunctions, "__init__", noted)
    policy = OddPolicy(lambda block, *given: (function or functional.scaled_dot_product_attention)(*given))
    expected = policy.act()
    with (
        va.record(tmp_path / "a.zarr", policy, layout=layout(), bits=23, queries="all", durable=False) as run,
        run.episodes([{"task_id": 0, "episode_index": 0, "instruction": ""}]) as episodes,
    ):
        for number in range(2):
            for step in range(2):
                with episodes.replan(env_step=[step]):
                    assert torch.equal(policy.act(), expected)
            if number == 0:
                episodes.next_episode(0, task_id=0, episode_index=1, instruction="")
    assert asked == ways
    rows = [episode.read("joint/rows") for episode in open_store(tmp_path / "a.zarr").episodes]
    assert all((one == rows[0][0]).all() for episode in rows for one in episode)


def test_a_module_that_attends_counts_its_own_end():
    """The block is the last module: its end takes the mode away."""
    policy, seen = Attention(by_hand).eval(), Seen()
    policy.o_proj = nn.Identity()
    with watch_attention(policy, seen, every_function=False):
        policy(HIDDEN, MEMORY)
        assert not _get_current_function_mode_stack()
    assert len(seen.shapes) == 1
