"""Only where a policy computed attention before is it watched; nothing that it computes may be lost by that."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext, suppress

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.nn.functional import scaled_dot_product_attention as sdpa
from torch.overrides import TorchFunctionMode
from torch.utils._device import DeviceContext

import vla_attention as va
from tests.capture.torch_policies.test_session import fill, start, stored
from tests.kit.attention_modules import Policy, Seen, first_and_narrow
from tests.kit.small_torch_policy import SmallPolicy, given
from vla_attention.capture.recording.finite_numbers import NumbersNotFinite
from vla_attention.capture.torch_policies.attention_calls import Watcher
from vla_attention.capture.torch_policies.output_ways import OutputWay
from vla_attention.capture.torch_policies.policy_modules import find_policy
from vla_attention.capture.torch_policies.site_recorder import RowsDoNotMatch
from vla_attention.capture.torch_policies.watch import AttentionMode, NotFollowed, watch_attention
from vla_attention.capture.torch_policies.watched_places import EVERY, WatchedPlaces
from vla_attention.schemas.errors import Note
from vla_attention.schemas.layout import SiteLayout, Span
from vla_attention.schemas.stores.reader import open_store


class OwnMode(TorchFunctionMode):
    """A function mode of the policy's own."""

    def __torch_function__(self, func, types, args=(), kwargs=None):
        return func(*args, **(kwargs or {}))


class Attend(nn.Module):
    """Attention where `on` is set."""

    def __init__(self, on: bool = True) -> None:
        super().__init__()
        self.on = on

    def forward(self, x: Tensor) -> Tensor:
        heads = x.view(1, -1, 2, 4).transpose(1, 2)
        return sdpa(heads, heads, heads).transpose(1, 2).flatten(2) if self.on else x


