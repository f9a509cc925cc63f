"""Pure parts of the page, run by node: where patches are shown, links, events, strokes of a brush, the search."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs

import numpy as np
import pytest

from tests.analyze.view.page_answers import needs_node, run_in_node
from vla_attention.analyze.measures.alignment import closing_replan
from vla_attention.analyze.show.patch_pictures import upright
from vla_attention.schemas.stores.store_format import PolicyCameraView

pytestmark = needs_node
GRIDS = [
    {"rows": rows, "columns": columns, "upright": is_upright, "mirrored": mirrored}
    for rows, columns in ((1, 1), (2, 3), (16, 16))
    for is_upright in (True, False)
    for mirrored in (True, False)
]
LINKS = {
    "": "",
    "?layer=3&head=0&replan=12": "?replan=12&layer=3&head=0",
    "?measure=rank&colours=cividis&opacity=0.5&smooth=1": "?measure=rank&colours=cividis&opacity=0.5&smooth=1",
    "?store=1&episode=task000_episode001&site=self&query=2": "?store=1&episode=task000_episode001&site=self&query=2",
    "?words=attention": "?words=attention",
    "?other=1%3Atask000_episode001&grouping=a+%3D+b": "?grouping=a+%3D+b&other=1%3Atask000_episode001",
    # What a link names wrongly is as at first.
    "?layer=-3&head=x&replan=1e9&measure=none&words=all&colours=red&opacity=7&smooth=2&other=task&store=9999999999": "",
}
ROWS = [
    {"name": "task000_episode000", "task": "bowl", "instruction": "pick the bowl", "success": True, "ratio": 3.0},
    {"name": "task000_episode001", "task": "bowl", "instruction": "pick the bowl", "success": False, "ratio": None},
    {"name": "task001_episode000", "task": "drawer", "instruction": "Open the drawer", "success": None, "ratio": 5.0},
]
#: First and last patch of a stroke, and the columns of the grid.
STROKES = [[0, 0, 4], [0, 15, 4], [3, 12, 4], [5, 6, 4], [0, 6, 4], [255, 3, 16]]
SEARCHES = {
    ("", "name"): ["task000_episode000", "task000_episode001", "task001_episode000"],
    ("PICK bowl", "name"): ["task000_episode000", "task000_episode001"],
    ("failure", "name"): ["task000_episode001"],
    ("not known", "name"): ["task001_episode000"],
    ("drawer bowl", "name"): [],
    ("", "ratio"): ["task001_episode000", "task000_episode000", "task000_episode001"],
    ("", "ratio-low"): ["task000_episode000", "task001_episode000", "task000_episode001"],
    ("", "failure"): ["task000_episode001", "task000_episode000", "task001_episode000"],
    ("", "instruction"): ["task001_episode000", "task000_episode000", "task000_episode001"],
}


def some_actions() -> list[dict[str, Any]]:
    """Action chunks (replan, horizon, dimension) whose last number rarely closes the gripper."""
    rng, found = np.random.default_rng(4), []
    for _ in range(30):
        shape = (int(rng.integers(1, 6)), int(rng.integers(1, 8)), 7)
        actions = rng.standard_normal(shape)
        actions[..., -1] -= 1.5
        executed = rng.integers(1, shape[1] + 2, shape[0])
        starts = np.concatenate([[10], 10 + np.cumsum(executed)])
        found.append(
            {"shape": shape, "values": actions.ravel().tolist(), "starts": starts[:-1].tolist(), "end": int(starts[-1])}
        )
    return found


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[Any]]:
    cases = {
        "grids": GRIDS,
        "links": list(LINKS),
        "actions": some_actions(),
        "strokes": STROKES,
        "searches": [{"rows": ROWS, "search": search, "sort": sort} for search, sort in SEARCHES],
    }
    folder: Path = tmp_path_factory.mktemp("pieces")
    return json.loads(run_in_node("page_pieces.mjs", folder, cases))  # type: ignore[no-any-return]


def test_a_patch_is_shown_where_python_turns_it_and_found_there(results):
    for grid, patches in zip(GRIDS, results["grids"], strict=True):
        rows, columns = grid["rows"], grid["columns"]
        numbers = np.arange(rows * columns).reshape(rows, columns)
        turned = upright(numbers, PolicyCameraView("c", "c", grid["upright"], grid["mirrored"]))
        for patch, (x, y, found) in enumerate(patches):
            assert found == patch
            assert turned[int(y * rows), int(x * columns)] == patch


def test_links_name_the_state_and_nothing_else(results):
    assert [parse_qs(link.removeprefix("?")) for link in results["links"]] == [
        parse_qs(link.removeprefix("?")) for link in LINKS.values()
    ]


def test_the_gripper_closes_where_python_says(results):
    expected = []
    for case in some_actions():
        actions = np.array(case["values"]).reshape(case["shape"])
        starts = np.array(case["starts"]) - 10
        expected.append(closing_replan(actions, starts, case["end"] - 10))
    assert results["actions"] == expected
    assert None in expected
    assert len(set(expected)) > 3


def test_a_quick_stroke_has_no_gaps(results):
    for (first, last, columns), stroke in zip(STROKES, results["strokes"], strict=True):
        assert (stroke[0], stroke[-1]) == (first, last)
        for one, other in pairwise(stroke):
            assert max(abs(one // columns - other // columns), abs(one % columns - other % columns)) == 1


def test_the_list_is_searched_and_sorted(results):
    assert dict(zip(SEARCHES, results["searches"], strict=True)) == SEARCHES
