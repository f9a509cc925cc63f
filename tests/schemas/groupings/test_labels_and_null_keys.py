"""Names of groups: null keys apart from padding, words whose keys are not known, proxies without a verdict."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from msgspec import structs

from tests.kit.tokens import small_tokens
from vla_attention.schemas.groupings.builtin_groupings import BUILTIN_GROUPINGS, find_grouping
from vla_attention.schemas.groupings.grouping import Grouping, Ratio, with_groups
from vla_attention.schemas.groupings.resolve import check_names, resolve
from vla_attention.schemas.groupings.selectors import SelectorError
from vla_attention.schemas.groupings.vocabulary import EpisodeTokens, collect_vocabulary
from vla_attention.schemas.layout import Piece, Prompt, Role, SiteLayout, Span

INSTRUCTION = "put the bowl on the plate"
CROSS = SiteLayout("cross", (Span("text", "text", 0, 10),))


def text_tokens(role: Role, pieces: bool) -> EpisodeTokens:
    """Seven real positions (six words and an end) and three padded ones, with or without knowing which word each is."""
    roles = np.array([[role] * 6 + [Role.TEMPLATE if pieces else role] + [Role.NULL] * 3], dtype=np.uint8)
    prompt = Prompt(INSTRUCTION, (), (0, len(INSTRUCTION)))
    if pieces:
        found, position = [], 0
        for key, word in enumerate(INSTRUCTION.split()):
            found.append(Piece(key, word, position, position + len(word)))
            position += len(word) + 1
        prompt = structs.replace(prompt, pieces=tuple(found))
    return EpisodeTokens(CROSS, roles, (prompt,), np.array([0]))


SPELT, UNSPELT = text_tokens(Role.INSTRUCTION, True), text_tokens(Role.TEXT, False)


@pytest.mark.parametrize("name", ["default", "instruction", "cameras"])
def test_null_keys_are_a_group_of_their_own_where_there_are_any(name):
    grouping = BUILTIN_GROUPINGS[name](collect_vocabulary([SPELT]))
    resolved = resolve(grouping, SPELT)
    weights = dict(zip(resolved.names, resolved.weights[0].T, strict=True))
    assert weights["null"].tolist() == [0] * 7 + [1] * 3
    assert not weights["padding"].any()
    assert sum(weights.values()).tolist() == [1] * 10
    masked = small_tokens(2, 0, [0])
    assert "null" not in BUILTIN_GROUPINGS[name](collect_vocabulary([masked])).names


@pytest.mark.parametrize("selector", ["word:bowl", "words:all", "words:content", "role:text - word:bowl", "word:bowls"])
def test_words_that_nobody_can_place_are_an_error_that_says_what_to_do(selector):
    vocabulary = collect_vocabulary([UNSPELT])
    assert vocabulary.words == ()
    grouping = Grouping("g", {"noun": (selector, "role:null")}, allow_empty=("noun",))
    with pytest.raises(SelectorError, match=r"'noun'.*--t5-tokenizer"):
        check_names(grouping, vocabulary)
    whole = Grouping("g", {"text": ("role:text",)})
    check_names(whole, vocabulary)
    assert resolve(whole, UNSPELT).num_keys.tolist() == [[7.0]]


def test_a_text_left_out_on_purpose_is_no_error():
    """An all-zero embedding: every position is a null key, and there is an instruction that none of them spells."""
    empty = replace(UNSPELT, key_role=np.full((1, 10), Role.NULL, dtype=np.uint8))
    grouping = find_grouping("instruction", collect_vocabulary([empty]))
    resolved = resolve(grouping, empty)
    assert resolved.num_keys[0][resolved.names.index("null")] == 10


def test_labels_of_the_published_scripts_are_no_modalities():
    """A verdict on seeing and reading is for groups that see and read."""
    frames = SiteLayout(
        "self",
        (Span("blank", "latent", 0, 1), Span("primary", "latent", 1, 2, camera="primary")),
    )
    latent = EpisodeTokens(frames, np.array([[Role.BLANK, Role.IMAGE]], dtype=np.uint8))
    for tokens in (small_tokens(2, 0, [0]), latent):
        reference = find_grouping("reference", collect_vocabulary([tokens]))
        assert reference.ratio == Ratio(("visual",), ("linguistic",))
        assert not reference.compares_modalities
        changed = with_groups(reference, [("more", "keys:0")])
        assert not changed.compares_modalities
    own = Grouping(
        "own", {"visual": ("frame:primary",), "linguistic": ("frame:blank",)}, Ratio(("visual",), ("linguistic",))
    )
    assert not own.compares_modalities
    assert find_grouping("default", collect_vocabulary([small_tokens(2, 0, [0])])).compares_modalities
