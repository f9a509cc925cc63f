"""The block: which module, one thread, compiled parts, nothing left behind, and what is refused."""

from __future__ import annotations

import types
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import pytest
import torch
from torch import nn
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.nn.functional import scaled_dot_product_attention as sdpa

from tests.kit.attention_modules import Attention, Policy, Seen
from vla_attention.capture.torch_policies.policy_modules import CannotRunEager, modules_of
from vla_attention.capture.torch_policies.unseen_attention import UnseenAttention
from vla_attention.capture.torch_policies.watch import AlreadyWatched, NotFollowed, OtherPolicy, watch_attention


def attend(query, key, value, mask):
    return sdpa(query, key, value, mask)


def small_policy(**options):
    torch.manual_seed(0)
    return Policy(attend, **options).eval().requires_grad_(False)


HIDDEN, MEMORY = torch.randn(2, 5, 32), torch.randn(2, 7, 32)
PATHS = ["layers.0", "layers.1"]


def seen_in(policy, call):
    seen = Seen()
    with watch_attention(policy, seen):
        call()
    return [shape.module for shape in seen.shapes]


@dataclass
class Wrapper:
    """What people write around a model: no module itself."""

    model: nn.Module
    others: dict

    def select_action(self, hidden, memory):
        return self.model(hidden, memory)


def test_modules_are_found_in_an_object():
    policy = Wrapper(small_policy(), {"heads": [nn.Linear(2, 2)]})
    assert list(modules_of(policy))[:3] == ["model", "model.layers", "model.layers.0"]
    assert "others.heads.0" in modules_of(policy)
    assert seen_in(policy, lambda: policy.select_action(HIDDEN, MEMORY)) == [f"model.{path}" for path in PATHS]
    assert seen_in(policy.select_action, lambda: policy.select_action(HIDDEN, MEMORY)) == [f"model.{p}" for p in PATHS]


def test_a_module_is_found_by_its_first_path_when_it_is_shared():
    policy = small_policy()
    policy.layers[1] = policy.layers[0]
    assert seen_in(policy, lambda: policy(HIDDEN, MEMORY)) == ["layers.0", "layers.0"]


class Direct(nn.Module):
    """Calls `forward` of a module directly, as some policies do, and attends in a method that is no forward."""

    def __init__(self):
        super().__init__()
        self.inner = Attention(attend).eval()

    def sample(self, hidden, memory):
        return self.inner.forward(hidden, memory)

    def attend_here(self, hidden):
        return sdpa(hidden[:, None], hidden[:, None], hidden[:, None])


def test_forward_called_directly_and_methods():
    policy = Direct()
    assert seen_in(policy, lambda: policy.sample(HIDDEN, MEMORY)) == ["inner"]
    assert seen_in(policy, lambda: policy.attend_here(HIDDEN)) == [""]
    assert seen_in(policy, lambda: sdpa(HIDDEN, HIDDEN, HIDDEN)) == [""]


def test_compiled_parts_run_eager_and_are_seen():
    whole, part = small_policy(), small_policy()
    expected = whole(HIDDEN, MEMORY)
    compiled = torch.compile(whole, backend="eager", fullgraph=True)
    part.layers[1] = torch.compile(part.layers[1], backend="eager")
    part.layers[0].attend = torch.compile(attend, backend="eager")
    for policy in (compiled, part):
        policy(HIDDEN, MEMORY)  # compiled before the block
        seen = Seen()
        with watch_attention(policy, seen):
            result = policy(HIDDEN, MEMORY)
        assert torch.equal(result, expected)
        assert [shape.module for shape in seen.shapes] == PATHS
        assert torch.equal(policy(HIDDEN, MEMORY), expected)


class InMethods(nn.Module):
    """Attends in a method that is no forward, and nowhere else."""

    def __init__(self):
        super().__init__()
        self.projection = nn.Linear(32, 32)

    def act(self, hidden):
        projected = self.projection(hidden)[:, None]
        return sdpa(projected, projected, projected)


@pytest.mark.parametrize("way", ["call", "forward", "method"])
def test_a_policy_that_runs_in_another_thread_is_refused(way):
    policy, methods, seen = small_policy(), InMethods(), Seen()
    call = {
        "call": lambda: policy(HIDDEN, MEMORY),
        "forward": lambda: policy.forward(HIDDEN, MEMORY),
        "method": lambda: methods.act(HIDDEN),
    }[way]
    policies = Wrapper(policy, {"other": methods})
    with ThreadPoolExecutor(1) as pool:  # its thread is older than the block
        # The first call of a thread may use another number of OpenMP threads than all later ones: other last bits.
        expected = [pool.submit(call).result() for _ in range(2)][-1]
        with pytest.raises(NotFollowed, match="Wrapper"):  # noqa: SIM117
            with watch_attention(policies, seen):
                result = pool.submit(call).result()
        assert torch.equal(result, expected)
        assert not seen.shapes
        assert "forward" not in methods.projection.__dict__
        assert pool.submit(lambda: torch._C._len_torch_function_stack()).result() == 0
        # Outside of the block it may run where it likes, and other threads may do what they like.
        with watch_attention(policies, seen):
            pool.submit(int).result()
            call()
        assert seen.shapes


