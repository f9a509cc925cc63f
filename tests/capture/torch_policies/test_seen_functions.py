"""Attention functions under their names and otherwise: both ways see the same calls, and leave nothing behind."""

from __future__ import annotations

from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.functional import scaled_dot_product_attention as imported_by_name
from torch.overrides import TorchFunctionMode, _get_current_function_mode_stack

import vla_attention as va
from tests.capture.torch_policies.test_odd_policies import OddPolicy, layout
from tests.kit.attention_modules import Attention, Policy, Seen
from vla_attention.capture.torch_policies import seen_functions
from vla_attention.capture.torch_policies.attention_calls import CallShape
from vla_attention.capture.torch_policies.call_order import CallsDoNotFit
from vla_attention.capture.torch_policies.policy_modules import find_policy
from vla_attention.capture.torch_policies.tensor_functions import TensorTable
from vla_attention.capture.torch_policies.watch import watch_attention
from vla_attention.schemas.stores.reader import open_store

HIDDEN, MEMORY = torch.randn(2, 5, 32), torch.randn(2, 7, 32)
NAMES = [(owner, name, getattr(owner, name)) for owner, name in seen_functions._NAMES]


def fused(query, key, value, mask):
    return functional.scaled_dot_product_attention(query, key, value, mask)


def by_hand(query, key, value, mask):
    return functional.softmax(query @ key.transpose(-1, -2), dim=-1) @ value


def imported(query, key, value, mask):
    return imported_by_name(query, key, value, mask)


def small_policy(attend, **options):
    torch.manual_seed(0)
    return Policy(attend, **options).eval().requires_grad_(False)


def nothing_left():
    return all(getattr(owner, name) is before for owner, name, before in NAMES) and not any(
        isinstance(mode, seen_functions._EveryFunction) for mode in _get_current_function_mode_stack()
    )


@pytest.mark.parametrize("attend", [fused, by_hand])
def test_names_are_enough_for_policies_that_use_them(attend):
    policy, every, named = small_policy(attend), Seen(), Seen()
    with watch_attention(policy, every) as functions:
        expected = policy(HIDDEN, MEMORY)
    assert functions.by_names
    with watch_attention(policy, named, every_function=False) as functions:
        result = policy(HIDDEN, MEMORY)
    assert functions.by_names
    assert torch.equal(result, expected)
    assert named.shapes == every.shapes
    assert len(named.shapes) == 2
    assert all(torch.equal(a, b) for a, b in zip(named.rows, every.rows, strict=True))
    assert nothing_left()


def test_a_function_that_was_imported_by_name_is_seen_by_the_mode_only():
    policy, every, named = small_policy(imported), Seen(), Seen()
    with watch_attention(policy, every) as functions:
        policy(HIDDEN, MEMORY)
    assert len(every.shapes) == 2
    assert not functions.by_names
    with watch_attention(policy, named, every_function=False):
        policy(HIDDEN, MEMORY)
    assert not named.shapes


def test_multihead_attention_is_one_call_either_way():
    policy = nn.TransformerEncoder(nn.TransformerEncoderLayer(16, 4, batch_first=True), 2).eval()
    for every_function in (True, False):
        seen = Seen()
        with watch_attention(policy, seen, every_function=every_function) as functions:
            policy(torch.randn(2, 5, 16))
        assert [(shape.module, shape.kind) for shape in seen.shapes] == [
            ("layers.0.self_attn", "multihead"),
            ("layers.1.self_attn", "multihead"),
        ]
        assert functions.by_names


class Counting(nn.Module):
    """Counts how often the mode that sees every function is on while a module runs."""

    def __init__(self, inner: nn.Module, found: Counter) -> None:
        super().__init__()
        self.inner, self.found = inner, found

    def forward(self, *given: Tensor) -> Tensor:
        on = any(isinstance(mode, seen_functions._EveryFunction) for mode in _get_current_function_mode_stack())
        self.found[on] += 1
        return self.inner(*given)


def test_a_softmax_is_followed_no_further_than_to_the_next_module():
    policy, found = small_policy(by_hand), Counter()
    for layer in policy.layers:
        for name in ("q_proj", "k_proj", "o_proj"):
            setattr(layer, name, Counting(getattr(layer, name), found))
    seen = Seen()
    with watch_attention(policy, seen, every_function=False):
        policy(HIDDEN, MEMORY)
    assert len(seen.shapes) == 2
    assert found == {False: 6}
    with watch_attention(policy, Seen()):
        policy(HIDDEN, MEMORY)
    assert found == {False: 6, True: 6}


def test_a_softmax_that_meets_no_values_is_followed_while_it_lives():
    kept: list[Tensor] = []

    def gate(query, key, value, mask):
        kept.append(torch.softmax(query, -1))
        return functional.scaled_dot_product_attention(query, key, value, mask)

    policy, seen = small_policy(gate), Seen()
    with watch_attention(policy, seen, every_function=False):
        policy(HIDDEN, MEMORY)
    assert [shape.kind for shape in seen.shapes] == ["sdpa", "sdpa"]
    assert nothing_left()


class Scaled(TorchFunctionMode):
    """A mode of the policy's own; it counts the functions that it sees."""

    def __init__(self) -> None:
        super().__init__()
        self.count = 0

    def __torch_function__(self, func, types, args=(), kwargs=None):
        self.count += 1
        return func(*args, **(kwargs or {}))


