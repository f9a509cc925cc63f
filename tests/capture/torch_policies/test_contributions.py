"""Contributions are what a policy's blocks add to their residual stream, with gates and norms, or there are none."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import torch
from torch import Tensor, nn

import vla_attention as va
from tests.capture.torch_policies.residual_policies import (
    ACTIONS,
    BLOCKS,
    DIM,
    HEADS,
    PARTS,
    PREFIX,
    STEPS,
    UNKNOWN,
    WAYS,
    WIDTH,
    ResidualPolicy,
    Way,
    projected,
    residual_layout,
)
from vla_attention.capture.torch_policies.policy_layout import CallRule, RecordedSite
from vla_attention.capture.torch_policies.session import ContributionsUnknown
from vla_attention.schemas.layout import SiteLayout, Span
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.verify import verify_store


def fill(run, policy, number=0, replans=5):
    with run.episode(task_id=0, episode_index=number, instruction="") as episode:
        for step in range(replans):
            with episode.replan(env_step=step) as replan:
                replan.actions = policy.act()[0]


def recorded(path, policy, replans=5, **settings):
    """The store of one episode; nothing is said."""
    settings = {"layout": residual_layout(), "denoise_steps": "all", "durable": False} | settings
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with va.record(path / "a.zarr", policy, **settings) as run:
            fill(run, policy, replans=replans)
    return stored(path)


def stored(path):
    store = open_store(path / "a.zarr")
    assert verify_store(store) == []
    return store


def gram_of(vectors: Tensor) -> np.ndarray:
    """Gram matrices of vectors (query, part, width) and their sum, mean over the queries."""
    vectors = torch.cat([vectors, vectors.sum(dim=1, keepdim=True)], dim=1)
    return (vectors @ vectors.transpose(1, 2)).mean(dim=0).detach().numpy()


def expected(policy, way, row=0, batch=1) -> np.ndarray:
    """Gram matrices (block, denoise step, part, part) of a row of the batch, by hand."""
    result = []
    for block, calls in zip(policy.blocks, policy.calls(batch), strict=True):
        for call in calls:
            parts = [way.part(block, call, call.share(keys)) for keys in PARTS.values()]
            result.append(gram_of(torch.stack(parts, dim=2)[row].float()))
    return np.reshape(result, (BLOCKS, STEPS, 4, 4))


def close(given: np.ndarray, wanted: np.ndarray, most: float = 1e-5) -> None:
    """Compare Gram matrices relative to the largest number of each."""
    scale = np.abs(wanted).max(axis=(-1, -2), keepdims=True).clip(1e-9)
    np.testing.assert_allclose(given / scale, wanted / scale, atol=most, rtol=0)


@pytest.mark.parametrize("way", WAYS.values(), ids=WAYS)
def test_parts_are_what_the_policy_adds_of_them(tmp_path, way):
    policy = ResidualPolicy(way.add)
    actions = policy.act()
    store = recorded(tmp_path, policy)
    episode, wanted = store.episodes[0], expected(policy, way)
    # The first three policy calls are watched throughout, the others where attention is.
    for gram in episode.read("joint/contribution"):
        close(gram, wanted, most=3e-2 if way is WAYS["projected in bfloat16"] else 1e-5)
    np.testing.assert_array_equal(episode.read("actions")[1], actions[0].double().numpy())


@pytest.mark.parametrize("name", ["plain", "adaLN", "gate before the projection", "Gemma", "RMSNorm"])
def test_policies_in_bfloat16(tmp_path, name):
    policy, way = ResidualPolicy(WAYS[name].add).to(torch.bfloat16), WAYS[name]
    gram = recorded(tmp_path, policy).episodes[0].read("joint/contribution")[0]
    close(gram, expected(policy, way), most=3e-2)


@pytest.mark.parametrize("name", ["adaLN", "gate before the projection", "RMSNorm", "turned around", "flat"])
def test_rows_of_a_batch_have_gates_of_their_own(tmp_path, name):
    policy, way = ResidualPolicy(WAYS[name].add), WAYS[name]
    facts = [{"task_id": 0, "episode_index": row, "instruction": ""} for row in range(3)]
    with (
        va.record(tmp_path / "a.zarr", policy, layout=residual_layout(), denoise_steps="all", durable=False) as run,
        run.episodes(facts) as episodes,
    ):
        for step in range(5):
            with episodes.replan(env_step=step, active=[True, False, True]):
                policy.act(batch=3)
        episodes.pop(1)  # nothing was recorded of it
    for episode, row in zip(stored(tmp_path).episodes, (0, 2), strict=True):
        for gram in episode.read("joint/contribution"):
            close(gram, expected(policy, way, row, batch=3))


@pytest.mark.parametrize(("add", "word"), UNKNOWN.values(), ids=UNKNOWN)
def test_where_it_cannot_be_said_the_error_names_block_and_operation(tmp_path, add, word):
    policy = ResidualPolicy(add)
    with pytest.raises(ContributionsUnknown, match=r"block 0 of site 'joint'.*contributions=False") as caught:
        recorded(tmp_path / "with", policy)
    assert word in str(caught.value)
    assert not recorded(tmp_path / "without", policy, contributions=False).episodes[0].has("joint/contribution")


class NarrowPolicy(ResidualPolicy):
    """Its actions have fewer numbers than its stream."""

    def __init__(self, add) -> None:
        super().__init__(add)
        self.into, self.norm, self.out = nn.Linear(3, WIDTH), nn.LayerNorm(WIDTH), nn.Linear(WIDTH, 3)

    @torch.no_grad()
    def act(self, batch: int = 1) -> Tensor:
        numbers = torch.Generator().manual_seed(1)
        prefix = torch.randn(batch, PREFIX, WIDTH, generator=numbers)
        actions = torch.randn(batch, ACTIONS, 3, generator=numbers)
        for step in range(STEPS):
            hidden = self.into(actions)
            for block in self.blocks:
                hidden = block(hidden, prefix, torch.full((batch, WIDTH), float(step)))
            actions = actions - self.out(self.norm(hidden)) / STEPS
        return actions


def test_a_scaled_stream_that_leaves_the_network(tmp_path):
    way = Way(lambda b, c: 0.7 * (c.stream + b.out(c.mixed)), lambda b, c, s: projected(b, s))
    policy = NarrowPolicy(way.add)
    gram = recorded(tmp_path, policy).episodes[0].read("joint/contribution")[0]
    close(gram, expected(policy, way))


class Adapter(nn.Module):
    """As an unmerged LoRA of peft."""

    def __init__(self, base_layer: nn.Linear) -> None:
        super().__init__()
        self.base_layer = base_layer
        self.lora_A = nn.Linear(base_layer.in_features, 2, bias=False)
        self.lora_B = nn.Linear(2, base_layer.out_features, bias=False)

    def forward(self, mixed: Tensor) -> Tensor:
        return self.base_layer(mixed) + self.lora_B(self.lora_A(mixed)) * 2


def test_an_adapter_that_is_not_merged(tmp_path):
    policy = ResidualPolicy(WAYS["plain"].add)
    for block in policy.blocks:
        block.out = Adapter(block.out)
    way = Way(WAYS["plain"].add, lambda block, call, share: block.out(share) - block.out(torch.zeros_like(share)))
    for gram in recorded(tmp_path, policy).episodes[0].read("joint/contribution"):
        close(gram, expected(policy, way))


def test_a_policy_that_begins_to_do_otherwise_is_an_error(tmp_path):
    policy = ResidualPolicy(WAYS["plain"].add)
    with va.record(tmp_path / "a.zarr", policy, layout=residual_layout(), durable=False) as run:
        fill(run, policy)
        for block in policy.blocks:
            block.add = UNKNOWN["tanh"][0]
        with pytest.raises(ContributionsUnknown, match="tanh"):
            fill(run, policy, number=1)
    assert [episode.name for episode in stored(tmp_path).episodes] == ["task000_episode000"]


class Multihead(nn.Module):
    """A block with torch's own attention, which projects inside, and a gate behind it."""

    def __init__(self, batch_first: bool) -> None:
        super().__init__()
        self.attention = nn.MultiheadAttention(WIDTH, HEADS, batch_first=batch_first)
        self.gate = nn.Parameter(torch.randn(WIDTH))
        self.dropout = nn.Dropout(0.1)

    def forward(self, tokens: Tensor, memory: Tensor) -> Tensor:
        update = self.attention(tokens, memory, memory, need_weights=False)[0]
        return tokens + self.dropout(update) * self.gate


