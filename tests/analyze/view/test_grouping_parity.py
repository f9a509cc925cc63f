"""The page's grouping language and measures are Python's: the same cases in both, the shipped script run by node.

Cases are made when the test runs, from a seed (`tests/kit/grouping_cases.py`). Weights, masses and what follows from
them are within 1e-12 of each other; what is an error is the same sentence in both.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.kit.grouping_cases import grouping_cases
from tests.kit.grouping_files import FILES, file_answer, made_up_texts
from tests.kit.viewer_in_node import needs_node, run_in_node
from vla_attention.schemas.errors import did_you_mean, shortened, visible
from vla_attention.schemas.groupings.words import split_words

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
def test_names_texts_and_words_are_treated_alike(tmp_path):
    near, texts = made_up_texts(600)
    found = run_in_node(tmp_path, {"episodes": [], "near": near, "shown": texts, "words": texts})
    assert found["near"] == [did_you_mean(word, names) for word, names in near]
    assert sum(bool(text) for text in found["near"]) > 200
    assert found["shown"] == [[visible(text), repr(text), shortened(text, 20), text.casefold()] for text in texts]
    assert found["words"] == [[list(place) for place in split_words(text)] for text in texts]


@needs_node
def test_lifts_and_ranks_of_single_keys(tmp_path):
    generator = np.random.default_rng(7)
    rows = np.round(generator.dirichlet(np.ones(12), 40), 2)  # with equal values
    valid = generator.random((40, 12)) < 0.8
    uniform = generator.choice([0.0, 0.05, 0.1], (40, 12), p=[0.1, 0.3, 0.6])
    given = [
        {"row": row.tolist(), "valid": known.astype(int).tolist(), "uniform": one.tolist()}
        for row, known, one in zip(rows, valid, uniform, strict=True)
    ]
    found = run_in_node(tmp_path, {"ranks": given, "lifts": given})
    for i, (row, known, one) in enumerate(zip(rows, valid, uniform, strict=True)):
        own = row[known]
        below, same = (own[:, None] > own).sum(axis=1), (own[:, None] == own).sum(axis=1)
        ranks = (below + (same - 1) / 2) / (len(own) - 1)
        assert np.array(found["ranks"][i], dtype=float)[known] == pytest.approx(ranks)
        assert np.isnan(np.array(found["ranks"][i], dtype=float)).tolist() == (~known).tolist()
        seen = known & (one > 0)
        lifts = row[seen] / one[seen] / (own.sum() / one[known].sum())
        assert np.array(found["lifts"][i], dtype=float)[seen] == pytest.approx(lifts)
        assert np.isnan(np.array(found["lifts"][i], dtype=float)).tolist() == (~seen).tolist()


@needs_node
def test_grouping_files_are_read_and_refused_alike(tmp_path):
    """What is no TOML is refused by both, in each reader's own words; all else is the same sentence."""
    found = run_in_node(tmp_path, {"episodes": [], "files": [{"text": text, "path": "a b/x.toml"} for text in FILES]})
    for text, answer in zip(FILES, found["files"], strict=True):
        expected = file_answer(tmp_path, text)
        if "is not valid TOML" in str(expected.get("error")):
            assert answer["error"].startswith("Grouping file a b/x.toml is not valid TOML: "), text
        else:
            written = answer.pop("written", None)
            assert answer == expected, text
            # What the page saves is the same grouping for vla-analyze.
            assert written is None or file_answer(tmp_path, written) == {**expected, "name": answer["name"]}, written


def test_the_cases_are_of_all_kinds(cases):
    given, expected = cases["cases"], [case["expected"] for case in cases["cases"]]
    sentences = [answer["error"] for answer in expected if "error" in answer]
    assert len(given) == NUM_CASES
    assert 90 <= len(sentences) <= 200
    beginnings = {" ".join(sentence.split("'")[0].split()[:3]) for sentence in sentences}
    assert len(beginnings) >= 8
    for words in (
        "Did you mean",
        "share",
        "has no key in any",
        "expected ')'",
        "parentheses in one another",
        "Nearest",
    ):
        assert any(words in sentence for sentence in sentences), words
    measured = [answer for answer in expected if "error" not in answer]
    assert any(0.0 < weight < 1.0 for answer in measured for weight in answer["weights"])
    assert any(answer["on_segments"] is None for answer in measured)
    assert any(answer["on_segments"] is not None for answer in measured)
    ratios = [value for answer in measured for value in answer["cells"].get("ratio", [])]
    assert {"inf", "nan"} <= {value for value in ratios if isinstance(value, str)}
    shapes = [case["uniform"]["shape"] for case in given if case["uniform"]]
    assert len(shapes) == NUM_CASES - NUM_CASES // 4
    assert all({1} < {shape[axis] for shape in shapes} for axis in range(5))
    lifts = [value for answer in measured for value in answer["groups"]["lift"]]
    assert lifts.count("nan") > 100
    assert sum(isinstance(value, float) and value > 0 for value in lifts) > 1000