@pytest.mark.parametrize("place", ["around softmax", "around product", "around both", "left before the product"])
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


def test_what_other_threads_call_under_the_names_is_not_seen():
    policy, other, seen = small_policy(by_hand), small_policy(fused), Seen()
    with ThreadPoolExecutor(1) as pool, watch_attention(policy, seen, every_function=False):
        policy(HIDDEN, MEMORY)
        pool.submit(other, HIDDEN, MEMORY).result()
    assert [shape.module for shape in seen.shapes] == ["layers.0", "layers.1"]
    assert nothing_left()


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


def test_a_name_that_the_policy_sets_in_the_block_stays(monkeypatch):
    monkeypatch.setattr(functional, "scaled_dot_product_attention", functional.scaled_dot_product_attention)
    policy = small_policy(fused)

    def own(*given):
        return given[0]

    with watch_attention(policy, Seen(), every_function=False):
        functional.scaled_dot_product_attention = own
    assert functional.scaled_dot_product_attention is own


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


@dataclass
class Wanting:
    """A watcher that wants the calls of some modules only."""

    wanted: tuple[str, ...] = ()
    changes: bool = False
    passed: list[CallShape] = field(default_factory=list)
    seen: list[CallShape] = field(default_factory=list)

    def change(self, shape):
        raise AssertionError("nothing is changed")

    def passes(self, shape):
        if shape.module in self.wanted:
            return False
        self.passed.append(shape)
        return True

    def saw(self, call):
        self.seen.append(call.shape)


def test_softmaxes_that_are_not_wanted_are_followed_only_while_it_is_unknown_what_they_are(monkeypatch):
    def grouped(query, key, value, mask):  # eight heads that share four of the values
        rows = torch.softmax(query @ key.repeat_interleave(2, 1).transpose(-1, -2), -1)
        torch.softmax(query.sum(-1), -1)  # no attention
        return torch.einsum("bhgqk,bhkd->bhgqd", rows.unflatten(1, (4, 2)), value).flatten(1, 2)

    policy, followed = small_policy(grouped, heads=8, kv_heads=4), []
    own = TensorTable.put
    monkeypatch.setattr(TensorTable, "put", lambda *given: followed.append(1) or own(*given))
    hidden, memory = torch.randn(2, 5, 64), torch.randn(2, 7, 64)
    found, expected = find_policy(policy), policy(hidden, memory)
    counts, watchers = [], []
    for every_function, wanted in ((True, ()), (False, ()), (False, ("layers.1",)), (True, ())):
        followed.clear()
        watchers.append(Wanting(wanted))
        with watch_attention(found, watchers[-1], every_function=every_function):
            assert torch.equal(policy(hidden, memory), expected)
        counts.append(len(followed))
    every, names, one, again = watchers
    assert names.passed == every.passed == again.passed
    assert [shape.kv_heads for shape in every.passed] == [4, 4]
    assert [*one.passed, *one.seen] == every.passed
    # Only what was seen to be attention throughout is passed; the other softmax is always followed.
    assert counts[0] == counts[3] > counts[2] > counts[1] > 0


def test_a_softmax_that_is_attention_only_at_times_is_always_followed():
    def sometimes(query, key, value, mask):
        rows = torch.softmax(query @ key.transpose(-1, -2), -1)
        if not gates:
            return rows @ value
        gates.pop()
        return functional.scaled_dot_product_attention(query, key, value)

    gates: list[bool] = [True]
    policy = small_policy(sometimes)
    found = find_policy(policy)
    kinds = []
    for every_function, count in ((True, 1), (False, 1), (False, 0), (True, 0), (False, 1)):
        gates[:] = [True] * count
        watcher = Wanting()
        with watch_attention(found, watcher, every_function=every_function):
            policy(HIDDEN, MEMORY)
        kinds.append([(shape.module, shape.kind) for shape in watcher.passed])
    with_gate = [("layers.0", "sdpa"), ("layers.1", "softmax")]
    without = [("layers.0", "softmax"), ("layers.1", "softmax")]
    assert kinds == [with_gate, with_gate, without, without, with_gate]


def test_a_later_call_by_another_name_is_an_error_that_says_so(tmp_path):
    names: list[object] = []
    policy = OddPolicy(lambda block, *given: names.pop(0)(*given))

    def record_two_calls(run):
        with run.episode(task_id=0, episode_index=0, instruction="") as episode:
            for step in range(2):
                with episode.replan(env_step=step):
                    # Inside of the block, something else stands under the name.
                    named = functional.scaled_dot_product_attention
                    names[:] = [imported_by_name if step else named, named]
                    policy.act()
        return episode

    with va.record(tmp_path / "a.zarr", policy, layout=layout(), durable=False) as run:
        with pytest.raises(CallsDoNotFit, match=r"(?s)replan 1.*block 0: 0.*again with run\.every_function = True"):
            record_two_calls(run)
        run.every_function = True
        assert record_two_calls(run).num_replans == 2


def test_a_module_that_attends_counts_its_own_end():
    """The block is the last module: its end takes the mode away."""
    policy, seen = Attention(by_hand).eval(), Seen()
    policy.o_proj = nn.Identity()
    with watch_attention(policy, seen, every_function=False):
        policy(HIDDEN, MEMORY)
        assert not _get_current_function_mode_stack()
    assert len(seen.shapes) == 1
