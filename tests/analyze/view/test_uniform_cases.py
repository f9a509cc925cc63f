"""The page's baselines are those of the table that Python is tested with."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from urllib.parse import urlencode

import numpy as np
import pytest

from tests.analyze.view.page_answers import PageQuestion, page_answers
from tests.analyze.view.viewer_in_node import needs_node
from tests.kit.http_ranges import serve
from tests.kit.uniform_cases import TABLE, write_case
from vla_attention.schemas.layout import INVALID_ROLES

pytestmark = needs_node
#: Stored in float32.
CLOSE = 2e-6
STORED = TABLE["stored"]


@pytest.fixture(scope="module")
def answers(tmp_path_factory: pytest.TempPathFactory) -> dict[tuple[int, bool, int], dict[str, Any]]:
    """What the page shows of a case's last replan, with its own rows and uniform ones, by the selection's number."""
    folder: Path = tmp_path_factory.mktemp("uniform")
    asked, questions = [], []
    with serve(folder) as served:
        for number, case in enumerate(STORED):
            for uniform in (True, False):
                name = f"{number}_{uniform}.zarr"
                write_case(folder / name, case, [1.0] * 8 if uniform else case["weights"])
                for i, expected in enumerate(case["expected"]):
                    asked.append((number, uniform, i))
                    query = urlencode(expected["of"] | {"replan": len(case["key_role"]) - 1})
                    questions.append(PageQuestion(f"{served.url}/", f"{name}/", query=f"?{query}"))
        found = page_answers(folder, questions)
    assert [answer.get("failure") for answer in found] == [None] * len(asked)
    return dict(zip(asked, found, strict=True))


@pytest.mark.parametrize("uniform", [True, False], ids=["uniform rows", "other rows"])
@pytest.mark.parametrize("number", range(len(STORED)), ids=[case["name"] for case in STORED])
def test_means_and_lifts_over_every_selection(answers, number, uniform):
    for i, expected in enumerate(STORED[number]["expected"]):
        answer, wanted = answers[number, uniform, i], np.array(expected["uniform"])
        found = np.array(answer["uniform"], dtype=float)
        np.testing.assert_allclose(np.broadcast_to(found, wanted.shape), wanted, rtol=CLOSE, atol=1e-9)
        for replan, lifts in zip(answer["replans"], expected["lifts"], strict=True):
            for group, lift in lifts.items():
                shown = float(replan["groups"][group][3])
                if lift is None:
                    assert np.isnan(shown), group
                else:
                    assert shown == pytest.approx(1.0 if uniform else lift, rel=CLOSE), group
            if uniform and 0 < float(replan["ratio"][1]) < np.inf:
                assert float(replan["ratio"][2]) == pytest.approx(1.0, rel=CLOSE)


@pytest.mark.parametrize("number", range(len(STORED)), ids=[case["name"] for case in STORED])
def test_patches_have_the_lift_of_their_keys(answers, number):
    valid = ~np.isin(STORED[number]["key_role"][-1], INVALID_ROLES)
    for i, expected in enumerate(STORED[number]["expected"]):
        answer = answers[number, False, i]
        row, uniform = np.array(answer["row"], dtype=float), np.array(expected["uniform"][-1])
        of_valid = row[valid].sum() / uniform[valid].sum()
        (camera,) = answer["cameras"]
        for value, mass, share in zip(camera["values"], row[:2], uniform[:2], strict=True):
            lift = mass / share / of_valid if share else np.nan
            assert float(value) == pytest.approx(lift, rel=CLOSE, nan_ok=True)
