"""What uniform attention gives is recorded call by call: baselines hold under every kind of mask."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import nn
from torch.nn.attention.flex_attention import create_block_mask, flex_attention

import vla_attention as va
from tests.kit.small_torch_policy import HEADS, WIDTH, SmallPolicy, given, small_layout
from tests.kit.small_torch_variants import (
    TokenPolicy,
    split_heads,
    token_layout,
)
from tests.kit.thorough import thorough_except
from tests.kit.uniform_attention import check_uniform, lifts_of_groups, zero_queries
from vla_attention.capture.torch_policies.policy_layout import CallRule, PolicyLayout, RecordedSite
from vla_attention.capture.torch_policies.record import record
from vla_attention.schemas.layout import PatchGrid, SiteLayout, Span
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.verify import verify_store

PATCHES, WORDS, ACTIONS, LAYERS, STEPS = 4, 3, 5, 2, 2
KEYS = PATCHES + WORDS + ACTIONS


def full(layer, step, seen):
    pass


def causal_actions(layer, step, seen):
    """Each action sees the actions up to itself."""
    seen[..., -ACTIONS:] &= torch.ones(ACTIONS, ACTIONS, dtype=torch.bool).tril()


def sliding(layer, step, seen):
    """The second layer sees the last three keys only."""
    if layer:
        own = torch.arange(KEYS - ACTIONS, KEYS)[:, None] - torch.arange(KEYS)
        seen &= (own >= 0) & (own < 3)


def by_head(layer, step, seen):
    """The second head does not see pictures."""
    seen[1, :, :PATCHES] = False


def by_step(layer, step, seen):
    """The first denoise step does not see the first word, and the second query of all steps no words."""
    if step == 0:
        seen[..., PATCHES] = False
    seen[:, 1, PATCHES : PATCHES + WORDS] = False


def padded(layer, step, seen):
    seen[..., PATCHES + WORDS - 1] = False


MASKS = (full, causal_actions, sliding, by_head, by_step, padded)


def by_hand(q, k, v, seen):
    logits = (q @ k.transpose(2, 3) * q.shape[-1] ** -0.5).masked_fill(~seen, -1e9)
    return logits.softmax(-1) @ v


def fused(q, k, v, seen):
    return nn.functional.scaled_dot_product_attention(q, k, v, attn_mask=seen)


def flex(q, k, v, seen):
    mask = create_block_mask(lambda b, h, i, j: seen[h, i, j], 1, HEADS, q.shape[2], k.shape[2], device="cpu")
    return flex_attention(q, k, v, block_mask=mask)


class MaskedPolicy(nn.Module):
    """Action queries over pictures, words and actions; `change(layer, step, (head, query, key))` edits the mask."""

    def __init__(self, attend, change) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.attend, self.change = attend, change
        self.blocks = nn.ModuleList(Block() for _ in range(LAYERS))

    def seen(self, layer, step):
        seen = torch.ones(HEADS, ACTIONS, KEYS, dtype=torch.bool)
        self.change(layer, step, seen)
        return seen

    @torch.no_grad()
    def act(self, prefix, actions):
        for step in range(STEPS):
            for layer, block in enumerate(self.blocks):
                actions = actions + block(prefix, actions, self.attend, self.seen(layer, step))
        return actions


class Block(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.qkv, self.out = nn.Linear(WIDTH, 3 * WIDTH), nn.Linear(WIDTH, WIDTH)

    def forward(self, prefix, actions, attend, seen):
        q, k, v = (split_heads(part) for part in self.qkv(torch.cat([prefix, actions], dim=1)).chunk(3, dim=-1))
        return self.out(attend(q[:, :, -ACTIONS:], k, v, seen).transpose(1, 2).flatten(2))


def masked_layout() -> PolicyLayout:
    spans = (
        Span("image_front", "image", 0, PATCHES, "front", PatchGrid(2, 2, 8, 8)),
        Span("prompt", "text", PATCHES, PATCHES + WORDS),
        Span("actions", "action", PATCHES + WORDS, KEYS),
    )
    roles = {"image_front": "image", "prompt": "text", "actions": "action"}
    return PolicyLayout(
        name="masked",
        family="masked",
        sites=(RecordedSite(SiteLayout("joint", spans), (0, ACTIONS), roles),),
        rules=(CallRule(r"blocks\.(?P<block>\d+)", "joint"),),
        num_layers=LAYERS,
        num_heads=HEADS,
        num_denoise_steps=STEPS,
        action_horizon=ACTIONS,
    )


def record_masked(path, policy, **changes):
    prefix, noise = torch.randn(1, PATCHES + WORDS, WIDTH), torch.randn(1, ACTIONS, WIDTH)
    settings = {"layout": masked_layout(), "denoise_steps": "all", "durable": False} | changes
    with (
        record(path, policy, **settings) as run,
        run.episode(task_id=0, episode_index=0, instruction="") as episode,
    ):
        for step in range(2):
            with episode.replan(env_step=step):
                policy.act(prefix, noise)
    assert verify_store(open_store(path)) == []
    return open_store(path).episodes[0]


WAYS = [
    (attend, change, queries) for attend in (fused, by_hand, flex) for change in MASKS for queries in ("mean", "all")
]
#: Every mask, every way of attending and every way of storing queries, in pairs that show the most.
FAST = [
    *((fused, change, "all") for change in MASKS),
    *((attend, by_step, queries) for attend in (by_hand, flex) for queries in ("mean", "all")),
    (flex, by_head, "all"),
]


@pytest.mark.parametrize(("attend", "change", "queries"), thorough_except(FAST, WAYS, several=True))
def test_every_query_s_own_keys_are_the_baseline(tmp_path, attend, change, queries):
    policy = MaskedPolicy(attend, change)
    assert zero_queries(policy) == LAYERS
    episode = record_masked(tmp_path / "a.zarr", policy, queries=queries)
    seen = np.stack([[policy.seen(layer, step).numpy() for step in range(STEPS)] for layer in range(LAYERS)])
    expected = seen / seen.sum(-1, keepdims=True)  # (layer, denoise, head, query, key)
    if queries == "mean":
        expected = expected.mean(3, keepdims=True)
    given = episode.uniform("joint")[:1]
    np.testing.assert_allclose(np.broadcast_to(given, (1, *expected.shape))[0], expected, rtol=1e-6)
    for axis in range(5):
        if given.shape[axis] > 1:
            assert (given != given.take([0], axis)).any(), "what is the same along an axis is stored once"
    # Rows of queries that are zero are the baseline itself.
    np.testing.assert_allclose(episode.read("joint/rows")[0], expected, rtol=2e-3, atol=1e-7)
    check_uniform(tmp_path / "a.zarr")


def test_a_sliding_layer_beside_a_full_one(tmp_path):
    """Before, action had lift 1.875 and text 1.25 in the sliding layer, and pictures that it cannot see counted."""
    policy = MaskedPolicy(fused, sliding)
    zero_queries(policy)
    record_masked(tmp_path / "a.zarr", policy)
    groups = lifts_of_groups(tmp_path / "a.zarr")["joint"]
    by_layer = {name: np.array(lifts, dtype=float).reshape(2, LAYERS, STEPS, HEADS) for name, lifts in groups.items()}
    np.testing.assert_allclose(by_layer["visual"][:, 0], 1, rtol=1e-5)
    assert np.isnan(by_layer["visual"][:, 1]).all()
    np.testing.assert_allclose(by_layer["action"], 1, rtol=1e-5)
    cells = va.open(tmp_path / "a.zarr").analyze()["replans"].filter(layer="layers_avg")
    assert cells["ratio_lift"].to_list() == pytest.approx([1.0, 1.0], rel=1e-5)
    assert cells["uniform_ratio"].to_list() == pytest.approx([PATCHES / WORDS] * 2, rel=1e-5)


def test_small_policies_of_every_kind(tmp_path):
    policy = SmallPolicy()
    assert zero_queries(policy) == 3
    with record(
        tmp_path / "small.zarr", policy, layout=small_layout(), tokenizer=policy.tokenizer, durable=False
    ) as run:
        for number, text in enumerate(("pick the bowl", "pick up the plate")):
            with run.episode(task_id=number, episode_index=0, instruction=text) as episode, episode.replan(env_step=0):
                policy.act(**given(text=text))
    tokens = TokenPolicy()
    assert zero_queries(tokens) == 2
    for queries in ("mean", "all"):
        settings = {"layout": token_layout(), "tokenizer": tokens.tokenizer, "queries": queries, "durable": False}
        with record(tmp_path / f"{queries}.zarr", tokens, **settings) as run:
            for number, text in enumerate(("pick the bowl", "pick up the red bowl")):
                with (
                    run.episode(task_id=number, episode_index=0, instruction=text) as episode,
                    episode.replan(env_step=0),
                ):
                    tokens.act(torch.rand(3, 8, 8), text)
    for path in sorted(tmp_path.glob("*.zarr")):
        assert verify_store(open_store(path)) == []
        check_uniform(path)
