"""GR00T N1.7: LeRobot 0.6's real class with small random weights, and everywhere a stand-in of the same calls."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from msgspec.structs import replace
from torch import Tensor, nn

import vla_attention as va
from tests.policies.policy_checks import (
    PolicyCase,
    check_change,
    check_contributions,
    check_rows,
    check_uniform_attention,
    kept_outputs,
    record,
    roles_of,
    rows_of,
    softmax_rows,
)
from tests.policies.word_tokenizer import INSTRUCTION, WordTokenizer

WIDTH, HEADS, DIM, CHUNK, STEPS, PLACEHOLDER, PATCHES, BLOCKS = 16, 2, 8, 4, 2, 98, 4, 6
WORDS = len(INSTRUCTION.split())


class Attention(nn.Module):
    """Attention as diffusers' class computes it: a bool mask of the keys, `to_q`, `to_k`, `to_v`, `to_out`."""

    def __init__(self) -> None:
        super().__init__()
        self.to_q, self.to_k, self.to_v = (nn.Linear(WIDTH, WIDTH) for _ in range(3))
        self.to_out = nn.ModuleList([nn.Linear(WIDTH, WIDTH)])

    def forward(self, tokens: Tensor, others: Tensor, mask: Tensor | None) -> Tensor:
        query, key, value = (
            part.unflatten(-1, (HEADS, DIM)).transpose(1, 2)
            for part in (self.to_q(tokens), self.to_k(others), self.to_v(others))
        )
        seen = None if mask is None else mask[:, None, None, :]
        out = nn.functional.scaled_dot_product_attention(query, key, value, attn_mask=seen)
        return self.to_out[0](out.transpose(1, 2).flatten(2))