@pytest.mark.parametrize(("batch_first", "size"), [(True, 1), (False, 1), (False, 0)])
def test_attention_that_projects_its_output_itself(tmp_path, batch_first, size):
    # Values of 0 add nothing, as in the first block of ACT where its biases are 0.
    torch.manual_seed(0)
    policy = nn.Module()
    policy.block = Multihead(batch_first)
    policy.eval()
    tokens, memory = torch.randn(2, ACTIONS, WIDTH), size * torch.randn(2, 10, WIDTH)

    def act():
        given = (tokens, memory) if batch_first else (tokens.transpose(0, 1), memory.transpose(0, 1))
        with torch.no_grad():
            return policy.block(*given)

    site = residual_layout().sites[0]
    layout = residual_layout(
        sites=(type(site)(site.keys, site.action_queries, site.role_of_span),),
        rules=(CallRule(r"block\.attention", None, sequence=(("joint", 0),)),),
        num_layers=1,
        num_denoise_steps=1,
    )
    facts = [{"task_id": 0, "episode_index": row, "instruction": ""} for row in range(2)]
    with (
        va.record(tmp_path / "a.zarr", policy, layout=layout, durable=False) as run,
        run.episodes(facts) as episodes,
        episodes.replan(env_step=0),
    ):
        act()
    attention, dim = policy.block.attention, WIDTH // HEADS
    weights, biases = attention.in_proj_weight.chunk(3), attention.in_proj_bias.chunk(3)
    query, key, value = (
        nn.functional.linear(given, weight, bias).unflatten(-1, (HEADS, dim)).transpose(1, 2)
        for given, weight, bias in zip((tokens, memory, memory), weights, biases, strict=True)
    )
    rows = (query @ key.transpose(2, 3) / dim**0.5).softmax(-1)
    parts = [
        (rows[..., keys] @ value[:, :, keys]).transpose(1, 2).flatten(2)
        @ attention.out_proj.weight.T
        * policy.block.gate
        for keys in PARTS.values()
    ]
    for row, episode in enumerate(stored(tmp_path).episodes):
        close(episode.read("joint/contribution")[0, 0, 0], gram_of(torch.stack(parts, dim=2)[row]))