class Steps(nn.Module):
    """Attention in a module between others; `changed` says what a call does else."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.before, self.attend, self.after = nn.Linear(8, 8), Attend(), Attend(on=False)
        self.late, self.changed = Attend(), ""

    @torch.no_grad()
    def forward(self, x: Tensor) -> Tensor:
        x = self.before(x)
        with OwnMode() if self.changed == "in a mode" else nullcontext():
            if self.changed == "failing":
                with suppress(RuntimeError):
                    self.attend(x[0, 0, 0])
            x = self.attend(x)
        x = self.after(x).relu().sin().cos()
        return self.late(x) if self.changed == "in another module" else x


@pytest.fixture
def steps():
    policy = Steps()
    return policy, find_policy(policy)


def calls_of(policy, found, changed=""):
    policy.changed, seen = changed, Seen(changes=None)
    x = torch.ones(1, 3, 8)
    expected = policy(x)
    with watch_attention(found, seen):
        result = policy(x)
    assert torch.equal(result, expected)
    assert torch._C._len_torch_function_stack() == 0
    return seen


def test_functions_elsewhere_do_not_pass_through_python(steps, monkeypatch):
    policy, found = steps
    passed, names = [], []
    inside = AttentionMode.__torch_function__

    def counted(self, func, types, args=(), kwargs=None):
        passed.append(getattr(func, "__name__", ""))
        return inside(self, func, types, args, kwargs)

    monkeypatch.setattr(AttentionMode, "__torch_function__", counted)
    for _ in range(4):
        passed.clear()
        assert len(calls_of(policy, found).rows) == 1
        names.append(list(passed))
    assert "sin" in names[0]
    assert "sin" not in names[3]
    assert "scaled_dot_product_attention" in names[3]


@pytest.mark.parametrize(("changed", "count"), [("in another module", 2), ("in a mode", 1), ("failing", 1)])
def test_what_is_new_is_seen_at_once(steps, changed, count):
    policy, found = steps
    for _ in range(3):
        calls_of(policy, found)
    seen = calls_of(policy, found, changed)
    assert not seen.whole
    assert len(seen.rows) == count


def test_a_module_that_begins_to_compute_attention_is_seen_after_some_calls(steps):
    policy, found = steps
    for _ in range(3):
        calls_of(policy, found)
    policy.after.on = True
    numbers = [len(calls_of(policy, found).rows) for _ in range(EVERY)]
    assert numbers[0] == 1
    first = numbers.index(2)
    assert first <= EVERY - 3
    # From there on it is known.
    assert set(numbers[first:]) == {2}


def test_attention_that_moved_is_missed_once_and_that_is_said(steps):
    policy, found = steps
    for _ in range(3):
        calls_of(policy, found)
    policy.attend.on, policy.after.on = False, True
    assert calls_of(policy, found).rows == []
    with pytest.warns(Note, match=r"computes attention in after now.*1 block before"):
        assert len(calls_of(policy, found).rows) == 1
    for _ in range(3):
        assert len(calls_of(policy, found).rows) == 1


def test_answers_from_a_queue_are_no_calls():
    places = WatchedPlaces()
    for call in range(20):
        whole = places.next_is_whole()
        assert whole is (call < 3 or call % EVERY == 0)
        places.passed({7, 8, 9}, {9}, whole=whole, number=1)
        for _ in range(4):
            places.passed({7}, {7}, whole=places.next_is_whole(), number=0)  # with a gate's softmax
    assert (places.calls, places.missed) == (20, 0)
    places.passed({7, 8, 9}, set(), whole=False, number=0)  # one more than the queue explains
    assert (places.next_is_whole(), places.missed) == (True, 1)


class Moving(nn.Module):
    """Answers five calls from one chunk, whose attention is in a module of its own for five chunks only."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.kernel, self.chunks, self.queue = Kernel(), 0, []
        self.out = nn.Parameter(torch.randn(16, 2))
        self.tokens, self.keys = nn.Parameter(torch.randn(1, 2, 5, 8)), nn.Parameter(torch.randn(1, 2, 4, 8))

    @torch.no_grad()
    def forward(self) -> Tensor:
        if not self.queue:
            self.chunks += 1
            mixed = (self.kernel if self.chunks <= 5 else sdpa)(self.tokens, self.keys, self.keys)
            self.queue = list((mixed.transpose(1, 2).flatten(2) @ self.out)[0])
        return self.queue.pop(0)


class Kernel(nn.Module):
    def forward(self, *given: Tensor) -> Tensor:
        return sdpa(*given)


@pytest.mark.parametrize("hidden", [False, True])
def test_a_queue_hides_no_attention_that_moved(tmp_path, hidden):
    """One chunk is missed, and a note says so; where attention is changed, none is."""
    policy = Moving().eval()
    changes = {"interventions": va.knockout("role:state")} if hidden else {}
    layout = text_and_state()
    run = va.record(tmp_path / "a.zarr", policy, layout=layout, contributions=False, durable=False, **changes)
    chunks = []
    with (
        nullcontext() if hidden else pytest.warns(Note, match="attention in .*now.*1 block"),
        run,
        run.episode(task_id=0, episode_index=0, instruction="a") as episode,
    ):
        for step in range(60):
            with episode.replan(env_step=step) as replan:
                replan.actions = policy()
            chunks.append(replan.actions.tolist())
    assert (policy.chunks, episode.num_replans) == (12, 12 if hidden else 11)
    assert len({str(chunks[5 * number : 5 * number + 5]) for number in range(12)}) == 1


def test_a_new_module_begins_anew():
    places, found = WatchedPlaces(), []
    for call in range(12):
        whole = places.next_is_whole()
        found.append(whole)
        places.passed({1, 2}, {1} if call < 5 or not whole else {1, 2}, whole=whole, number=1)
    assert found == [True] * 3 + [False] * 9
    places = WatchedPlaces()
    for call in range(4):
        places.passed({1, 2}, {1, 2} if call else {1}, whole=places.next_is_whole(), number=1)
    assert places.quiet == set()


