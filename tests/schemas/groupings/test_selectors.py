"""A kind of selector is one entry of a table: parser, checks and weights take it from there."""

from __future__ import annotations

import numpy as np
import pytest

from tests.kit.tokens import small_tokens
from vla_attention.schemas.groupings.grouping import Grouping
from vla_attention.schemas.groupings.resolve import check_names, resolve
from vla_attention.schemas.groupings.selectors import SELECTOR_KINDS, SelectorError, SelectorKind, no_keys
from vla_attention.schemas.groupings.vocabulary import collect_vocabulary


def test_a_new_kind_is_one_entry_of_the_table(monkeypatch):
    def every_nth(argument, tokens):
        member = no_keys(tokens)
        member[:, :: int(argument)] = True
        return member

    def problem(argument, vocabulary):
        steps = range(1, vocabulary.layout.num_keys)
        return None if argument.isdigit() and int(argument) in steps else f"'{argument}' is no step."

    monkeypatch.setitem(SELECTOR_KINDS, "every", SelectorKind("every nth key", every_nth, problem))
    tokens = small_tokens(2, 0, [0])
    vocabulary = collect_vocabulary([tokens])
    grouping = Grouping("g", {"some": ("every:3 - camera:base_0_rgb",), "rest": ("*",)})
    check_names(grouping, vocabulary)
    weights = resolve(grouping, tokens).weights
    assert np.flatnonzero(weights[0, :, 0]).tolist() == [12, 15, 18, 21, 24, 27, 30, 33, 36]
    assert (weights.sum(axis=2) == 1).all()
    with pytest.raises(SelectorError, match=r"'some'.*'every:99'"):
        check_names(Grouping("g", {"some": ("every:99",)}), vocabulary)
    with pytest.raises(SelectorError, match="'every'"):
        Grouping("g", {"some": ("evry:3",)})
