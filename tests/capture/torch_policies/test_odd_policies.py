"""Policies that do odd things with their softmax: their rows are exact, or an error says what they do."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from msgspec.structs import replace
from torch import Tensor, nn
from torch.nn.attention.bias import causal_lower_right, causal_upper_left

from vla_attention.capture.interventions.factors import QueryWithoutKeys
from vla_attention.capture.torch_policies.attention_calls import RowsRefused
from vla_attention.capture.torch_policies.call_order import CallsDoNotFit
from vla_attention.capture.torch_policies.call_tensors import ChangeRefused
from vla_attention.capture.torch_policies.inspect_calls import inspect
from vla_attention.capture.torch_policies.policy_layout import CallRule, PolicyLayout, RecordedSite
from vla_attention.capture.torch_policies.policy_modules import CannotRunEager
from vla_attention.capture.torch_policies.record import record
from vla_attention.capture.torch_policies.session import ContributionsUnknown, WeightsChanged
from vla_attention.capture.torch_policies.site_recorder import RowsDoNotMatch
from vla_attention.capture.torch_policies.unseen_attention import UnseenAttention
from vla_attention.schemas.errors import BadArgument, UserError
from vla_attention.schemas.interventions import knockout
from vla_attention.schemas.layout import PatchGrid, Role, SiteLayout, Span
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.verify import verify_store

WIDTH, HEADS, DIM, PREFIX, ACTIONS, BLOCKS = 8, 2, 4, 6, 3, 2
KEYS = PREFIX + ACTIONS
Attend = Callable[[nn.Module, Tensor, Tensor, Tensor], Tensor]


class Block(nn.Module):
    def __init__(self, attend: Attend, heads: int) -> None:
        super().__init__()
        self.num_heads, self.attend = heads, attend
        self.query, self.key, self.value = (nn.Linear(WIDTH, heads * DIM) for _ in range(3))
        self.out = nn.Linear(heads * DIM, WIDTH)
        self.kept: Tensor | None = None

    def forward(self, tokens: Tensor, prefix: Tensor) -> Tensor:
        both = torch.cat([prefix, tokens], dim=1)
        q, k, v = (
            linear(given).view(len(given), -1, self.num_heads, DIM).transpose(1, 2)
            for linear, given in ((self.query, tokens), (self.key, both), (self.value, both))
        )
        self.kept = logits(q.float(), k.float()).detach()
        return tokens + self.out(self.attend(self, q, k, v).transpose(1, 2).flatten(2))


class OddPolicy(nn.Module):
    """One call, without denoising: its blocks attend as they are told to."""

    def __init__(self, attend: Attend, heads: int = HEADS) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.blocks = nn.ModuleList(Block(attend, heads) for _ in range(BLOCKS))
        self.eval()

    def act(self, batch: int = 1) -> Tensor:
        numbers = torch.Generator().manual_seed(1)
        dtype = self.blocks[0].out.weight.dtype
        prefix = torch.randn(batch, PREFIX, WIDTH, generator=numbers).to(dtype)
        tokens = torch.randn(batch, ACTIONS, WIDTH, generator=numbers).to(dtype)
        with torch.no_grad():
            for block in self.blocks:
                tokens = block(tokens, prefix)
        return tokens


def logits(q: Tensor, k: Tensor) -> Tensor:
    return q @ k.transpose(-1, -2) / math.sqrt(DIM)


def by_hand(block: nn.Module, q: Tensor, k: Tensor, v: Tensor) -> Tensor:
    return torch.softmax(logits(q, k), dim=-1) @ v


def sdpa(block: nn.Module, q: Tensor, k: Tensor, v: Tensor) -> Tensor:
    return nn.functional.scaled_dot_product_attention(q, k, v)


def layout(**changes: object) -> PolicyLayout:
    spans = (
        Span("image_front", "image", 0, 4, "front", PatchGrid(2, 2, 8, 8)),
        Span("state", "state", 4, PREFIX),
        Span("actions", "action", PREFIX, KEYS),
    )
    roles = {"image_front": "image", "state": "state", "actions": "action"}
    fields = {
        "name": "odd",
        "family": "odd",
        "sites": (RecordedSite(SiteLayout("joint", spans), (0, ACTIONS), roles),),
        "rules": (CallRule(r"blocks\.(?P<block>\d+).*", "joint"),),
        "num_layers": BLOCKS,
        "num_heads": HEADS,
    }
    return PolicyLayout(**{**fields, **changes})  # type: ignore[arg-type]


def rows_of(path, policy, act=None, cut=None, shape=None, contributions=True):
    """Record one call; return its rows (block, head, query, key) and what it gave."""
    changes = knockout(cut) if isinstance(cut, str) else cut
    with (
        record(
            path / "a.zarr",
            policy,
            layout=shape or layout(),
            bits=23,
            queries="all",
            durable=False,
            interventions=changes,
            contributions=contributions,
        ) as run,
        run.episode(task_id=0, episode_index=0, instruction="") as episode,
        episode.replan(env_step=0),
    ):
        result = (act or policy.act)()
    store = open_store(path / "a.zarr")
    assert verify_store(store) == []
    return store.episodes[0].read("joint/rows")[0, :, 0], result


def expected(policy, hidden=()):
    """The rows of the last call, by hand, without the keys `hidden`."""
    kept = torch.stack([block.kept[0] for block in policy.blocks])
    kept = kept.float()
    kept[..., list(hidden)] = -math.inf
    return kept.softmax(-1).numpy()


def float32_softmax(block, q, k, v):
    """As SmolVLA: the softmax is of float32, the values are not."""
    return torch.softmax(logits(q.float(), k.float()), dim=-1).to(v.dtype) @ v


@pytest.mark.parametrize("cut", [None, "role:state"])
def test_a_float32_softmax_over_bfloat16_values(tmp_path, cut):
    policy = OddPolicy(float32_softmax).to(torch.bfloat16)
    own = policy.act()
    rows, result = rows_of(tmp_path, policy, cut=cut)
    assert torch.equal(result, own) == (cut is None)
    np.testing.assert_allclose(rows, expected(policy, (4, 5) if cut else ()), atol=2e-6)


class MultiheadBlock(nn.Module):
    def __init__(self, dropout: float) -> None:
        super().__init__()
        self.attention = nn.MultiheadAttention(WIDTH, HEADS, dropout=dropout, batch_first=True)
        self.out = self.attention.out_proj

    def forward(self, tokens: Tensor, prefix: Tensor) -> Tensor:
        both = torch.cat([prefix, tokens], dim=1)
        return tokens + self.attention(tokens, both, both, need_weights=False)[0]


def multihead_policy(dropout: float) -> OddPolicy:
    policy = OddPolicy(by_hand)
    policy.blocks = nn.ModuleList(MultiheadBlock(dropout) for _ in range(BLOCKS))
    return policy.eval()


def dropped_by_hand(block, q, k, v):
    return nn.functional.dropout(torch.softmax(logits(q, k), dim=-1), 0.5, block.training) @ v


def dropped_by_sdpa(block, q, k, v):
    return nn.functional.scaled_dot_product_attention(q, k, v, dropout_p=0.5 if block.training else 0.0)


@pytest.mark.parametrize(
    "policy", [OddPolicy(dropped_by_hand), OddPolicy(dropped_by_sdpa), multihead_policy(0.5)], ids=["hand", "sdpa", "m"]
)
def test_dropout_in_training_mode_is_refused(tmp_path, policy):
    rows_of(tmp_path / "eval", policy)
    policy.train()
    torch.manual_seed(0)
    with pytest.raises(RowsDoNotMatch):
        rows_of(tmp_path / "train", policy)


def with_sink(block, q, k, v):
    """As gpt-oss: a trained logit for each head in the softmax, which has no value."""
    sink = torch.linspace(-1, 1, HEADS).view(1, HEADS, 1, 1).expand(len(q), -1, ACTIONS, 1).to(q.dtype)
    return torch.softmax(torch.cat([logits(q, k), sink], dim=-1), dim=-1)[..., :-1] @ v


def test_sinks_that_the_layout_does_not_name_are_refused(tmp_path):
    with pytest.raises(RowsDoNotMatch, match=r"0\.\d+ "):
        rows_of(tmp_path, OddPolicy(with_sink))


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize(
    ("cut", "hidden"),
    [(None, ()), ("role:state", (4, 5)), (knockout("role:state", keep=True), (0, 1, 2, 3))],
)
def test_sinks_are_keys_without_values_that_a_knockout_keeps(tmp_path, dtype, cut, hidden):
    (joint,) = layout().sites
    keys = replace(joint.keys, spans=(*joint.keys.spans, Span("sink", "state", KEYS, KEYS + 1)))
    site = replace(joint, keys=keys, role_of_span={**joint.role_of_span, "sink": "learned"}, sinks=1)
    policy = OddPolicy(with_sink).to(dtype)
    own = policy.act()
    rows, result = rows_of(tmp_path, policy, cut=cut, shape=layout(sites=(site,)))
    assert torch.equal(result, own) == (cut is None)
    kept = torch.stack([block.kept[0] for block in policy.blocks])
    kept[..., list(hidden)] = -math.inf
    sink = torch.linspace(-1, 1, HEADS).view(1, HEADS, 1, 1).expand(BLOCKS, -1, ACTIONS, 1)
    wanted = torch.cat([kept, sink], dim=-1).softmax(-1).numpy()
    np.testing.assert_allclose(rows, wanted, atol=2e-6 if dtype is torch.float32 else 6e-3)


def test_sinks_are_the_last_keys_of_a_layout():
    (joint,) = layout().sites
    with pytest.raises(BadArgument, match="actions 3"):
        replace(joint, sinks=1)


class GatedBlock(Block):
    """An attention block with a gate of experts in the same module."""

    def __init__(self, experts: int) -> None:
        super().__init__(by_hand, HEADS)
        self.gate = nn.Linear(WIDTH, experts)
        self.experts = nn.Parameter(torch.randn(experts, WIDTH, WIDTH))

    def forward(self, tokens: Tensor, prefix: Tensor) -> Tensor:
        chosen = torch.softmax(self.gate(tokens), dim=-1)
        each = torch.einsum("btw,ewd->bted", tokens, self.experts)
        return super().forward(torch.einsum("bte,bted->btd", chosen, each), prefix)


@pytest.mark.parametrize("experts", [4, KEYS])
def test_a_knockout_does_not_change_a_gate_of_experts(tmp_path, experts):
    policy = OddPolicy(by_hand)
    policy.blocks = nn.ModuleList(GatedBlock(experts) for _ in range(BLOCKS))
    policy.eval()
    own = policy.act()
    # The stream goes on through the experts alone, so that nobody can say what is added to it.
    rows, result = rows_of(tmp_path / "rows", policy, contributions=False)
    assert torch.equal(result, own)
    np.testing.assert_allclose(rows, expected(policy), atol=2e-6)
    if experts == KEYS:  # as many experts as keys: nothing tells the two apart before the product
        with pytest.raises(ChangeRefused):
            rows_of(tmp_path / "knockout", policy, cut="role:state")
    else:
        rows, _ = rows_of(tmp_path / "knockout", policy, cut="role:state", contributions=False)
        np.testing.assert_allclose(rows, expected(policy, (4, 5)), atol=2e-6)


def queries_first(block, q, k, v):
    """Softmax over (batch, query, head, key)."""
    scores = torch.einsum("bhqd,bkhd->bqhk", q, k.transpose(1, 2)) / math.sqrt(DIM)
    return torch.einsum("bqhk,bhkd->bhqd", torch.softmax(scores, dim=-1), v)


def sharpened(block, q, k, v):
    """What is multiplied is not what the softmax gave."""
    rows = torch.softmax(logits(q, k), dim=-1).square()
    return rows / rows.sum(-1, keepdim=True) @ v


@pytest.mark.parametrize("heads", [None, [1]])
@pytest.mark.parametrize("attend", [by_hand, queries_first, sharpened])
def test_a_knockout_hits_the_heads_and_queries_that_it_names(tmp_path, attend, heads):
    """With as many queries as heads, the sizes of the axes do not tell which is which."""
    policy, cut = OddPolicy(attend, heads=ACTIONS), knockout("role:state", heads=heads)
    shape = layout(num_heads=ACTIONS)
    if attend is queries_first and heads:
        with pytest.raises(ChangeRefused):
            rows_of(tmp_path, policy, cut=cut, shape=shape)
        return
    rows, _ = rows_of(tmp_path, policy, cut=cut, shape=shape)
    kept = torch.stack([block.kept[0] for block in policy.blocks])
    if attend is sharpened:
        kept = 2 * kept
    kept[:, slice(None) if heads is None else heads, :, 4:6] = -math.inf
    np.testing.assert_allclose(rows, kept.softmax(-1).numpy(), atol=2e-6)


@pytest.mark.parametrize("contributions", [True, False])
@pytest.mark.parametrize("turned", [False, True])
def test_heads_that_share_values_are_no_queries(tmp_path, contributions, turned):
    """Nothing in the products tells heads from queries, if there are as many; the tokens that they go to do."""
    order = "bqhk" if turned else "bhqk"

    def attend(block, q, k, v):
        block.kept = logits(q, k[:, :1])
        scores = torch.einsum(f"bhqd,bkd->{order}", q, k[:, 0]) / math.sqrt(DIM)
        return torch.einsum(f"{order},bkd->bhqd", torch.softmax(scores, dim=-1), v[:, 0])

    policy, shape = OddPolicy(attend, heads=ACTIONS), layout(num_heads=ACTIONS)
    if turned:
        with pytest.raises((RowsRefused, ContributionsUnknown)):
            rows_of(tmp_path, policy, shape=shape, contributions=contributions)
        return
    rows, result = rows_of(tmp_path, policy, shape=shape, contributions=contributions)
    assert torch.equal(result, policy.act())
    np.testing.assert_allclose(rows, expected(policy), atol=2e-6)


def test_a_knockout_of_some_queries_is_refused_where_they_may_be_heads(tmp_path):
    sites = tuple(replace(site, action_queries=(-2, None)) for site in layout().sites)
    shape = layout(num_heads=ACTIONS, sites=sites)
    with pytest.raises(ChangeRefused):
        rows_of(tmp_path, OddPolicy(queries_first, heads=ACTIONS), cut="role:state", shape=shape)


#: With as many channels as the layout has keys, `KEYS`.
LINEAR = {
    "both": lambda q, k, v: q.softmax(-1) @ (k.softmax(-2).mT @ v),
    "queries": lambda q, k, v: q.softmax(-1) @ (nn.functional.elu(k).mT @ v),
    "scaled": lambda q, k, v: q.softmax(-1) @ (k.softmax(-2).mT @ v / 3).contiguous(),
}


@pytest.mark.parametrize("multiply", LINEAR.values(), ids=LINEAR)
@pytest.mark.parametrize("cut", [None, "role:state"])
def test_linear_attention_has_no_rows(tmp_path, multiply, cut):
    def attend(block, q, k, v):
        return multiply(*(torch.cat([given, given, given[..., :1]], dim=-1) for given in (q, k)), v)

    policy = OddPolicy(attend)
    with pytest.raises(RowsRefused if cut is None else ChangeRefused):
        rows_of(tmp_path, policy, cut=cut)


def test_linear_attention_by_a_softmax_over_keys_has_no_rows(tmp_path):
    """The first product looks like attention of as many queries as channels; the second sums over these."""

    def attend(block, q, k, v):
        context = torch.einsum("bhdn,bhen->bhde", k.mT.contiguous().softmax(-1), v.mT)
        return torch.einsum("bhde,bhdn->bhne", context, q.mT)

    policy = OddPolicy(attend)
    with pytest.raises(RowsRefused):
        rows_of(tmp_path, policy)
    table = inspect(policy, policy.act)
    assert all(row.refused for row in table.rows)


BETWEEN = {
    "linear": lambda z, other: nn.functional.linear(z, torch.eye(KEYS)),
    "convolution": lambda z, other: nn.functional.conv1d(z.flatten(0, 1), torch.ones(ACTIONS, ACTIONS, 1)).view_as(z),
    "baddbmm": lambda z, other: torch.baddbmm(z[0], other[0], torch.eye(KEYS).expand(HEADS, -1, -1))[None],
    "sum": lambda z, other: z + other,
    "in place": lambda z, other: other.clone().add_(z),
}


@pytest.mark.parametrize("between", BETWEEN.values(), ids=BETWEEN)
def test_a_softmax_of_features_is_followed_to_no_product_of_others(tmp_path, between):
    """A gate in front of the attention, whose result looks like probabilities again."""

    def attend(block, q, k, v):
        wide = torch.cat([q, q, q[..., :1]], dim=-1)  # KEYS channels
        made = between(torch.softmax(wide, dim=-1), wide)
        return by_hand(block, q, k, v) + 0 * (made @ v)

    policy = OddPolicy(attend)
    rows, result = rows_of(tmp_path, policy, contributions=False)
    assert torch.equal(result, policy.act())
    np.testing.assert_allclose(rows, expected(policy), atol=2e-6)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16, torch.float16])
@pytest.mark.parametrize("low", [-30.0, -90.0, -100.0, -1000.0])
@pytest.mark.parametrize("how", ["hand", "sdpa", "hand, causal"])
def test_masks_of_every_depth(tmp_path, dtype, low, how):
    """A key that is far below is masked: its role and the baseline say so; one that is a little below is read."""
    mask = torch.zeros(ACTIONS, KEYS)
    mask[: 2 if "causal" in how else None, 2] = low

    def attend(block, q, k, v):
        if how == "sdpa":
            return nn.functional.scaled_dot_product_attention(q, k, v, attn_mask=mask.to(dtype))
        return torch.softmax(logits(q, k) + mask.to(dtype), dim=-1) @ v

    rows_of(tmp_path, OddPolicy(attend).to(dtype))
    episode = open_store(tmp_path / "a.zarr").episodes[0]
    hidden = (mask < -50).numpy()
    image, masked = Role.IMAGE, Role.MASKED_IMAGE
    assert episode.read("joint/key_role")[0, 2] == (masked if hidden[:, 2].all() else image)
    uniform = np.where(hidden, 0, 1 / (KEYS - hidden.sum(-1, keepdims=True)))
    stored = np.broadcast_to(episode.uniform("joint")[0, 0, 0, 0], uniform.shape)
    np.testing.assert_allclose(stored, uniform, rtol=1e-6)


def test_a_knockout_leaves_no_query_with_masked_keys_alone(tmp_path):
    def attend(block, q, k, v):
        return torch.softmax(logits(q, k) - 100.0 * (torch.arange(KEYS) == 2), dim=-1) @ v

    with pytest.raises(QueryWithoutKeys):
        rows_of(tmp_path, OddPolicy(attend), cut="* - patch:front[1:2,0:1]")


def two_softmaxes(block, q, k, v):
    rows = (torch.softmax(logits(q, k), dim=-1) + torch.softmax(2 * logits(q, k), dim=-1)) / 2
    return rows @ v


@pytest.mark.parametrize("cut", [None, "role:state"])
def test_a_mean_of_two_softmaxes(tmp_path, cut):
    policy = OddPolicy(two_softmaxes)
    rows, _ = rows_of(tmp_path, policy, cut=cut)
    kept = torch.stack([block.kept[0] for block in policy.blocks])
    kept[..., 4 : 6 if cut else 4] = -math.inf
    np.testing.assert_allclose(rows, (kept.softmax(-1) + (2 * kept).softmax(-1)).numpy() / 2, atol=2e-6)


def best_by_hand(block, q, k, v):
    scores = logits(q, k)
    return torch.softmax(scores.masked_fill(scores < scores.topk(5).values[..., -1:], -math.inf), dim=-1) @ v


def best_by_sdpa(block, q, k, v):
    scores = logits(q, k)
    chosen = scores >= scores.sort(-1, descending=True).values[..., 4:5]
    return nn.functional.scaled_dot_product_attention(q, k, v, attn_mask=chosen)


@pytest.mark.parametrize("attend", [best_by_hand, best_by_sdpa])
def test_keys_that_are_selected_by_their_scores_are_recorded_and_not_cut(tmp_path, attend):
    policy = OddPolicy(attend)
    rows, result = rows_of(tmp_path / "rows", policy)
    assert torch.equal(result, policy.act())
    kept = torch.stack([block.kept[0] for block in policy.blocks])
    best = kept.masked_fill(kept < kept.topk(5).values[..., -1:], -math.inf)
    np.testing.assert_allclose(rows, best.softmax(-1).numpy(), atol=2e-6)
    with pytest.raises(ChangeRefused):
        rows_of(tmp_path / "cut", policy, cut="role:state")


@pytest.mark.parametrize(("bias", "diagonal"), [(causal_lower_right, KEYS - ACTIONS), (causal_upper_left, 0)])
@pytest.mark.parametrize("cut", [None, "role:image & keys:1-2"])
def test_causal_biases_of_torch(tmp_path, bias, diagonal, cut):
    def attend(block, q, k, v):
        return nn.functional.scaled_dot_product_attention(q, k, v, attn_mask=bias(ACTIONS, KEYS))

    policy = OddPolicy(attend)
    own = policy.act()
    rows, result = rows_of(tmp_path, policy, cut=cut)
    assert torch.equal(result, own) == (cut is None)
    kept = torch.stack([block.kept[0] for block in policy.blocks])
    kept = kept.masked_fill(torch.ones(ACTIONS, KEYS).triu(diagonal + 1).bool(), -math.inf)
    kept[..., 1 : 3 if cut else 1] = -math.inf
    np.testing.assert_allclose(rows, kept.softmax(-1).numpy(), atol=2e-6)


def compiled(rows, v):
    return torch.compile(lambda rows, v: rows @ v, backend="eager")(rows, v)


#: Further ways to compute softmax(scores) v, with rows that are right, and with an error.
SEEN = {
    "float64": lambda s, v: (s.double().softmax(-1) @ v.double()).float(),
    "dim by its number": lambda s, v: nn.functional.softmax(s, 3) @ v,
    "the operator": lambda s, v: torch.ops.aten._softmax(s, -1, False) @ v,
    "dropout of 0": lambda s, v: nn.functional.dropout(s.softmax(-1), 0.3, training=False) @ v,
    "minus and plus": lambda s, v: (s.softmax(-1) - 1 / KEYS + 1 / KEYS) @ v,
    "renormalised": lambda s, v: (s.softmax(-1) / s.softmax(-1).sum(-1, keepdim=True)) @ v,
    "a head left out": lambda s, v: (s.softmax(-1) @ v) * torch.tensor([1.0, 0.0]).view(1, -1, 1, 1),
    "compiled product": lambda s, v: compiled(s.softmax(-1), v),
    "gate of features": lambda s, v: s.softmax(-1) @ v + 0 * v[:, :, :ACTIONS].softmax(-1),
}
NOT_SEEN = {
    "log": lambda s, v: s.log_softmax(-1).exp() @ v,
    "exp and sum": lambda s, v: s.exp() @ v / s.exp().sum(-1, keepdim=True),
    "parts of the queries": lambda s, v: torch.cat([part.softmax(-1) @ v for part in s.split(2, 2)], 2),
    "parts of the queries in one": lambda s, v: torch.cat([part.softmax(-1) for part in s.split(2, 2)], 2) @ v,
    "three operands": lambda s, v: torch.einsum("bhqk,bhkd,de->bhqe", s.softmax(-1), v, torch.eye(DIM)),
    "vmap": lambda s, v: torch.vmap(lambda s, v: s.softmax(-1) @ v, in_dims=1, out_dims=1)(s, v),
    "mask without a sum of 1": lambda s, v: (s.softmax(-1) * (torch.arange(KEYS) != 2)) @ v,
    "heads side by side": lambda s, v: (
        s.permute(0, 2, 1, 3).flatten(2).softmax(-1).view(1, ACTIONS, HEADS, KEYS).transpose(1, 2) @ v
    ),
    "accumulated": lambda s, v: torch.baddbmm(torch.zeros(HEADS, ACTIONS, DIM), s.softmax(-1)[0], v[0])[None],
    "mixed heads": lambda s, v: torch.einsum("bhqk,hg->bgqk", s.softmax(-1), torch.ones(HEADS, HEADS) / HEADS) @ v,
    "with a table": lambda s, v: (s.softmax(-1) + torch.full_like(s, 1 / KEYS)) / 2 @ v,
}


@pytest.mark.parametrize("way", SEEN.values(), ids=SEEN)
@pytest.mark.parametrize("cut", [None, "role:state"])
def test_ways_that_are_seen(tmp_path, way, cut):
    policy = OddPolicy(lambda block, q, k, v: way(logits(q, k), v))
    own = policy.act()
    rows, result = rows_of(tmp_path, policy, cut=cut, contributions=False)
    assert torch.equal(result, own) == (cut is None)
    np.testing.assert_allclose(rows, expected(policy, (4, 5) if cut else ()), atol=2e-6)


@pytest.mark.parametrize("way", NOT_SEEN.values(), ids=NOT_SEEN)
def test_ways_that_are_refused(tmp_path, way):
    with pytest.raises(UserError):
        rows_of(tmp_path, OddPolicy(lambda block, q, k, v: way(logits(q, k), v)))


def test_softmaxes_that_met_no_values_are_listed(tmp_path):
    def attend(block, q, k, v):
        rows = torch.softmax(logits(q, k), dim=-1)
        return torch.cat([rows[:, :, :2], rows[:, :, 2:]], dim=2) @ v

    policy = OddPolicy(attend)
    for refused in (lambda: rows_of(tmp_path, policy), lambda: inspect(policy, policy.act)):
        with pytest.raises(UserError, match=r"blocks\.0: softmax, 3 x 9.*cat"):
            refused()


SPELLINGS = {
    "transpose": lambda p, v: torch.transpose(torch.transpose(input=p, dim0=1, dim1=2), 1, 2) @ v,
    "permute": lambda p, v: torch.permute(torch.permute(input=p, dims=(0, 2, 1, 3)), dims=(0, 2, 1, 3)) @ v,
    "einsum of a list": lambda p, v: torch.einsum("bhqk,bhkd->bhqd", [p, v]),
    "einsum of lists": lambda p, v: torch.einsum(p, [0, 1, 2, 3], v, [0, 1, 3, 4], [0, 1, 2, 4]),
}


@pytest.mark.parametrize("multiply", SPELLINGS.values(), ids=SPELLINGS)
@pytest.mark.parametrize("cut", [None, "role:state"])
def test_spellings_of_the_product(tmp_path, multiply, cut):
    policy = OddPolicy(lambda block, q, k, v: multiply(torch.softmax(logits(q, k), dim=-1), v))
    own = policy.act()
    rows, result = rows_of(tmp_path, policy, cut=cut)
    assert torch.equal(result, own) == (cut is None)
    np.testing.assert_allclose(rows, expected(policy, (4, 5) if cut else ()), atol=2e-6)


@pytest.mark.parametrize("heads", [2, 3])
@pytest.mark.parametrize("first", [True, False])
def test_relative_positions_added_to_the_values_are_not_the_values(tmp_path, heads, first):
    table = torch.randn(ACTIONS, KEYS, DIM)

    def attend(block, q, k, v):
        rows = torch.softmax(logits(q, k), dim=-1)
        if first:  # with as many heads as queries their rows would have the same shape
            return torch.einsum("bhqk,qkd->bhqd", rows, table) + rows @ v
        return rows @ v + torch.einsum("bhqk,qkd->bhqd", rows, table)

    policy = OddPolicy(attend, heads=heads)
    shape = layout(num_heads=heads)
    with pytest.raises(ContributionsUnknown):  # keys give more than their values
        rows_of(tmp_path / "with", policy, shape=shape)
    rows, _ = rows_of(tmp_path, policy, shape=shape, contributions=False)
    np.testing.assert_allclose(rows, expected(policy), atol=2e-6)


def test_a_knockout_where_the_softmax_is_written_over_its_logits(tmp_path):
    def attend(block, q, k, v):
        scores = logits(q, k)
        torch.softmax(scores, dim=-1, out=scores)
        return scores @ v

    policy = OddPolicy(attend)
    rows, _ = rows_of(tmp_path, policy, cut="role:image")
    np.testing.assert_allclose(rows, expected(policy, range(4)), atol=2e-6)
    roles = open_store(tmp_path / "a.zarr").episodes[0].read("joint/key_role")[0]
    assert set(roles[:4]) == {1}  # image, and not masked


def test_keys_of_the_state_that_no_query_may_see_are_absent(tmp_path):
    mask = torch.ones(ACTIONS, KEYS).bool()
    mask[:, 4] = False
    policy = OddPolicy(lambda block, q, k, v: nn.functional.scaled_dot_product_attention(q, k, v, attn_mask=mask))
    rows, _ = rows_of(tmp_path, policy)
    np.testing.assert_allclose(rows, expected(policy, [4]), atol=2e-6)
    roles = open_store(tmp_path / "a.zarr").episodes[0].read("joint/key_role")[0]
    assert [Role(code).label for code in roles[4:6]] == ["absent", "state"]


KEY_ORDER, HEAD_ORDER = torch.tensor([8, 0, 7, 1, 6, 2, 5, 3, 4]), torch.tensor([1, 0])
PICKS = {
    "keys": lambda p, v: p[..., KEY_ORDER] @ v[:, :, KEY_ORDER],
    "heads": lambda p, v: (p[:, HEAD_ORDER] @ v[:, HEAD_ORDER])[:, HEAD_ORDER],
    "flip": lambda p, v: p.flip(-1) @ v.flip(2),
    "gather": lambda p, v: p.gather(-1, KEY_ORDER.expand(p.shape)) @ v[:, :, KEY_ORDER],
    "keys of changed rows": lambda p, v: (0.9 * p + 0.1 / KEYS)[..., KEY_ORDER] @ v[:, :, KEY_ORDER],
    "roll of changed rows": lambda p, v: (p.square() / p.square().sum(-1, keepdim=True)).roll(1, -1) @ v.roll(1, 2),
}


@pytest.mark.parametrize("multiply", PICKS.values(), ids=PICKS)
def test_an_index_that_may_permute_is_refused(tmp_path, multiply):
    policy = OddPolicy(lambda block, q, k, v: multiply(torch.softmax(logits(q, k), dim=-1), v))
    with pytest.raises(RowsRefused, match=r"blocks\.0: softmax, 3 x 9"):
        rows_of(tmp_path / "refused", policy)
    # Where its rows are not wanted, such a call is one like others.
    rules = (CallRule(r"blocks\.0", None), *layout().rules)
    sites = tuple(replace(site, keys=replace(site.keys, layers=(1,))) for site in layout().sites)
    policy.blocks[1].attend = by_hand
    rows, result = rows_of(tmp_path, policy, shape=layout(rules=rules, sites=sites))
    assert torch.equal(result, policy.act())
    np.testing.assert_allclose(rows, expected(policy)[1:], atol=2e-6)


def test_keys_gathered_for_each_query_are_refused(tmp_path):
    def attend(block, q, k, v):
        scores, order = logits(q, k).sort(dim=-1)
        each = v[:, :, None].expand(-1, -1, ACTIONS, -1, -1).gather(3, order[..., None].expand(*order.shape, DIM))
        return (torch.softmax(scores, dim=-1).unsqueeze(-2) @ each).squeeze(-2)

    with pytest.raises(RowsRefused):
        rows_of(tmp_path, OddPolicy(attend))


def test_products_of_some_queries_each_are_calls_of_their_own(tmp_path):
    def attend(block, q, k, v):
        rows = torch.softmax(logits(q, k), dim=-1)
        return torch.cat([rows[:, :, :2] @ v, rows[:, :, 2:] @ v], dim=2)

    sites = tuple(replace(site, action_queries=(-1, None)) for site in layout().sites)
    with pytest.raises(CallsDoNotFit, match="block 0: 2, block 1: 2"):
        rows_of(tmp_path, OddPolicy(attend), shape=layout(sites=sites))


def test_a_sum_before_the_projection_may_be_the_stream_where_nothing_follows(tmp_path):
    with pytest.raises(ContributionsUnknown, match="block 1"):
        rows_of(tmp_path, OddPolicy(lambda block, q, k, v: by_hand(block, q, k, v) + q))


def test_keys_that_a_slice_cuts_off_in_front(tmp_path):
    def attend(block, q, k, v):
        extra = torch.cat([torch.full((len(q), HEADS, ACTIONS, 1), -math.inf), logits(q, k)], dim=-1)
        return torch.softmax(extra, dim=-1)[..., 1:] @ v

    policy = OddPolicy(attend)
    np.testing.assert_allclose(rows_of(tmp_path, policy)[0], expected(policy), atol=2e-6)


@pytest.mark.parametrize("through_data", [False, True])
def test_weights_that_change_during_a_run_are_refused(tmp_path, through_data):
    policy = OddPolicy(sdpa)
    with record(tmp_path / "a.zarr", policy, layout=layout(), durable=False) as run:
        with run.episode(task_id=0, episode_index=0, instruction="") as episode, episode.replan(env_step=0):
            policy.act()
        with torch.no_grad():
            policy.blocks[0].out.weight.copy_(policy.blocks[0].out.weight.clone())  # written, and the same
        with run.episode(task_id=0, episode_index=1, instruction="") as episode, episode.replan(env_step=0):
            policy.act()
        if through_data:  # as a moving average does
            policy.blocks[1].out.weight.data.mul_(0.999)
        else:
            with torch.no_grad():
                policy.blocks[0].out.weight.mul_(1.5)
        with (
            pytest.raises(WeightsChanged),
            run.episode(task_id=0, episode_index=2, instruction="") as episode,
            episode.replan(env_step=0),
        ):
            policy.act()
    assert len(open_store(tmp_path / "a.zarr").episodes) == 2


def reuse_logits(block, q, k, v):
    scores = logits(q, k)
    rows = torch.softmax(scores, dim=-1)
    scores.zero_()
    return rows @ v


def swap_keys(block, q, k, v):
    rows = torch.softmax(logits(q, k), dim=-1)
    first = rows[..., 0].clone()
    rows[..., 0] = rows[..., 1]
    rows[..., 1] = first
    return rows @ v


def swap_keys_in_a_view(block, q, k, v):
    rows = torch.softmax(logits(q, k), dim=-1)
    flat = rows.view(-1, KEYS)
    first = flat[:, 0].clone()
    flat[:, 0] = flat[:, 1]
    flat[:, 1] = first
    return rows @ v


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize("attend", [reuse_logits, swap_keys, swap_keys_in_a_view])
@pytest.mark.parametrize("cut", [None, "role:image"])
@pytest.mark.parametrize("inference", [False, True])
def test_what_is_written_after_the_softmax_is_seen(tmp_path, dtype, attend, cut, inference):
    policy = OddPolicy(attend).to(dtype)

    def act() -> Tensor:
        with torch.inference_mode(inference):
            return policy.act()

    own = act()
    if attend is not reuse_logits and cut is None:
        with pytest.raises(RowsRefused):
            rows_of(tmp_path, policy, act)
        return
    rows, result = rows_of(tmp_path, policy, act, cut=cut)
    assert torch.equal(result, own) == (cut is None)
    wanted = expected(policy, range(4) if cut else ())
    np.testing.assert_allclose(rows, wanted, atol=2e-6 if dtype is torch.float32 else 4e-3)
    assert set(open_store(tmp_path / "a.zarr").episodes[0].read("joint/key_role")[0][:4]) == {1}


def test_a_cuda_graph_that_is_captured_in_the_block_is_refused(tmp_path, monkeypatch):
    policy = OddPolicy(lambda block, q, k, v: nn.functional.scaled_dot_product_attention(q, k, v))
    for name in ("is_initialized", "is_current_stream_capturing"):
        monkeypatch.setattr(torch.cuda, name, lambda: True)
    with pytest.raises(CannotRunEager, match="Switch the policy's CUDA graphs off"):
        rows_of(tmp_path, policy)


def test_attention_inside_of_vmap_is_refused(tmp_path):
    policy = OddPolicy(lambda block, q, k, v: torch.vmap(nn.functional.scaled_dot_product_attention)(q, k, v))
    with pytest.raises(UnseenAttention, match="vmap"):
        rows_of(tmp_path, policy)