def text_and_state() -> va.PolicyLayout:
    """The layout of a policy with one attention call, of five queries over two keys of text and two of the state."""
    keys = SiteLayout("text", (Span("prompt", "text", 0, 2), Span("state", "state", 2, 4)))
    site = va.RecordedSite(keys, (0, 5), {"prompt": "text", "state": "state"})
    rule = va.CallRule(".*", None, sequence=(("text", 0),))
    return va.PolicyLayout("tiny", "tiny", (site,), (rule,), 1, 2, 1, denoise_times=(1.0,))


class Cached(nn.Module):
    """Projects the instruction when it changes, and answers five calls from one chunk, with a softmax of its own."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.words, self.tokens = nn.Embedding(9, 16), nn.Parameter(torch.randn(1, 5, 16))
        self.q, self.k, self.v, self.out = nn.Linear(16, 16), nn.Linear(16, 16), nn.Linear(16, 16), nn.Linear(16, 2)
        self.text, self.queue = None, []

    @torch.no_grad()
    def forward(self, ids: Tensor) -> Tensor:
        if not self.queue:
            heads = [self.q(self.tokens).view(1, -1, 2, 8).transpose(1, 2)]
            if self.text is None or not torch.equal(self.text, ids):
                words = self.words(ids)
                self.text, self.kv = ids, [f(words).view(1, -1, 2, 8).transpose(1, 2) for f in (self.k, self.v)]
            mixed = sdpa(*heads, *self.kv).transpose(1, 2).flatten(2)
            self.queue = list(self.out(self.tokens + mixed)[0])
        action = self.queue.pop(0)
        return torch.cat([action[:1], action[1:].softmax(-1)])


@pytest.mark.parametrize("hidden", [False, True])
def test_every_call_of_a_policy_with_queue_and_cache_is_recorded_and_changed(tmp_path, hidden):
    policy = Cached().eval()
    layout = text_and_state()
    changes = {"interventions": va.knockout("role:state")} if hidden else {}
    run = va.record(tmp_path / "a.zarr", policy, layout=layout, contributions=False, durable=False, **changes)
    actions = []
    with run, run.episode(task_id=0, episode_index=0, instruction="a") as episode:
        for step in range(40):
            with episode.replan(env_step=step) as replan:
                replan.actions = policy(torch.tensor([[1, 2, 3, 4]]))
            actions.append(replan.actions[0].item())
    assert episode.num_replans == 8
    assert len({*actions[::5]}) == 1  # the same call, changed or not
    rows = open_store(tmp_path / "a.zarr").episodes[0].read("text/rows")
    assert (rows[..., 2:] > 0).any() is np.bool_(not hidden)


class Trunk(nn.Module):
    """Computes attention in methods of two modules that it does not call, behind the same layer."""

    def __init__(self) -> None:
        super().__init__()
        self.trunk, self.arm, self.hand = nn.Linear(8, 8), Attending(), Attending()

    def forward(self, x: Tensor, name: str) -> Tensor:
        return getattr(self, name).attend(self.trunk(x))


class Attending(nn.Module):
    def attend(self, x: Tensor) -> Tensor:
        return sdpa(x, x, x)


def test_who_computes_attention_is_asked_at_every_call():
    policy = Trunk()
    found = find_policy(policy)
    for name in ("arm", "arm", "arm", "hand", "arm"):
        seen = Seen(changes=None)
        with torch.no_grad(), watch_attention(found, seen):
            policy(torch.ones(1, 2, 3, 8), name)
        assert [shape.module for shape in seen.shapes] == [name]


class OnDevice(nn.Module):
    """Attention inside of a context of the policy's own, which it goes on after."""

    def __init__(self, context) -> None:
        super().__init__()
        self.attend, self.context = Attend(), context

    @torch.no_grad()
    def forward(self, x: Tensor) -> Tensor:
        with self.context:
            x = x + self.attend(x)
        return x + torch.zeros(1)


