"""Word classes, phrases and shared keys: selectors that need the words of an instruction."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.kit.bowl_scene import bowl_tokens
from tests.kit.strategies import episode_tokens as random_tokens
from tests.kit.strategies import groupings
from vla_attention.schemas.groupings.grouping import Grouping
from vla_attention.schemas.groupings.resolve import check_names, memberships, resolve, shared_keys
from vla_attention.schemas.groupings.selector_parser import Atom, parse_selector
from vla_attention.schemas.groupings.selectors import SelectorError
from vla_attention.schemas.groupings.vocabulary import EpisodeTokens, collect_vocabulary


def keys(tokens: EpisodeTokens, selector: str, replan: int) -> list[int]:
    weights = resolve(Grouping("g", {"g": (selector,)}), tokens).weights[:, :, 0]
    return np.flatnonzero(weights[replan if len(weights) > 1 else 0]).tolist()


def test_word_classes_take_every_piece_at_every_replan():
    tokens = bowl_tokens(replans=3)  # one, two, three state digits: the instruction's keys move
    for replan in range(3):
        first = 512 + 1 + 1 + replan  # bos and digits come first
        # put the black bo wl on the plate
        assert keys(tokens, "words:content", replan) == [first + i for i in (0, 2, 3, 4, 7)]
        assert keys(tokens, "words:stop", replan) == [first + i for i in (1, 5, 6)]
        assert keys(tokens, "words:all", replan) == keys(tokens, "role:instruction", replan)
        assert keys(tokens, "word:BOWL", replan) == [first + 3, first + 4]
        assert keys(tokens, "word:'black bowl'", replan) == [first + i for i in (2, 3, 4)]


@given(data=st.data())
def test_content_and_stop_words_part_the_instruction(data):
    tokens = data.draw(random_tokens())
    grouping = Grouping("g", {"a": ("words:content",), "b": ("words:stop",)}, allow_empty=("a", "b"))
    both = resolve(grouping, tokens).weights.sum(axis=2)
    whole = resolve(Grouping("g", {"g": ("words:all",)}), tokens).weights[:, :, 0]
    assert np.array_equal(np.broadcast_to(both, whole.shape), whole)


@given(data=st.data())
def test_shared_keys_are_the_sums_of_what_both_groups_take(data):
    tokens = data.draw(random_tokens())
    first, second = (data.draw(groupings(tokens)).groups["g0"][0] for _ in range(2))
    grouping = Grouping("g", {"a": (first,), "b": (second,)}, overlap=True)
    shared = shared_keys(grouping, tokens)
    alone = resolve(Grouping("g", {"both": (f"({first}) & ({second})",)}), tokens).num_keys[:, 0]
    np.testing.assert_allclose(shared[:, 0, 1], np.broadcast_to(alone, shared.shape[:1]), atol=1e-5)
    own = resolve(grouping, tokens).num_keys
    diagonal = np.stack([shared[:, 0, 0], shared[:, 1, 1]], axis=1)
    np.testing.assert_allclose(diagonal, np.broadcast_to(own, diagonal.shape), atol=1e-5)
    assert set(memberships(grouping, tokens)) == {"a", "b"}


@pytest.mark.parametrize(
    ("selector", "named"),
    [
        ("words:nouns", ["'nouns'", "content, stop, all"]),
        ("words:contents", ["'contents'", "'content'"]),
        ('word:"bowl black"', ["'bowl black'", "'put the black"]),
        ('word:"!?"', ["'!?'"]),
    ],
)
def test_what_exists_nowhere_is_said(selector, named):
    tokens = bowl_tokens(replans=1)
    with pytest.raises(SelectorError) as caught:
        check_names(Grouping("g", {"g": (selector,)}), collect_vocabulary([tokens]))
    assert [name for name in named if name not in str(caught.value)] == []


def test_single_quotes_and_apostrophes():
    assert parse_selector("word:'black bowl'") == Atom("word", "black bowl")
    assert parse_selector("word:o'brien") == Atom("word", "o'brien")
    assert parse_selector("word:\"o'brien's mug\"") == Atom("word", "o'brien's mug")
    with pytest.raises(SelectorError, match="'word:'"):
        parse_selector("word:''")
