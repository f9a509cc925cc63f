"""`va.check_layout`: what a changed picture, word, state or noise moves, against what the layout names."""

from __future__ import annotations

import pytest
import torch
from msgspec.structs import replace

import vla_attention as va
from tests.kit.small_torch_policy import PROMPT, WIDTH, SmallPolicy, given, small_layout
from tests.kit.small_torch_variants import (
    PATCHES,
    OneModulePolicy,
    TokenPolicy,
    one_module_layout,
    token_layout,
)
from vla_attention.capture.torch_policies.call_order import CallsDoNotFit
from vla_attention.capture.torch_policies.inspect_calls import NoAttention
from vla_attention.capture.torch_policies.layout_check import NotRepeatable
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.groupings.selectors import SelectorError
from vla_attention.schemas.layout import PatchGrid, SiteLayout, Span

BATCH = given()
TEXT = "pick the bowl"


@pytest.fixture(scope="module")
def policy() -> SmallPolicy:
    return SmallPolicy()


def call(policy, **changes):
    return lambda: policy.act(**{**BATCH, **changes})


def one_patch_changed():
    pictures = BATCH["pictures"].clone()
    pictures[:, :, :4, 4:] = 1 - pictures[:, :, :4, 4:]
    return pictures


def changes(policy):
    return {
        "camera:front": call(policy, pictures=1 - BATCH["pictures"]),
        "patch:front[0:1,1:2]": call(policy, pictures=one_patch_changed()),
        "word:bowl": call(policy, texts=["pick the plate"]),
        "role:instruction - word:the": call(policy, texts=["up the plate"]),
        "span:state": call(policy, states=BATCH["states"] + 1),
        "span:actions": call(policy, noise=BATCH["noise"] + 1),
        "span:state | span:actions": call(policy, states=BATCH["states"] + 1, noise=BATCH["noise"] + 1),
    }


def check(policy, layout, perturb, **settings):
    settings = {"tokenizer": policy.tokenizer, "instruction": TEXT} | settings
    return va.check_layout(policy, call(policy), layout, perturb, **settings)


def test_a_right_layout_fits(policy):
    found = check(policy, small_layout(), changes(policy))
    assert found.fits
    moved = [change.moved for change in found.changes]
    first = 4 + PROMPT
    assert moved == [(0, 1, 2, 3), (1,), (7,), (5, 7), (first,), (11, 12, 13), (first, 11, 12, 13)]


def with_spans(*spans, **changes):
    site = replace(small_layout().sites[0], keys=SiteLayout("joint", spans))
    return small_layout(sites=(site,), **changes)


IMAGE_LAST = with_spans(
    Span("prompt", "text", 0, PROMPT),
    Span("image_front", "image", PROMPT, PROMPT + 4, "front", PatchGrid(2, 2, 8, 8)),
    Span("state", "state", 10, 11),
    Span("actions", "action", 11, 14),
)
STATE_LAST = with_spans(
    Span("image_front", "image", 0, 4, "front", PatchGrid(2, 2, 8, 8)),
    Span("prompt", "text", 4, 4 + PROMPT),
    Span("actions", "action", 10, 13),
    Span("state", "state", 13, 14),
)


@pytest.mark.parametrize(
    ("layout", "selector", "still", "moved"),
    [
        (IMAGE_LAST, "camera:front", "image_front", "prompt (keys 0..3)"),
        (IMAGE_LAST, "word:bowl", "prompt (key 3)", "image_front (key 7)"),
        (STATE_LAST, "span:state", "state", "actions (key 10)"),
    ],
)
def test_a_wrong_layout_does_not(policy, layout, selector, still, moved):
    found = check(policy, layout, {selector: changes(policy)[selector]})
    assert not found.fits
    verdict = str(found).splitlines()[-1]
    assert -1 < verdict.find(f" {still} ") < verdict.find(f" {moved} ")
    assert "1 of 1" in str(found)


def test_a_prompt_of_changing_length_and_generated_tokens():
    policy, picture = TokenPolicy(), torch.rand(3, 8, 8, generator=torch.Generator().manual_seed(1))
    perturb = {
        "camera:front": lambda: policy.act(1 - picture, TEXT),
        "word:the": lambda: policy.act(picture, "pick up bowl"),
        # A further word: the end of the prompt moves on, and a key is there that was not.
        "role:template": lambda: policy.act(picture, "pick the bowl bowl"),
    }
    settings = {"tokenizer": policy.tokenizer, "instruction": TEXT}
    found = va.check_layout(policy, lambda: policy.act(picture, TEXT), token_layout(), perturb, **settings)
    assert [change.fits for change in found.changes] == [True, True, False]
    assert f" prompt (key {PATCHES + 5}) " in found.changes[2].verdict
    with pytest.raises(BadArgument, match="'span:generated'"):
        va.check_layout(
            policy, lambda: policy.act(picture, TEXT), token_layout(), {"span:generated": perturb["word:the"]}
        )


def test_sites_of_the_first_block_and_a_chosen_one():
    policy = OneModulePolicy()
    prefix, noise = torch.randn(1, 5, WIDTH), torch.randn(1, 3, WIDTH)
    perturb = {"span:prefix": lambda: policy.act(1 + prefix, noise)}
    found = va.check_layout(policy, lambda: policy.act(prefix, noise), one_module_layout(), perturb)
    assert [(change.site, change.block, change.fits) for change in found.changes] == [("self", 0, True)]
    assert "cross" in str(found).splitlines()[-1]
    found = va.check_layout(policy, lambda: policy.act(prefix, noise), one_module_layout(), perturb, site="cross")
    assert [(change.site, change.block, change.fits) for change in found.changes] == [("cross", 1, True)]


def test_the_same_random_numbers_and_others(policy):
    def act(seed=None, **changes):
        if seed is not None:
            torch.manual_seed(next(seed))
        return policy.act(**{**BATCH, **changes, "noise": torch.randn(1, 3, 2)})

    torch.manual_seed(3)
    before = torch.random.get_rng_state()
    found = va.check_layout(policy, act, small_layout(), {"span:state": lambda: act(states=BATCH["states"] + 1)})
    assert found.fits
    assert torch.equal(torch.random.get_rng_state(), before)
    numbers = iter(range(9))
    with pytest.raises(NotRepeatable, match="actions at site 'joint'"):
        va.check_layout(policy, lambda: act(numbers), small_layout(), {"span:state": act})


def test_mistakes_name_what_was_given(policy):
    own, layout = call(policy), small_layout()
    with pytest.raises(BadArgument, match="changes"):
        va.check_layout(policy, own, layout, {})
    with pytest.raises(BadArgument, match=r"'word:bowl'.*tokenizer=.*instruction="):
        va.check_layout(policy, own, layout, {"word:bowl": own})
    with pytest.raises(SelectorError, match=r"'frond'.*'front'"):
        va.check_layout(policy, own, layout, {"camera:frond": own})
    with pytest.raises(CallsDoNotFit, match=r"has 2 heads|3 times"):
        va.check_layout(policy, own, small_layout(num_denoise_steps=3, denoise_times=()), {"span:state": own})
    with pytest.raises(NoAttention, match="'span:state'"):
        va.check_layout(policy, own, layout, {"span:state": lambda: None})
    with pytest.raises(BadArgument, match="batch of 2"):
        va.check_layout(policy, lambda: policy.act(**given(batch=2)), layout, {"span:state": own})