class Keeping(Seen):
    """Follows what the attention gave until the end."""

    def saw(self, call):
        super().saw(call)
        return OutputWay(lambda *_: (None, True))


@pytest.mark.parametrize(("context", "around"), [(torch.device("meta"), False), (OwnMode(), False), (OwnMode(), True)])
def test_contexts_of_the_policy_are_as_they_were(context, around):
    policy, x = OnDevice(context), torch.ones(1, 3, 8)
    found = find_policy(policy)
    with context if around else nullcontext():
        modes = torch._C._len_torch_function_stack()
        for _ in range(5):
            keeping = Keeping(changes=None)
            with watch_attention(found, keeping):
                policy(x)
            assert len(keeping.rows) == 1
            assert torch._C._len_torch_function_stack() == modes
    assert torch.zeros(1).device.type == "cpu"


def test_a_default_device_that_the_policy_sets_stays_and_nothing_else(steps):
    policy, found = steps
    seen = Seen(changes=None)
    try:
        for _ in range(5):
            with watch_attention(found, seen):
                policy(torch.ones(1, 3, 8))
                torch.set_default_device("cpu")
                policy(torch.ones(1, 3, 8))
            modes = torch._C._len_torch_function_stack()
            assert [type(torch._C._get_function_stack_at(place)) for place in range(modes)] == [DeviceContext]
    finally:
        torch.set_default_device(None)
    assert torch._C._len_torch_function_stack() == 0


class ByHand(nn.Module):
    """Two layers of attention by hand; what `logits` makes of a layer's logits."""

    def __init__(self, logits, beside=None) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.p, self.logits, self.beside = nn.Linear(4, 4), logits, beside

    @torch.no_grad()
    def forward(self, x: Tensor) -> Tensor:
        for layer in range(2):
            x = self.p(x)
            logits = self.logits(x @ x.mT, layer)
            if self.beside is not None:
                self.beside(logits)
            x = logits.softmax(-1) @ x
        return x


def test_keys_that_one_head_does_not_see_are_not_taken_for_those_of_the_layer_before():
    def hidden(logits, layer):
        if layer:
            logits[:, 0, :, 2] = float("-inf")
        return logits

    for seen, _ in first_and_narrow(policy := ByHand(hidden), lambda: policy(torch.ones(1, 2, 3, 4))):
        assert seen.allowed[1][0, 0, 0].tolist() == [True, True, False]


class Counting(Watcher):
    """Takes nothing, and counts the attention calls."""

    def __init__(self) -> None:
        self.calls: list[str] = []

    def passes(self, shape) -> bool:
        self.calls.append(str(shape))
        return True


def test_a_softmax_beside_the_attention_is_not_counted_for_one():
    policy = ByHand(lambda logits, layer: logits, lambda logits: (logits.softmax(-1) * logits.log_softmax(-1)).sum(-1))
    found = find_policy(policy)
    for _ in range(5):
        counting = Counting()
        with watch_attention(found, counting):
            policy(torch.ones(1, 2, 3, 4))
        assert len(counting.calls) == 2


def test_a_mask_that_is_written_over_after_the_kernel_ran():
    def forward(x):
        for _ in range(2):
            mask = torch.zeros(3, 3)
            mask[:, 0] = -1e9
            x = sdpa(x, x, x, attn_mask=mask)
            mask.zero_()
        return x

    policy = nn.Identity()
    policy.forward = forward
    for seen, _ in first_and_narrow(policy, lambda: policy(torch.randn(1, 2, 3, 4))):
        assert max(float(rows[..., 0].max()) for rows in seen.rows) == 0
        assert max(seen.errors) < 1e-5


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
        with watch_attention(found, Seen(changes=None)):
            policy(hidden, hidden)
    wanted, seen, layers = {}, Seen(changes=None), list(policy.layers)
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
