"""Valid policies that no layout can say, or only just: refused with the way out by `va.inspect`, or recorded."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest
import torch
from msgspec import structs

import vla_attention as va
from tests.capture.torch_policies.cached_torch_policies import (
    LoopedPolicy,
    SlidingAttention,
    StaticAttention,
    cached_policy,
    fixed_layout,
    looped_layout,
)
from tests.capture.torch_policies.test_odd_policies import HEAD_ORDER, HEADS, OddPolicy, by_hand, logits
from tests.kit.small_torch_policy import HORIZON, WIDTH, SmallPolicy, given, small_layout
from tests.kit.small_torch_variants import token_layout
from vla_attention.capture.torch_policies.call_order import CallsDoNotFit
from vla_attention.capture.torch_policies.record import record
from vla_attention.schemas.interventions import knockout
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.verify import verify_store

PICTURE = torch.rand(3, 8, 8, generator=torch.Generator().manual_seed(0))


def record_call(path, policy, layout, call, **changes):
    changes = {"bits": 23, "queries": "all", "denoise_steps": "all", "durable": False, "contributions": False} | changes
    with (
        record(path / "a.zarr", policy, layout=layout, **changes) as run,
        run.episode(task_id=0, episode_index=0, instruction="") as episode,
        episode.replan(env_step=0),
    ):
        call()
    store = open_store(path / "a.zarr")
    assert verify_store(store) == []
    return store.episodes[0].read("joint/rows")[0]


@pytest.mark.parametrize(
    ("attention", "layout", "text", "shown"),
    [
        (StaticAttention, token_layout(), "pick the bowl", "1 x 15: .* 15 .* 9 "),
        (SlidingAttention, fixed_layout(), "the", "1 x 7: .* 7 "),
    ],
)
def test_caches_whose_keys_have_no_places(tmp_path, attention, layout, text, shown):
    policy = cached_policy(attention)
    table = str(va.inspect(policy, lambda: policy.act(PICTURE, text)))
    refused = [line for line in table.splitlines() if "refused" in line]
    assert len(refused) == 1
    assert " 1 x " in refused[0]
    way_out = ".*cache_implementation=None"
    assert re.search(f"refuses {re.escape('layers.{0,1}')}, {shown}{way_out}", table)
    with pytest.raises(CallsDoNotFit, match=way_out):
        record_call(tmp_path, policy, layout, lambda: policy.act(PICTURE, text))


def sinks(block, q, k, v):
    extra = torch.cat([logits(q, k), torch.ones(len(q), HEADS, q.shape[2], 1)], dim=-1)
    return torch.softmax(extra, dim=-1)[..., :-1] @ v


def picked(block, q, k, v):
    return (torch.softmax(logits(q, k), dim=-1)[:, HEAD_ORDER] @ v[:, HEAD_ORDER])[:, HEAD_ORDER]


def not_finite(block, q, k, v):
    return torch.softmax(logits(q * math.nan, k), dim=-1) @ v


@pytest.mark.parametrize(
    ("attend", "reason"),
    [
        (sinks, r"0\.\d+ "),
        (picked, "order"),
        (not_finite, "NaN"),
    ],
)
def test_inspect_shows_what_recording_refuses(attend, reason):
    policy = OddPolicy(attend)
    policy.blocks[1].attend = by_hand
    table = va.inspect(policy, policy.act)
    refused, *others = str(table).splitlines()[2:-2]
    assert refused.startswith("blocks.{0,1}" if attend is not_finite else "blocks.0")
    assert refused.endswith("refused")
    assert [line.split()[0] for line in others] == ([] if attend is not_finite else ["blocks.1"])
    assert all(line.endswith("e+00") or "e-0" in line for line in others)
    assert re.search(rf"refuses blocks\..*, 3 x 9: .*{reason}", str(table).splitlines()[-2])


def test_blocks_that_run_several_times_are_named_by_a_sequence(tmp_path):
    policy = LoopedPolicy()
    prefix, noise = torch.randn(1, 5, WIDTH), torch.randn(1, 3, WIDTH)
    sentence = r" 2 times .*block 0: 4, block 1: 4"
    with pytest.raises(CallsDoNotFit, match=sentence):
        record_call(tmp_path / "plain", policy, looped_layout(sequence=False), lambda: policy.act(prefix, noise))
    for block in policy.blocks:
        block.kept = []
    rows = record_call(tmp_path, policy, looped_layout(), lambda: policy.act(prefix, noise))
    for layer in range(4):
        for step in range(2):
            kept = policy.blocks[layer % 2].kept[2 * step + layer // 2]
            np.testing.assert_allclose(rows[layer, step], kept.numpy(), atol=2e-6)


class GuidedPolicy:
    """Guidance: the second row of each call has the instruction, the first has none."""

    def __init__(self):
        self.network = SmallPolicy()

    def act(self, pictures, texts, states, noise):
        both = {"pictures": pictures, "states": states, "noise": noise}
        both = {name: torch.cat([value, value]) for name, value in both.items()}
        without, with_text = self.network.act(**both, texts=["" for _ in texts] + texts).chunk(2)
        return without + 3 * (with_text - without)


def guided_layout():
    layout = small_layout()
    rules = tuple(structs.replace(rule, modules=rf"network\.{rule.modules}") for rule in layout.rules)
    return structs.replace(layout, rules=rules, text=structs.replace(layout.text, embedding="network.words"))


@pytest.mark.parametrize("changes", [None, knockout("word:bowl")])
def test_guidance_as_a_batch_of_two(tmp_path, changes):
    policy, inputs = GuidedPolicy(), given()
    own = policy.act(**inputs)
    table = str(va.inspect(policy, lambda: policy.act(**inputs)))
    assert "run.episodes([...])" in table.splitlines()[-1]
    settings = {"tokenizer": policy.network.tokenizer, "durable": False, "bits": 23, "interventions": changes}
    facts = {"task_id": 0, "episode_index": 0, "instruction": "pick the bowl"}
    with record(tmp_path / "a.zarr", policy, layout=guided_layout(), **settings) as run:
        with (
            pytest.raises(CallsDoNotFit, match=r"batch of 2, .*run\.episodes"),
            run.episode(**facts) as episode,
            episode.replan(env_step=0),
        ):
            policy.act(**inputs)
        with (
            run.episodes([facts], rows=[1], batch=2) as episodes,
            episodes.replan(env_step=0, state=inputs["states"], frames=[{"front": inputs["pictures"]}]) as replan,
        ):
            replan.actions = policy.act(**inputs)
            assert torch.equal(replan.actions, own) == (changes is None)
    with (
        record(tmp_path / "b.zarr", policy.network, layout=small_layout(), **settings) as run,
        run.episode(**facts) as episode,
        episode.replan(env_step=0) as replan,
    ):
        replan.actions = policy.network.act(**inputs)
    guided, plain = (open_store(tmp_path / name).episodes[0] for name in ("a.zarr", "b.zarr"))
    assert verify_store(open_store(tmp_path / "a.zarr")) == []
    assert guided.attributes.prompts == plain.attributes.prompts
    assert guided.read("actions").shape == (1, HORIZON, 2)
    for array in ("joint/rows", "joint/contribution", "joint/key_role"):
        np.testing.assert_allclose(guided.read(array), plain.read(array), atol=1e-5)
