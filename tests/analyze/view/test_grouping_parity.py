"""The page's grouping language and measures are Python's: the same cases in both, the shipped script run by node.

Cases are made when the test runs, from a seed (`grouping_cases.py`). Weights, masses and what follows from
them are within 1e-12 of each other; what is an error is the same sentence in both.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.analyze.view.grouping_cases import grouping_cases
from tests.analyze.view.viewer_in_node import needs_node, run_in_node
from tests.end_to_end.test_cameras_of_several_spans import KINDS, spans_of
from tests.kit.tokens import small_prompt, tokens_of
from vla_attention.analyze.core.camera_maps import PictureMap
from vla_attention.schemas.groupings.grouping import Grouping
from vla_attention.schemas.groupings.resolve import resolve
from vla_attention.schemas.jsonable import to_json

NUM_CASES = 300
#: The measures of a group that the page computes; those of the tables may be more.
PAGE_MEASURES = {"mass", "fraction", "density", "lift"}


@pytest.fixture(scope="module")
def cases() -> dict[str, Any]:
    return grouping_cases(NUM_CASES)


def differences(expected: Any, found: Any, where: str = "") -> list[str]:
    """Where two answers differ: numbers by more than 1e-12 of their size, anything else at all."""
    if isinstance(expected, dict):
        shared = [name for name in expected if name in found] if isinstance(found, dict) else []
        return [text for name in shared for text in differences(expected[name], found[name], f"{where}.{name}")]
    if isinstance(expected, list) and isinstance(found, list) and len(expected) == len(found) and expected:
        if all(isinstance(value, (int, float)) for value in (*expected, *found)):
            one, other = np.array(expected, np.float64), np.array(found, np.float64)
            wrong = ~np.isclose(other, one, rtol=1e-12, atol=0, equal_nan=True)
            return [f"{where}[{i}]: {one[i]!r}, not {other[i]!r}" for i in np.flatnonzero(wrong)[:3]]
        pairs = zip(expected, found, strict=True)
        return [text for i, (a, b) in enumerate(pairs) for text in differences(a, b, f"{where}[{i}]")]
    if isinstance(expected, float) and isinstance(found, (int, float)):
        return differences([expected], [found], where)
    return [] if expected == found else [f"{where}: {expected!r}, not {found!r}"]


def of_case(case: dict[str, Any], answer: dict[str, Any]) -> list[str]:
    expected = case["expected"]
    if "error" in expected or "error" in answer:
        same = expected.get("error") == answer.get("error")
        return [] if same else [f"error {expected.get('error')!r}, not {answer.get('error')!r}"]
    assert set(answer) == set(expected) - {"segments"}
    assert set(answer["groups"]) == PAGE_MEASURES
    assert set(answer["cells"]) == set(expected["cells"]) - {"row_sum", "nonfinite_layers"}
    return differences(expected, answer)


@needs_node
def test_300_groupings_have_the_same_weights_masses_and_errors(tmp_path, cases):
    answers = run_in_node(tmp_path, cases)["cases"]
    pairs = zip(cases["cases"], answers, strict=True)
    wrong = {i: found for i, (case, answer) in enumerate(pairs) if (found := of_case(case, answer))}
    assert not wrong, "\n".join(f"case {i}: {found[:3]}" for i, found in list(wrong.items())[:10])


@needs_node
@pytest.mark.parametrize("kind", KINDS)
def test_painted_cells_take_the_patches_whose_centre_is_there(tmp_path, kind):
    layout = spans_of(KINDS[kind])
    tokens = tokens_of(layout, [small_prompt(layout, "put the bowl on the plate", "1 2")])
    picture = PictureMap.of(layout, "front")
    cells = [0, 1, picture.columns, picture.rows * picture.columns - 1]
    given = {"layout": to_json(layout), "camera": "front", "cells": cells}
    (selectors,) = run_in_node(tmp_path, {"episodes": [], "painted": [given]})["painted"]
    for selector, there in zip(selectors, (cells, cells[:2]), strict=True):
        centres = [np.meshgrid(*grid.centres(), indexing="ij") for grid in picture.grids]
        down, across = (np.concatenate([of[axis].ravel() for of in centres]) for axis in (0, 1))
        cell = np.floor(down * picture.rows) * picture.columns + np.floor(across * picture.columns)
        taken = resolve(Grouping("one", {"one": (selector,)}), tokens).weights[0, picture.keys, 0]
        np.testing.assert_array_equal(taken > 0, np.isin(cell, there))