def test_errors_of_the_watcher_are_not_lost():
    """A policy's code may catch errors around its attention."""

    class Failing(Seen):
        def saw(self, call):
            raise ValueError("no place left")

    def caught(query, key, value, mask):
        try:
            return sdpa(query, key, value)
        except ValueError:
            return query

    policy = Policy(caught).eval()
    with pytest.raises(ValueError, match="no place left"), watch_attention(policy, Failing()):
        policy(HIDDEN, MEMORY)


def test_nothing_is_left_behind():
    policy = small_policy()
    policy.layers[0].forward = types.MethodType(Attention.forward, policy.layers[0])  # as some libraries' hooks do
    own = policy.layers[0].__dict__["forward"]
    for fails in (False, True):
        seen = Seen()
        try:
            with watch_attention(policy, seen):
                policy(HIDDEN, MEMORY)
                if fails:
                    raise RuntimeError("from the policy's code")
        except RuntimeError:
            assert fails
        assert len(seen.shapes) == 2
        assert policy.layers[0].__dict__["forward"] is own
        assert "forward" not in policy.layers[1].__dict__
        assert torch._C._len_torch_function_stack() == 0
        assert torch.backends.mha.get_fastpath_enabled()
        assert torch._dynamo.eval_frame._stance.stance == "default"
        policy(HIDDEN, MEMORY)
        assert len(seen.shapes) == 2


def test_blocks_inside_each_other_are_refused():
    policy, seen = small_policy(), Seen()
    with watch_attention(policy, seen):
        for other in (policy, small_policy()):
            with pytest.raises(AlreadyWatched), watch_attention(other, Seen()):
                pass
        policy(HIDDEN, MEMORY)
    assert len(seen.shapes) == 2


def test_a_second_policy_in_one_block_is_refused():
    policy, other = small_policy(), small_policy()
    with pytest.raises(OtherPolicy, match=r"class Attention.*Policy"):  # noqa: SIM117
        with watch_attention(policy, Seen()):
            other(HIDDEN, MEMORY)


def test_programs_that_cannot_run_eager_are_refused():
    policy = small_policy()
    with pytest.warns(DeprecationWarning, match="trace"):
        policy.head = torch.jit.trace(nn.Linear(32, 3), torch.randn(1, 32))
    with pytest.raises(CannotRunEager, match=r"head .*torch\.jit"):  # noqa: SIM117
        with watch_attention(policy, Seen()):
            pass


@pytest.mark.filterwarnings("ignore:The PyTorch API of nested tensors")
def test_nested_tensors_are_refused():
    policy = Policy(lambda q, k, v, mask: sdpa(*[torch.nested.nested_tensor(list(t)) for t in (q, k, v)])).eval()
    with pytest.raises(UnseenAttention, match=r"layers\.0 "):  # noqa: SIM117
        with watch_attention(policy, Seen()):
            policy(HIDDEN, MEMORY)


def test_a_change_of_a_call_that_asks_for_flash_attention():
    def flash_only(query, key, value, mask):
        with sdpa_kernel(SDPBackend.FLASH_ATTENTION):
            return sdpa(query, key, value)

    policy, seen = Policy(flash_only).eval().requires_grad_(False), Seen(changes=lambda shape: torch.zeros(7))
    expected = policy(HIDDEN, MEMORY)
    with watch_attention(policy, seen):
        result = policy(HIDDEN, MEMORY)
    torch.testing.assert_close(result, expected)


def test_operators_that_give_no_rows_are_refused():
    @torch.library.custom_op("flash_attn::_small_forward", mutates_args=())
    def flash(query: torch.Tensor) -> torch.Tensor:
        return query.clone()

    def fallback(query, key, value, mask):
        try:
            return flash(query)
        except Exception:
            return sdpa(query, key, value)

    for function in (lambda query, key, value, mask: flash(query), fallback):
        policy = Policy(function).eval()
        with pytest.raises(UnseenAttention, match=r"flash_attn::_small_forward.*SDPA"), watch_attention(policy, Seen()):
            policy(HIDDEN, MEMORY)


@pytest.mark.parametrize("setting", ["flash_attention_2", "kernels-community/flash-attn3", "paged|sdpa"])
def test_settings_that_give_no_rows_are_refused(setting):
    policy = small_policy()
    policy.layers[1].config = types.SimpleNamespace(_attn_implementation=setting)
    with pytest.raises(UnseenAttention, match=r"layers\.1 .*attn_implementation='sdpa'"):  # noqa: SIM117
        with watch_attention(policy, Seen()):
            pass
    for fine in ("sdpa", "eager", "flex_attention", "my_own"):
        policy.layers[1].config = types.SimpleNamespace(_attn_implementation=fine)
        assert seen_in(policy, lambda: policy(HIDDEN, MEMORY)) == PATHS


def test_a_query_must_keep_a_key():
    policy = small_policy()
    with pytest.raises(ValueError, match=r"layers\.0"):  # noqa: SIM117
        with watch_attention(policy, Seen(changes=lambda shape: torch.full((1,), float("-inf")))):
            policy(HIDDEN, MEMORY)


def test_gradients_flow_as_before():
    policy = Policy(attend)
    policy(HIDDEN, MEMORY).sum().backward()
    expected = policy.layers[0].q_proj.weight.grad.clone()
    policy.zero_grad()
    with watch_attention(policy, Seen()):
        policy(HIDDEN, MEMORY).sum().backward()
    assert torch.equal(policy.layers[0].q_proj.weight.grad, expected)