MEMORY = 5


def with_cross_attention(again):
    """A policy whose blocks have a cross-attention behind the first; again: what is added of the first behind that."""

    def add(block, call):
        update = block.out(call.mixed)
        tokens = call.stream + update
        memory = torch.linspace(-1, 1, MEMORY * WIDTH).view(1, MEMORY, WIDTH)
        q, k, v = (
            linear(given).unflatten(-1, (HEADS, DIM)).transpose(1, 2)
            for linear, given in ((block.query, block.norm(tokens)), (block.key, memory), (block.value, memory))
        )
        crossed = block.cross_out(nn.functional.scaled_dot_product_attention(q, k, v).transpose(1, 2).flatten(2))
        return again(block, call, tokens, crossed, update)

    policy = ResidualPolicy(add)
    for block in policy.blocks:
        block.cross_out = nn.Linear(HEADS * DIM, WIDTH)
    return policy


AGAIN = {
    "no": lambda b, c, tokens, crossed, update: tokens + crossed,
    "behind": lambda b, c, tokens, crossed, update: (tokens + crossed) + update,
    "with the second": lambda b, c, tokens, crossed, update: tokens + (crossed + update),
    "adapter": lambda b, c, tokens, crossed, update: (tokens + crossed) + b.beside(c.mixed),
}


@pytest.mark.parametrize("crosses", [True, False], ids=["recorded", "not recorded"])
@pytest.mark.parametrize("again", AGAIN.values(), ids=AGAIN)
def test_a_second_attention_that_adds_the_output_of_the_first_again(tmp_path, again, crosses):
    (joint,) = residual_layout().sites
    memory = SiteLayout("cross", (Span("prompt", "text", 0, MEMORY),))
    cross = RecordedSite(memory, (0, ACTIONS), {"prompt": "instruction"})
    rules = (
        CallRule(r"blocks\.(?P<block>\d+)", "joint", keys=joint.keys.num_keys),
        CallRule(r"blocks\.(?P<block>\d+)", "cross" if crosses else None, keys=MEMORY),
    )
    layout = residual_layout(sites=(joint, cross) if crosses else (joint,), rules=rules)
    policy = with_cross_attention(again)
    if again is AGAIN["no"]:
        way = Way(policy.blocks[0].add, WAYS["plain"].part)
        close(
            recorded(tmp_path, policy, layout=layout).episodes[0].read("joint/contribution")[0], expected(policy, way)
        )
        return
    with pytest.raises(ContributionsUnknown, match="block 0 of site 'joint'"):
        recorded(tmp_path, policy, layout=layout)