class Block(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.attn1, self.norm3 = Attention(), nn.Identity()

    def forward(self, tokens: Tensor, others: Tensor | None, mask: Tensor | None) -> Tensor:
        return self.norm3(tokens + self.attn1(tokens, tokens if others is None else others, mask))


class Transformer(nn.Module):
    """Blocks 0, 4, ... read the text, blocks 2, 6, ... the pictures, odd ones themselves."""

    attend_text_every_n_blocks = 2

    def __init__(self) -> None:
        super().__init__()
        self.transformer_blocks = nn.ModuleList(Block() for _ in range(BLOCKS))
        self.config = SimpleNamespace(interleave_self_attention=True, num_attention_heads=HEADS)

    def forward(self, tokens: Tensor, others: Tensor, pictures: Tensor) -> Tensor:
        for number, block in enumerate(self.transformer_blocks):
            if number % 2:
                tokens = block(tokens, None, None)
            else:
                tokens = block(tokens, others, ~pictures if number % 4 == 0 else pictures)
        return tokens


class GR00TN17(nn.Module):
    """The stand-in."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.backbone = nn.Module()
        self.backbone.model = nn.Module()
        self.backbone.model.config = SimpleNamespace(image_token_id=PLACEHOLDER)
        self.backbone.model.language_model = nn.Module()
        self.backbone.model.language_model.embed_tokens = nn.Embedding(100, WIDTH)
        self.action_head = nn.Module()
        self.action_head.model = Transformer()
        self.action_head.action_horizon, self.action_head.action_dim = CHUNK, WIDTH
        self.action_head.num_inference_timesteps = STEPS

    @torch.no_grad()
    def get_action(self, ids: Tensor) -> Tensor:
        features = self.backbone.model.language_model.embed_tokens(ids)
        actions = torch.randn(1, CHUNK, WIDTH, generator=torch.Generator().manual_seed(0))
        state = torch.ones(1, 1, WIDTH)
        for _ in range(STEPS):
            tokens = torch.cat([state, actions], dim=1)
            out = self.action_head.model(tokens, features, ids == PLACEHOLDER)
            actions = actions + out[:, -CHUNK:] / STEPS
        return actions


@pytest.fixture(scope="module", params=["stand-in", "real class"])
def case(request: pytest.FixtureRequest) -> PolicyCase:
    ids = torch.tensor([[15, *[PLACEHOLDER] * PATCHES, *WordTokenizer().encode(INSTRUCTION)]])
    if request.param == "real class":
        pytest.importorskip("lerobot.policies.groot.groot_n1_7", reason="LeRobot 0.6's, in .venv-lerobot06")
        from tests.policies.lerobot_models import small_groot_n17

        policy, call = small_groot_n17(WIDTH, HEADS, DIM, CHUNK, STEPS, PLACEHOLDER, BLOCKS)
    else:
        policy = GR00TN17()
        call = policy.get_action
    layout = va.layouts.gr00t(policy, ids[0], cameras=["top"], picture_size=4, prompt_tokens=WORDS)
    # The stand-in is of no version.
    return PolicyCase(policy, layout if request.param == "real class" else replace(layout, versions={}), call, ids)


def test_text_only_and_picture_only_blocks_are_sites_of_their_own(case, tmp_path):
    store = record(case, tmp_path)
    sites = {site.name: site.layers for site in store.attributes.sites}
    assert sites == {"cross_text": (0, 4), "cross_image": (2,), "self": (1, 3, 5)}
    pictures, words = ["image"] * PATCHES, ["instruction"] * WORDS
    assert roles_of(store, "cross_text") == ["template", *["masked_image"] * PATCHES, *words]
    assert roles_of(store, "cross_image") == ["padding", *pictures, *["padding"] * WORDS]


def test_rows_are_those_of_the_blocks_own_queries_and_keys(case, tmp_path):
    store = record(case, tmp_path)
    attention = [block.attn1 for block in case.policy.action_head.model.transformer_blocks]
    pictures = case.observation[0] == PLACEHOLDER
    masks = {"cross_text": ~pictures, "cross_image": pictures, "self": None}
    queries = [module.to_q for module in attention]
    keys = [module.to_k for module in attention]
    with (
        kept_outputs(queries, lambda _module, _inputs, output: output[0]) as of_queries,
        kept_outputs(keys, lambda _module, _inputs, output: output[0]) as of_keys,
    ):
        case.call(case.observation)

    def heads(projected):
        return projected.unflatten(-1, (HEADS, DIM)).transpose(0, 1)

    for site in store.attributes.sites:
        rows = [
            [
                softmax_rows(heads(of_queries[block][step])[:, -CHUNK:], heads(of_keys[block][step]), DIM**-0.5, mask)
                for step in range(STEPS)
            ]
            for mask in [masks[site.name]]
            for block in site.layers
        ]
        check_rows(store, site.name, np.array(rows))


@pytest.mark.parametrize("site", ["cross_text", "cross_image", "self"])
def test_contributions_are_what_the_blocks_add(case, tmp_path, site):
    blocks = case.policy.action_head.model.transformer_blocks
    check_contributions(
        case,
        record(case, tmp_path),
        site,
        lambda block: ((blocks[block], "given"), (blocks[block].norm3, "given")),
        "action_head.model.transformer_blocks.{block}.attn1.to_out.0",
    )


@pytest.mark.parametrize("site", ["cross_text", "cross_image"])
def test_a_word_reaches_its_key_and_no_others(case, site):
    if not isinstance(case.policy, GR00TN17):
        pytest.skip("the real class's language model mixes words before any recorded block")
    bowl, plate = WordTokenizer().encode("bowl plate")
    check_change(case, "word:bowl", torch.where(case.observation == bowl, plate, case.observation), site=site)


def test_the_state_reaches_its_key(case):
    if isinstance(case.policy, GR00TN17):
        pytest.skip("the stand-in's state is always the same")
    check_change(case, "span:state", (case.observation, torch.zeros(1, 1, 6)), site="self")


def test_a_knockout_of_words_leaves_the_picture_only_blocks_alone(case, tmp_path):
    plain = record(case, tmp_path / "plain", replans=1)
    changed = record(case, tmp_path / "changed", replans=1, interventions=va.knockout("word:bowl"))
    bowl = 1 + PATCHES + INSTRUCTION.split().index("bowl")
    assert not rows_of(changed, "cross_text")[..., bowl].any()
    # At the first denoise step block 2 has other queries (block 0 changed them) but the same keys.
    assert rows_of(changed, "cross_image")[..., 1 : 1 + PATCHES].sum() == pytest.approx(
        rows_of(plain, "cross_image")[..., 1 : 1 + PATCHES].sum(), rel=1e-5
    )


def test_a_ratio_inside_a_text_only_block_has_a_sentence_or_no_number(case, tmp_path):
    record(case, tmp_path)
    run = va.open(tmp_path / "run.zarr")
    for site in ("cross_text", "cross_image", "self"):
        assert run.analyze(site=site)["steps_groups"].height > 0


def test_queries_of_zero_have_lift_1(case, tmp_path):
    check_uniform_attention(case, tmp_path)
