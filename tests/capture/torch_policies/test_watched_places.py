"""Only where a policy computed attention before is it watched; nothing that it computes may be lost by that."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.nn.functional import scaled_dot_product_attention as sdpa
from torch.overrides import TorchFunctionMode

from tests.capture.torch_policies.test_session import fill, start, stored
from tests.kit.attention_modules import Policy, Seen
from tests.kit.small_torch_policy import SmallPolicy, given
from vla_attention.capture.recording.finite_numbers import NumbersNotFinite
from vla_attention.capture.torch_policies.policy_modules import find_policy
from vla_attention.capture.torch_policies.site_recorder import RowsDoNotMatch
from vla_attention.capture.torch_policies.watch import AttentionMode, NotFollowed, watch_attention
from vla_attention.capture.torch_policies.watched_places import EVERY, WatchedPlaces


class OwnMode(TorchFunctionMode):
    """A function mode of the policy's own."""

    def __torch_function__(self, func, types, args=(), kwargs=None):
        return func(*args, **(kwargs or {}))


class Steps(nn.Module):
    """Attention in `attend`, called by `forward` between `before` and `after`; `changed` says what a call does else."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.before, self.after, self.late = nn.Linear(8, 8), nn.Linear(8, 8), nn.Linear(8, 8)
        self.changed = ""

    def attend(self, x: Tensor) -> Tensor:
        x = x.view(1, -1, 2, 4).transpose(1, 2)
        return sdpa(x, x, x).transpose(1, 2).flatten(2)

    def forward(self, x: Tensor) -> Tensor:
        with torch.no_grad():
            if self.changed == "earlier":
                x = self.attend(x)
            x = self.before(x)
            if self.changed == "in a mode":
                with OwnMode():
                    x = self.before(x)
                    x = self.attend(x)
            else:
                x = self.attend(x)
            x = self.after(x).relu().sin().cos()
            if self.changed == "after":
                x = self.attend(x)
            return self.attend(self.late(x)) if self.changed == "in another module" else x


@pytest.fixture
def steps():
    policy = Steps()
    return policy, find_policy(policy)


def calls_of(policy, found, changed=""):
    policy.changed, seen = changed, Seen()
    x = torch.ones(1, 3, 8)
    expected = policy(x)
    with watch_attention(found, seen):
        result = policy(x)
    assert torch.equal(result, expected)
    assert torch._C._len_torch_function_stack() == 0
    return seen


def test_functions_elsewhere_do_not_pass_through_python(steps, monkeypatch):
    policy, found = steps
    passed = []
    inside = AttentionMode.__torch_function__

    def counted(self, func, types, args=(), kwargs=None):
        passed.append(getattr(func, "__name__", ""))
        return inside(self, func, types, args, kwargs)

    monkeypatch.setattr(AttentionMode, "__torch_function__", counted)
    names = []
    for _ in range(4):
        passed.clear()
        assert len(calls_of(policy, found).rows) == 1
        names.append(list(passed))
    assert "sin" in names[0]
    assert "sin" not in names[3]
    assert "scaled_dot_product_attention" in names[3]


@pytest.mark.parametrize("changed", ["in another module", "in a mode"])
def test_what_is_new_is_seen_at_once(steps, changed):
    policy, found = steps
    for _ in range(3):
        calls_of(policy, found)
    seen = calls_of(policy, found, changed)
    assert not seen.whole
    assert len(seen.rows) == (2 if changed == "in another module" else 1)


@pytest.mark.parametrize("changed", ["earlier", "after"])
def test_attention_behind_places_that_had_none_is_seen_after_some_calls(steps, changed):
    policy, found = steps
    for _ in range(3):
        calls_of(policy, found)
    numbers = [len(calls_of(policy, found, changed).rows) for _ in range(EVERY)]
    assert numbers[0] == 1
    first = numbers.index(2)
    assert first <= EVERY - 3
    # From there on it is known.
    assert set(numbers[first:]) == {2}


def test_calls_without_attention_teach_nothing():
    places = WatchedPlaces()
    for _ in range(10):
        places.passed({0, 1}, set())
    assert places.next_is_whole()
    assert places.quiet == set()


def test_a_new_place_begins_anew():
    places = WatchedPlaces()
    whole = []
    for call in range(12):
        whole.append(places.next_is_whole())
        places.passed({0, 1, 2}, {1} if call < 5 else {1, 2})
    assert whole == [True] * 3 + [False] * 3 + [True] * 2 + [False] * 4


def test_rows_and_contributions_are_those_of_calls_that_are_watched_throughout(tmp_path, monkeypatch):
    policy = SmallPolicy()
    with start(tmp_path / "narrow", policy, bits=23) as run:
        fill(run, policy, replans=6)
    monkeypatch.setattr(WatchedPlaces, "next_is_whole", lambda self: True)
    with start(tmp_path / "whole", policy, bits=23) as run:
        fill(run, policy, replans=6)
    narrow, whole = (stored(tmp_path / name).episodes[0] for name in ("narrow", "whole"))
    np.testing.assert_array_equal(narrow.read("joint/rows"), whole.read("joint/rows"))
    grams = whole.read("joint/contribution")
    np.testing.assert_allclose(narrow.read("joint/contribution"), grams, atol=1e-5 * np.abs(grams).max(), rtol=0)
    assert narrow.attributes.provenance["watched throughout"].startswith("3 of 6")
    assert whole.attributes.provenance["watched throughout"].startswith("6 of 6")


def test_a_mask_that_changes_from_step_to_step_is_followed(tmp_path):
    """Whole keys are hidden in later calls, which the recorder reads from the mask of those calls."""
    policy = SmallPolicy()
    with (
        start(tmp_path, policy, bits=23) as run,
        run.episode(task_id=0, episode_index=0, instruction="pick the bowl") as episode,
    ):
        for step, text in enumerate(["pick the bowl"] * 4 + ["pick"]):
            with episode.replan(env_step=step, instruction=text) as replan:
                replan.actions = policy.act(**given(text=text))
    rows = stored(tmp_path).episodes[0].read("joint/rows")
    seen = (rows > 0).any(axis=(1, 2, 3, 4))
    assert seen[3].sum() - seen[4].sum() == 2


def test_dropout_that_begins_later_is_refused(tmp_path, monkeypatch):
    policy = SmallPolicy()
    kernel = nn.functional.scaled_dot_product_attention
    with (  # noqa: PT012
        start(tmp_path, policy) as run,
        pytest.raises(RowsDoNotMatch, match="dropout"),
        run.episode(task_id=0, episode_index=0, instruction="pick the bowl") as episode,
    ):
        for step in range(5):
            if step == 4:
                monkeypatch.setattr(nn.functional, "scaled_dot_product_attention", dropping(kernel))
            with episode.replan(env_step=step) as replan:
                replan.actions = policy.act(**given())


def dropping(kernel):
    return lambda *args, **kwargs: kernel(*args, **kwargs, dropout_p=0.5)


def test_numbers_that_are_not_finite_later_are_refused(tmp_path):
    policy = SmallPolicy()
    with (  # noqa: PT012
        start(tmp_path, policy) as run,
        pytest.raises(NumbersNotFinite),
        run.episode(task_id=0, episode_index=0, instruction="pick the bowl") as episode,
    ):
        for step in range(5):
            if step == 4:
                policy.blocks[1].attention.qkv.weight.data.fill_(float("nan"))
            with episode.replan(env_step=step) as replan:
                replan.actions = policy.act(**given())


def test_modules_in_another_order_are_seen_as_themselves():
    torch.manual_seed(0)
    policy = Policy(sdpa, layers=3).eval().requires_grad_(False)
    found, hidden = find_policy(policy), torch.randn(1, 5, 32)
    for _ in range(3):
        with watch_attention(found, Seen()):
            policy(hidden, hidden)
    wanted, seen, layers = {}, Seen(), list(policy.layers)
    with watch_attention(found, seen):
        for number in (2, 0, 1):
            wanted[f"layers.{number}"] = hidden
            hidden = layers[number](hidden, hidden)
    assert not seen.whole
    assert [shape.module for shape in seen.shapes] == ["layers.2", "layers.0", "layers.1"]
    for shape, rows in zip(seen.shapes, seen.rows, strict=True):
        alone = Seen()
        with watch_attention(policy, alone):
            policy.layers[int(shape.module[-1])](wanted[shape.module], wanted[shape.module])
        assert torch.equal(rows, alone.rows[0])


def test_another_thread_is_noticed_later(tmp_path):
    policy = SmallPolicy()
    with (  # noqa: PT012
        start(tmp_path, policy) as run,
        ThreadPoolExecutor(1) as pool,
        pytest.raises(NotFollowed),
        run.episode(task_id=0, episode_index=0, instruction="pick the bowl") as episode,
    ):
        for step in range(5):
            with episode.replan(env_step=step):
                policy.act(**given())
                if step == 4:
                    pool.submit(policy.act, **given()).result()
