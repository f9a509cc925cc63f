"""Any policy that runs can be recorded: the digest reads whatever has bytes, and names the rest."""

from __future__ import annotations

import io
import re
import warnings

import numpy as np
import pytest
import torch
from torch import nn

import vla_attention as va
from tests.capture.torch_policies.residual_policies import WAYS, ResidualPolicy, residual_layout
from vla_attention.capture.torch_policies.policy_weights import policy_digest
from vla_attention.schemas.errors import Note


class Stateful(nn.Module):
    """Has what `state` returns as its extra state, as modules of TransformerEngine have."""

    def __init__(self, state):
        super().__init__()
        self.state = state

    def get_extra_state(self):
        return self.state()

    def set_extra_state(self, state):
        raise NotImplementedError


class Offloaded(nn.Linear):
    """Has its weights only while it runs, as accelerate's `cpu_offload` leaves them."""

    def __init__(self, linear):
        super().__init__(linear.in_features, linear.out_features, device="meta")
        self.kept = {name: weight.detach() for name, weight in linear.named_parameters()}

    def forward(self, given):
        return nn.functional.linear(given, self.kept["weight"], self.kept["bias"])


class Wrapped(torch.Tensor):
    """A subclass without memory of its own, as torchao's quantised weights."""

    @staticmethod
    def __new__(cls, inner):
        return torch.Tensor._make_wrapper_subclass(cls, inner.shape, dtype=inner.dtype)

    def __init__(self, inner):
        self.inner = inner

    def __tensor_flatten__(self):
        return ["inner"], "context"

    @classmethod
    def __torch_dispatch__(cls, function, types, args=(), kwargs=None):
        plain = [item.inner if isinstance(item, cls) else item for item in args]
        if function is torch.ops.aten.detach.default:
            return cls(plain[0])
        return function(*plain, **(kwargs or {}))


def failing():
    raise RuntimeError("no state here")


def with_module(module):
    """The small policy, which holds one more module that it does not call."""
    policy = ResidualPolicy(WAYS["plain"].add)
    policy.more = module
    return policy


def with_weight(weight):
    module = nn.Module()
    if isinstance(weight, nn.Parameter):
        module.weight = weight
    else:
        module.register_buffer("weight", weight)
    return with_module(module)


def quantised(module, number):
    with torch.no_grad():
        next(module.parameters()).add_(number)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        return torch.ao.quantization.quantize_dynamic(module, {nn.Linear, nn.LSTM}, dtype=torch.qint8)


def offloaded():
    policy = ResidualPolicy(WAYS["plain"].add)
    for block in policy.blocks:
        block.out, block.second = Offloaded(block.out), Offloaded(block.second)
    return policy


#: Policies whose whole state has bytes, made of a number that changes them.
READ = {
    "quantised by torch.ao": lambda number: quantised(ResidualPolicy(WAYS["plain"].add), number),
    "quantised LSTM": lambda number: with_module(quantised(nn.Sequential(nn.LSTM(3, 4)), number)),
    "extra state of bytes": lambda number: with_module(Stateful(lambda: io.BytesIO(bytes([number])))),
    "extra state of many kinds": lambda number: with_module(
        Stateful(lambda: {"a": [torch.ones(2), None, 1.5], 2: (np.full(3, number), torch.float16)})
    ),
    "a mask of infinities": lambda number: with_weight(torch.full((2 + number, 2), -torch.inf)),
    "quantised tensor": lambda number: with_weight(
        torch.quantize_per_channel(torch.ones(2, 3), torch.tensor([0.1 + number, 0.2]), torch.zeros(2), 0, torch.qint8)
    ),
    "sparse": lambda number: with_weight(torch.diag(torch.arange(3.0) + number).to_sparse()),
    "float8": lambda number: with_weight(torch.tensor([0.5, number]).to(torch.float8_e4m3fn)),
    "complex, conjugated": lambda number: with_weight(torch.tensor([0.5j, number]).conj()),
    "empty and without axes": lambda number: with_weight(torch.zeros(0) if number else torch.tensor(3)),
    "a subclass that holds tensors": lambda number: with_weight(nn.Parameter(Wrapped(torch.full((2,), 1.0 + number)))),
}
#: Policies of which a part has no bytes, and its name.
UNREAD = {
    "offloaded": (offloaded, "blocks.0.out.weight"),
    "made at the first call": (lambda: with_module(nn.LazyLinear(3)), "more.weight"),
    "an object as extra state": (lambda: with_module(Stateful(object)), "more._extra_state"),
    "an object inside of one": (lambda: with_module(Stateful(lambda: [1, {2: object()}])), "more._extra_state"),
    "a state that cannot be asked for": (lambda: with_module(Stateful(failing)), "more.(state)"),
}


def record(path, policy, **settings):
    """Record two episodes, since the weights are looked at where one begins; what the run says of itself."""
    policy.eval()
    with va.record(path, policy, layout=residual_layout(), durable=False, **settings) as run:
        for number in range(2):
            facts = {"task_id": 0, "episode_index": number, "instruction": ""}
            with run.episode(**facts) as episode, episode.replan(env_step=0) as replan:
                replan.actions = policy.act()[0]
    return run.attributes


@pytest.mark.parametrize("make", READ.values(), ids=READ)
def test_whatever_has_bytes_is_in_the_digest(tmp_path, make):
    def digest(number):
        torch.manual_seed(0)
        return policy_digest(make(number))

    (one, unread), (other, _) = digest(0), digest(1)
    assert unread == ()
    assert one == digest(0)[0] != other
    torch.manual_seed(0)
    # What torch.ao quantises is projected by an operator of its own.
    assert record(tmp_path / "a.zarr", make(0), contributions=False).policy.digest == one


@pytest.mark.parametrize(("make", "name"), UNREAD.values(), ids=UNREAD)
def test_what_has_none_is_named_and_recorded_all_the_same(tmp_path, make, name):
    policy = make()
    unread = policy_digest(policy)[1]
    assert name in unread
    with pytest.warns(Note, match=re.escape(name)):
        attributes = record(tmp_path / "a.zarr", policy)
    assert name in attributes.provenance["not in the digest of weights"]
    assert attributes.recording.contributions  # the projection may be offloaded too


def test_where_an_object_is_in_memory_is_no_part_of_the_digest():
    class Placed(Wrapped):
        def __init__(self, inner):
            super().__init__(inner)
            self.layout_of_blocks = object()

        def __tensor_flatten__(self):
            return ["inner"], {"layout": self.layout_of_blocks}

    one, other = (with_weight(nn.Parameter(Placed(torch.ones(3)))) for _ in range(2))
    assert policy_digest(one) == policy_digest(other)
