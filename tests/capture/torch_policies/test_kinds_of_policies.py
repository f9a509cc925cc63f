"""Sessions with policies that generate tokens, have prompts of changing length, or sites in some blocks only."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import nn

import vla_attention as va
from tests.kit.small_torch_policy import HEADS, WIDTH, WORDS, WordTokenizer
from tests.kit.small_torch_variants import (
    BLOCKS,
    LONGEST,
    PATCHES,
    TOKENS,
    CausalAttention,
    Cross,
    OneModulePolicy,
    TokenPolicy,
    TurnsPolicy,
    one_module_layout,
    token_layout,
    turns_layout,
)
from vla_attention.capture.torch_policies.call_order import CallsDoNotFit
from vla_attention.capture.torch_policies.record import record
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.interventions import knockout
from vla_attention.schemas.layout import Role
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.verify import verify_store

TEXTS = ("pick the bowl", "pick up the red bowl")


def picture(seed):
    return torch.rand(3, 8, 8, generator=torch.Generator().manual_seed(seed))


def record_tokens(path, policy, tokens=TOKENS, texts=TEXTS, layout=None, **changes):
    changes = {"tokenizer": policy.tokenizer, "durable": False, "bits": 23} | changes
    with record(path / "a.zarr", policy, layout=layout or token_layout(), **changes) as run:
        for number, text in enumerate(texts):
            with run.episode(task_id=number, episode_index=0, instruction=text) as episode, episode.replan(env_step=0):
                given = policy.act(picture(number), text, tokens)
            assert given == policy.act(picture(number), text, tokens)
    store = open_store(path / "a.zarr")
    assert verify_store(store) == []
    return store


def computed(policy, number, text, tokens=TOKENS):
    """Rows (block, token, head, key of the site), by hand."""
    for layer in policy.layers:
        layer.kept = []
    policy.act(picture(number), text, tokens)
    length = len(policy.tokenizer.encode(text))
    rows = np.zeros((BLOCKS, tokens, HEADS, PATCHES + LONGEST + TOKENS - 1))
    for block, layer in enumerate(policy.layers):
        for token, row in enumerate(layer.kept):
            rows[block, token, :, : PATCHES + length] = row[:, : PATCHES + length]
            rows[block, token, :, PATCHES + LONGEST : PATCHES + LONGEST + token] = row[:, PATCHES + length :]
        layer.kept = None
    return rows


def test_every_generated_token_is_a_query(tmp_path):
    policy = TokenPolicy()
    store = record_tokens(tmp_path, policy, queries="all")
    for number, text in enumerate(TEXTS):
        rows = store.episodes[number].read("joint/rows")
        assert rows.shape == (1, BLOCKS, 1, HEADS, TOKENS, PATCHES + LONGEST + TOKENS - 1)
        expected = computed(policy, number, text).transpose(0, 2, 1, 3)
        np.testing.assert_allclose(rows[0, :, 0], expected, atol=2e-6)


def test_keys_that_do_not_exist_are_absent_and_not_padding(tmp_path):
    policy = TokenPolicy()
    store = record_tokens(tmp_path, policy)
    for number, words in enumerate((3, 5)):
        labels = [Role(code).label for code in store.episodes[number].read("joint/key_role")[0]]
        text = ["bos", *["instruction"] * words, "template"]
        assert labels[PATCHES : PATCHES + LONGEST] == text + ["absent"] * (LONGEST - len(text))
        assert labels[PATCHES + LONGEST :] == ["action"] * (TOKENS - 1)
        expected = computed(policy, number, TEXTS[number]).mean(1)
        np.testing.assert_allclose(store.episodes[number].read("joint/rows")[0, :, 0, :, 0], expected, atol=2e-6)
    assert set(va.open(tmp_path / "a.zarr").words()["words"]["item"]) >= {"pick", "red", "bowl"}


def test_fewer_tokens_than_planned(tmp_path):
    policy = TokenPolicy()
    with pytest.raises(CallsDoNotFit, match=r"\b4 .*stops_early=True"):
        record_tokens(tmp_path / "strict", policy, tokens=3)
    layout = token_layout(stops_early=True)
    store = record_tokens(tmp_path, policy, tokens=3, layout=layout)
    labels = [Role(code).label for code in store.episodes[0].read("joint/key_role")[0]]
    assert labels[-3:] == ["action", "action", "absent"]
    with pytest.raises(CallsDoNotFit, match=r"\b4 "):
        record_tokens(tmp_path / "more", policy, tokens=5, layout=layout)
    with pytest.raises(BadArgument, match=r"\b4 "):
        record_tokens(tmp_path / "all", policy, layout=layout, queries="all")


def test_contributions_of_tokens_are_the_mean_over_them(tmp_path):
    policy = TokenPolicy()
    store = record_tokens(tmp_path, policy, texts=TEXTS[:1])
    episode = store.episodes[0]
    gram = episode.read("joint/contribution")[0, :, 0]
    assert gram.shape[-1] == len(episode.attributes.segments["joint"]) + 1
    # Over all parts the contributions add up to the update.
    inner = gram[:, :-1, :-1].sum((1, 2))
    np.testing.assert_allclose(inner, gram[:, -1, -1], rtol=1e-4)
    absent = [i for i, segment in enumerate(episode.attributes.segments["joint"]) if segment.role == "absent"]
    assert absent
    assert (gram[:, absent] == 0).all()


def test_a_prompt_that_is_too_long_does_not_fit(tmp_path):
    with pytest.raises(CallsDoNotFit, match=r"9 .*'prompt' of 0 to 7"):
        record_tokens(tmp_path, TokenPolicy(), texts=("pick up the red bowl the plate",))


def test_sites_in_some_blocks_of_one_module(tmp_path):
    policy = OneModulePolicy()
    prefix, noise = torch.randn(1, 5, WIDTH), torch.randn(1, 3, WIDTH)
    with record(
        tmp_path / "a.zarr",
        policy,
        layout=one_module_layout(),
        bits=23,
        denoise_steps="all",
        durable=False,
        contributions=False,
    ) as run:
        expected = policy.act(prefix, noise)
        with run.episode(task_id=0, episode_index=0, instruction="") as episode, episode.replan(env_step=0):
            assert torch.equal(policy.act(prefix, noise), expected)
    store = open_store(tmp_path / "a.zarr")
    assert verify_store(store) == []
    episode = store.episodes[0]
    own, cross = episode.read("self/rows"), episode.read("cross/rows")
    assert (own.shape, cross.shape) == ((1, 2, 2, HEADS, 1, 8), (1, 2, 2, HEADS, 1, 5))
    assert episode.document("cross/zarr.json")["attributes"]["layer"] == [1, 3]
    heads = noise.view(1, 3, HEADS, -1).transpose(1, 2)
    keys = torch.cat([prefix, noise], dim=1).view(1, 8, HEADS, -1).transpose(1, 2)
    first = (heads @ keys.transpose(2, 3) * (WIDTH // HEADS) ** -0.5).softmax(-1).mean(2)
    np.testing.assert_allclose(own[0, 0, 0, :, 0], first[0].numpy(), atol=2e-6)


def test_blocks_that_read_the_text_or_the_pictures_only(tmp_path):
    policy = TurnsPolicy()
    with record(tmp_path / "a.zarr", policy, layout=turns_layout(), tokenizer=policy.tokenizer, durable=False) as run:
        for number in range(2):
            with run.episode(task_id=0, episode_index=number, instruction="pick the bowl") as episode:
                for step in range(2):
                    with episode.replan(env_step=step):
                        policy.act(torch.randn(1, PATCHES, WIDTH), "pick the bowl", torch.randn(1, 3, WIDTH))
    store = open_store(tmp_path / "a.zarr")
    assert verify_store(store) == []
    episode = store.episodes[0]
    text, image = (
        [Role(code).label for code in episode.read(f"{site}/key_role")[0]] for site in ("cross_text", "cross_image")
    )
    assert text == ["masked_image"] * PATCHES + ["bos", *["instruction"] * 3, "template"]
    assert image == ["image"] * PATCHES + ["padding"] * 5
    assert len(episode.attributes.prompts[0].pieces) == 4
    assert set(va.open(tmp_path / "a.zarr").words(site="cross_text")["words"]["item"]) >= {"pick", "the", "bowl"}


class DecoderBlock(nn.Module):
    """The actions read each other first, and then the text."""

    def __init__(self) -> None:
        super().__init__()
        self.own, self.cross = CausalAttention(), Cross()

    def forward(self, actions: torch.Tensor, words: torch.Tensor) -> torch.Tensor:
        self.own.cache = []
        actions = actions + self.own(actions)
        return actions + self.cross(actions, words, torch.ones(1, 1, 3, words.shape[1], dtype=torch.bool))


class DecoderPolicy(nn.Module):
    """A decoder over a prompt without padding."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.embed = nn.Embedding(len(WORDS), WIDTH)
        self.blocks = nn.ModuleList(DecoderBlock() for _ in range(2))
        self.tokenizer = WordTokenizer()

    @torch.no_grad()
    def act(self, text: str) -> torch.Tensor:
        words = self.embed(torch.tensor([self.tokenizer.encode(text)]))
        actions = torch.ones(1, 3, WIDTH).cumsum(1)
        for block in self.blocks:
            actions = block(actions, words)
        return actions


