"""What uniform attention gives to every key: the table that Python and the viewer's page share, query by query."""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
import pytest

from tests.kit.uniform_cases import LENGTHS, TABLE, attention, tokens_of_case
from vla_attention.schemas.groupings.key_counts import uniform_of_roles, uniform_rows
from vla_attention.schemas.layout import INVALID_ROLES, Role

#: The table has 10 digits.
CLOSE = 1e-9
STORED = pytest.mark.parametrize("case", TABLE["stored"], ids=lambda case: case["name"])
#: The groups of `default`, as roles.
GROUPS = {
    "visual": (Role.IMAGE,),
    "linguistic": (Role.BOS, Role.TEMPLATE, Role.INSTRUCTION, Role.TEXT),
    "state": (Role.STATE, Role.PROPRIO),
    "action": (Role.ACTION,),
    "null": (Role.NULL,),
    "padding": (Role.PADDING,),
    "masked": (Role.MASKED_IMAGE,),
}


def rows_of(case: dict[str, Any], replan: int, of: dict[str, int], weights: list[float]) -> list[list[float]]:
    """Every query's attention in a selection: in proportion to the weights of the keys that it sees."""
    axes = ("layer", "denoise", "head", "query")
    chosen = [[of[axis]] if axis in of else range(length) for axis, length in zip(axes, LENGTHS, strict=True)]
    rows = []
    for cell in product([replan], *chosen):
        seen = case["seen"]
        for place in cell:
            seen = seen[place] if len(seen) > 1 else seen[0]
        parts = [weight * int(mark) for weight, mark in zip(weights, seen, strict=True)]
        rows.append([part / sum(parts) for part in parts])
    return rows


@STORED
def test_what_is_stored_gives_the_means_and_lifts_of_the_table(case):
    for expected in case["expected"]:
        for replan, roles in enumerate(case["key_role"]):
            uniform, row = (
                [
                    sum(column) / len(column)
                    for column in zip(*rows_of(case, replan, expected["of"], weights), strict=True)
                ]
                for weights in ([1] * len(roles), case["weights"])
            )
            np.testing.assert_allclose(expected["uniform"][replan], uniform, rtol=CLOSE, err_msg=str(expected["of"]))
            valid = [key for key, role in enumerate(roles) if role not in INVALID_ROLES]
            of_valid = sum(row[key] for key in valid) / sum(uniform[key] for key in valid)
            for group, lift in expected["lifts"][replan].items():
                keys = [key for key, role in enumerate(roles) if role in GROUPS[group]]
                given = sum(uniform[key] for key in keys)
                if given:
                    assert lift == pytest.approx(sum(row[key] for key in keys) / given / of_valid, rel=CLOSE), group
                else:
                    assert lift is None, group


@STORED
def test_rows_of_uniform_attention_are_those_of_the_masks(case):
    seen = attention(case | {"queries": "all"}, [1.0] * 8) > 0
    whole = case["expected"][0]
    assert whole["of"] == {}
    np.testing.assert_allclose(uniform_rows(seen).mean(axis=(1, 2, 3, 4)), whole["uniform"], rtol=CLOSE)


def test_a_query_that_sees_no_key_gives_nothing():
    assert uniform_rows(np.array([[True, False, True], [False, False, False]])).tolist() == [[0.5, 0, 0.5], [0, 0, 0]]


def test_roles_say_what_a_policy_sees_in_which_all_queries_see_the_same():
    (case,) = [case for case in TABLE["stored"] if case["name"] == "every query sees the same keys"]
    roles = tokens_of_case(case).key_role
    np.testing.assert_allclose(uniform_of_roles(roles), case["expected"][0]["uniform"], rtol=CLOSE)
    roles = np.array([Role.IMAGE, Role.MASKED_IMAGE, Role.NULL, Role.TEXT, Role.ABSENT, Role.ACTION], dtype=np.uint8)
    assert uniform_of_roles(roles).tolist() == [0.25, 0, 0.25, 0.25, 0, 0.25]