class Experts(nn.Module):
    """Two experts that share an attention: each projects its own tokens, as in pi0's training pass."""

    def __init__(self, gated: bool) -> None:
        super().__init__()
        self.first, self.second = nn.Linear(WIDTH, WIDTH), nn.Linear(WIDTH, WIDTH, bias=False)
        self.gate = nn.Parameter(torch.randn(WIDTH)) if gated else None

    def forward(self, context: Tensor, tokens: Tensor) -> tuple[Tensor, Tensor]:
        both = torch.cat([context, tokens], dim=1)
        q = both.unflatten(-1, (HEADS, WIDTH // HEADS)).transpose(1, 2)
        rows = torch.softmax(q @ q.transpose(2, 3), dim=-1)
        mixed = torch.einsum("bhqk,bhkd->bqhd", rows, q).flatten(2)
        count = context.shape[1]
        update = self.second(mixed[:, count:])
        if self.gate is not None:
            update = update * self.gate
        return context + self.first(mixed[:, :count]), tokens + update


@pytest.mark.parametrize("gated", [False, True])
def test_experts_that_share_an_attention(tmp_path, gated):
    torch.manual_seed(0)
    policy = nn.Module()
    policy.block = Experts(gated)
    context, tokens = torch.randn(1, 6, WIDTH), torch.randn(1, ACTIONS, WIDTH)
    site = residual_layout().sites[0]
    layout = residual_layout(
        sites=(type(site)(site.keys, (-ACTIONS, None), site.role_of_span),),
        rules=(CallRule("block", None, sequence=(("joint", 0),)),),
        num_layers=1,
        num_denoise_steps=1,
    )
    with (
        va.record(tmp_path / "a.zarr", policy, layout=layout, durable=False) as run,
        run.episode(task_id=0, episode_index=0, instruction="") as episode,
        episode.replan(env_step=0),
        torch.no_grad(),
    ):
        policy.block(context, tokens)
    q = torch.cat([context, tokens], dim=1).unflatten(-1, (HEADS, WIDTH // HEADS)).transpose(1, 2)
    rows = (q @ q.transpose(2, 3)).softmax(-1)[:, :, -ACTIONS:]
    parts = [
        policy.block.second((rows[..., keys] @ q[:, :, keys]).transpose(1, 2).flatten(2))
        * (policy.block.gate if gated else 1)
        for keys in PARTS.values()
    ]
    close(stored(tmp_path).episodes[0].read("joint/contribution")[0, 0, 0], gram_of(torch.stack(parts, dim=2)[0]))


class Halves(nn.Module):
    """A projection that is no nn.Linear: its weights are kept as a sum, as adapters keep theirs."""

    def __init__(self, plain: nn.Linear) -> None:
        super().__init__()
        self.base, self.down, self.up = plain, nn.Linear(HEADS * DIM, 2, bias=False), nn.Linear(2, WIDTH, bias=False)

    def forward(self, mixed: Tensor) -> Tensor:
        return self.base(mixed) + 0.5 * self.up(self.down(mixed))


class Rectified(nn.Linear):
    """A projection that is not linear."""

    def forward(self, mixed: Tensor) -> Tensor:
        return super().forward(mixed).relu()


def test_a_projection_with_an_adapter(tmp_path):
    policy = ResidualPolicy(WAYS["adaLN"].add)
    for block in policy.blocks:
        block.out = Halves(block.out)

    def part(block, call, share):
        adapted = block.out.base.weight + 0.5 * block.out.up.weight @ block.out.down.weight
        return share @ adapted.T * block.modulation(call.condition)[:, None].chunk(3, dim=-1)[2]

    gram = recorded(tmp_path, policy).episodes[0].read("joint/contribution")[0]
    close(gram, expected(policy, Way(WAYS["adaLN"].add, part)))


def test_a_projection_that_is_not_linear_has_no_parts(tmp_path):
    policy = ResidualPolicy(WAYS["plain"].add)
    for block in policy.blocks:
        block.out = Rectified(HEADS * DIM, WIDTH)
    with pytest.raises(ContributionsUnknown, match=r"'blocks\.0\.out' .*relu"):
        recorded(tmp_path, policy)


def test_what_is_done_to_the_output_by_code_that_is_not_seen_is_noticed(tmp_path):
    """Numbers are compared on the way, so that what passes by torch's functions is no silent factor."""

    def through_numpy(block, call):
        update = block.out(call.mixed)
        update.numpy()[...] *= 2
        return call.stream + update

    def before(block, call):
        call.mixed.numpy()[...] *= 2
        return call.stream + block.out(call.mixed)

    for number, add in enumerate((through_numpy, before)):
        policy = ResidualPolicy(add)
        with pytest.raises(ContributionsUnknown):
            recorded(tmp_path / str(number), policy)


@pytest.mark.parametrize(("dtype", "bias"), [(torch.float32, 300), (torch.bfloat16, 10)])
def test_a_large_bias_hides_no_other_order_of_the_heads(tmp_path, dtype, bias):
    def turned(mixed: Tensor) -> Tensor:
        return mixed.view(*mixed.shape[:2], HEADS, DIM).transpose(2, 3).reshape(mixed.shape)

    policy = ResidualPolicy(lambda block, call: call.stream + block.out(turned(call.mixed)))
    way = Way(policy.blocks[0].add, lambda block, call, share: projected(block, turned(share)))
    for block in policy.blocks:
        block.out.bias.data.fill_(bias)
    policy = policy.to(dtype)
    wanted = expected(policy, way)
    for gram in recorded(tmp_path, policy).episodes[0].read("joint/contribution"):
        close(gram, wanted, most=1e-3 if dtype is torch.float32 else 3e-2)