def decoder_layout() -> va.PolicyLayout:
    own = va.SiteLayout("self", (va.Span("actions", "action", 0, 3),))
    cross = va.SiteLayout("cross", (va.Span("prompt", "text", 0, LONGEST),))
    return va.PolicyLayout(
        name="decoder",
        family="decoder",
        sites=(
            va.RecordedSite(own, (0, 3), {"actions": "action"}),
            va.RecordedSite(cross, (0, 3), {"prompt": "instruction"}, "prompt"),
        ),
        rules=(
            va.CallRule(r"blocks\.(?P<block>\d+)\.own", "self"),
            va.CallRule(r"blocks\.(?P<block>\d+)\.cross", "cross"),
        ),
        num_layers=2,
        num_heads=HEADS,
        text=va.PromptText(("prompt",), "embed"),
    )


@pytest.mark.parametrize("contributions", [True, False])
@pytest.mark.parametrize("changes", [None, knockout("word:bowl")])
def test_actions_that_read_each_other_before_a_prompt_of_changing_length(tmp_path, contributions, changes):
    policy = DecoderPolicy()
    settings = {"layout": decoder_layout(), "tokenizer": policy.tokenizer, "durable": False, "interventions": changes}
    with record(tmp_path / "a.zarr", policy, contributions=contributions, **settings) as run:
        for number, text in enumerate(TEXTS):
            with run.episode(task_id=number, episode_index=0, instruction=text) as episode, episode.replan(env_step=0):
                policy.act(text)
    for text, episode in zip(TEXTS, open_store(tmp_path / "a.zarr").episodes, strict=True):
        words = text.split()
        roles = [Role(code).label for code in episode.read("cross/key_role")[0]]
        assert roles == ["bos", *["instruction"] * len(words), "template"] + ["absent"] * (LONGEST - len(words) - 2)
        rows = episode.read("cross/rows")[0]
        assert (rows[..., words.index("bowl") + 1] == 0).all() == (changes is not None)
        assert (rows[..., : len(words) + 2].sum(-1) > 0.999).all()
        assert episode.has("cross/contribution") == contributions
