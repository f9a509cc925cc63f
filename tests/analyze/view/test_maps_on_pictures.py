"""What moves the action on the page and in Rerun's recordings: the values that `overlay` draws, and a switch."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest

import vla_attention as va
from tests.analyze.commands.test_overlay_maps import SPEC, WITHOUT
from tests.analyze.view.test_rrd_file import as_logged
from tests.kit.browser import needs_chromium, watched_page
from tests.kit.planted_effects import planted_effects
from tests.kit.stores import StoreSpec, write_store
from tests.kit.viewer import ask, served
from vla_attention.analyze.__main__ import main
from vla_attention.analyze.core.action_changes import units_of
from vla_attention.analyze.view.server import ViewerServer
from vla_attention.schemas.stores.reader import open_store

EPISODE = "task000_episode000"


@pytest.fixture(scope="module")
def store(tmp_path_factory) -> Path:
    return write_store(tmp_path_factory.mktemp("mapped") / "a.zarr", spec=SPEC)


@pytest.fixture(scope="module")
def server(store) -> Iterator[ViewerServer]:
    with served(store) as running:
        yield running


@pytest.fixture(scope="module")
def drawn(store) -> Any:
    return va.open(store).overlay().figures[0]


def test_the_page_is_told_what_overlay_draws(server, drawn, store):
    answer = json.loads(ask(server, f"runs/0/{EPISODE}/joint/moves.json").body)
    assert answer["replans"] == [0, 2, 3]
    assert answer["levels"] == drawn.options["second"]["levels"]
    units, said = units_of([open_store(store)]), []
    for row in drawn.frame.filter(pl.col("second").is_not_null(), pl.col("replan") != WITHOUT).iter_rows(named=True):
        own, at = answer["cameras"][row["camera"]], answer["replans"].index(row["replan"])
        grid = np.array(row["second"])
        np.testing.assert_allclose(own["lift"][at], grid.ravel(), rtol=1e-4)
        assert [[mark["x"], mark["y"]] for mark in own["exact"][at]] == row["marks"]
        for mark in own["exact"][at]:
            assert mark["cell"] == int(mark["y"] * len(grid)) * len(grid[0]) + int(mark["x"] * len(grid[0]))
            said.append(mark["said"])
    exact = {table.name: table.shown for table in va.open(store).effects().tables}["maps"]["exact"].drop_nulls()
    assert sorted(said) == sorted(units.size(size) for size in exact)


def edges_of(grid: np.ndarray, level: float) -> int:
    """Sides of patches that part one with at least the level from one below it."""
    inside = np.pad(grid >= level, 1).astype(int)
    return int(sum(np.abs(np.diff(inside, axis=axis)).sum() for axis in (0, 1)))


@needs_chromium
def test_a_switch_shows_what_is_read_or_what_moves_the_action(browser, server, drawn, store, tmp_path):
    assert main(["view", str(store), "--file", str(tmp_path / "one.html")]) == 0
    chips, (first, *_) = 'fieldset[aria-label="Lines"] button', drawn.options["second"]["levels"]
    rows = drawn.frame.filter(pl.col("second").is_not_null(), replan=2).sort("camera")
    for link in (server.link, (tmp_path / "one.html").as_uri()):
        with watched_page(browser) as view:
            view.open(f"{link}#episode={EPISODE}&replan=2&lines=read")
            assert view.page.locator(".stack .first").count() == rows.height
            assert view.page.locator(".stack .moves, .stack .exact").count() == 0
            view.page.locator(chips).nth(1).focus()
            view.page.keyboard.press("Enter")
            view.wait_for_link("lines=moves")
            view.page.wait_for_selector(".stack .moves", state="attached")
            assert view.page.locator(".stack .first").count() == 0
            for row in rows.iter_rows(named=True):
                stack = view.page.locator(f'.stack[data-camera="{row["camera"]}"]')
                path = stack.locator(".moves path").first.get_attribute("d")
                assert path.count("M") == edges_of(np.array(row["second"]), first)
                marks = stack.locator(".exact path").first.get_attribute("d") if row["marks"] else ""
                assert marks.count("M") == len(row["marks"])
            (x, y), *_ = rows["marks"][0]
            svg = view.page.locator(f'.stack[data-camera="{rows["camera"][0]}"] svg')
            box = svg.bounding_box()
            svg.hover(position={"x": x * box["width"], "y": y * box["height"]})
            view.page.wait_for_selector("figcaption:has-text('exact: without it')")
            view.page.keyboard.press("ArrowLeft")
            view.wait_for_link(f"replan={WITHOUT}")
            assert view.page.locator(".stack .moves, .stack .exact").count() == 0
            view.page.locator(chips).nth(2).click()
            view.page.wait_for_selector(".stack .first", state="attached")
            assert view.complaints == []


@needs_chromium
def test_an_episode_without_a_map_has_no_switch(browser, tmp_path):
    plain = write_store(tmp_path / "a.zarr", spec=StoreSpec(tasks=(0,), episodes=1, plant_effects=planted_effects()))
    with served(plain) as running, watched_page(browser) as view:
        view.open(f"{running.link}#episode={EPISODE}&lines=moves")
        assert view.page.locator('fieldset[aria-label="Lines"]').count() == 0
        assert view.page.locator(".stack .first").count() > 0


def test_a_recording_has_the_lines_and_the_exact_patches(store, drawn):
    recording, episode = as_logged(store, EPISODE), open_store(store).episodes[0]
    starts = (episode.read("env_step") - episode.read("env_step")[0]).tolist()
    for row in drawn.frame.filter(pl.col("second").is_not_null()).iter_rows(named=True):
        place, step, grid = (
            f"/pictures/{row['camera']}/moves the action",
            starts[row["replan"]],
            np.array(row["second"]),
        )
        for level in drawn.options["second"]["levels"]:
            strips = recording[f"{place}/{level:g} times the mean"]["LineStrips2D:strips"][step]
            assert len(strips) == edges_of(grid, level)
        ((marks,), labels) = (recording[f"{place}/exact"][f"Points2D:{name}"][step] for name in ("positions", "labels"))
        sides = episode.read(f"frames/{row['camera']}", 0).shape[1::-1]
        assert len(labels) == len(marks)
        np.testing.assert_allclose(np.reshape(marks, (-1, 2)) / sides, np.reshape(row["marks"] or [], (-1, 2)))
