"""The page in a real headless Chromium: a walk with Python's numbers, hostile texts, damage, a site."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import polars as pl
import pytest

import vla_attention as va
from tests.kit.browser import Watched, needs_chromium, watched_page
from tests.kit.http_ranges import serve
from tests.kit.stores import StoreSpec, rerun_source, write_store
from tests.kit.viewer import served
from vla_attention.analyze.__main__ import main
from vla_attention.analyze.view.server import ViewerServer
from vla_attention.schemas.interventions import Interventions, PromptChange

pytestmark = needs_chromium

SPEC = StoreSpec(tasks=(0, 1), episodes=2, replans=3, layers=(0, 1, 2, 3, 4, 5), num_layers=6)
MAIN = ".main"
SCRIPT = "<script>alert('bowl')</script>"


@pytest.fixture(scope="module")
def store(tmp_path_factory) -> Path:
    return write_store(tmp_path_factory.mktemp("browsed") / "run.zarr", spec=SPEC)


@pytest.fixture(scope="module")
def rerun(store) -> Path:
    changed = Interventions("no words", prompt=PromptChange("text", text="do nothing"))
    spec = replace(SPEC, seed=7, interventions=changed, rerun_of=rerun_source(store))
    return write_store(store.parent / "no_words.zarr", spec=spec)


@pytest.fixture(scope="module")
def server(store, rerun) -> Iterator[ViewerServer]:
    with served(store, rerun, summaries=True) as running:
        yield running


def wait_for_ratios(view: Watched, episodes: int) -> None:
    """Wait until the list shows a ratio of every episode: it asks for them beside what the page shows."""
    view.page.wait_for_function(
        "all => document.querySelectorAll('.episodes li .ratio:not([data-ratio=\"\"])').length === all", arg=episodes
    )


def masses(store: Path, replan: int, **cell: int) -> dict[str, float]:
    """Python's masses of the groups in the first episode, means over the layers, denoise steps and heads of a cell."""
    steps = va.open(store).analyze(per_head=True, tasks=0)["steps_groups"].filter(episode_index=0, replan=replan)
    names = {"layer": "layer", "denoise": "denoise_step", "head": "head"}
    chosen = steps.filter(*(pl.col(names[axis]) == value for axis, value in cell.items()))
    return dict(chosen.group_by("group").agg(pl.col("mass").mean()).iter_rows())


def test_a_walk_through_a_run_shows_pythons_numbers(view, server, store):
    view.open(f"{server.link}?replan=1&layer=4")
    ratios = va.open(store).analyze(tasks=0)["replans"].filter(episode_index=0, replan=1)
    for layer in ("4", "layers_avg"):
        cell = {} if layer == "layers_avg" else {"layer": 4}
        expected = masses(store, 1, **cell)
        for group in ("visual", "linguistic", "state", "action"):
            assert view.value(f'{MAIN} [data-number="mass-{group}"]') == pytest.approx(expected[group], rel=1e-5)
        (row,) = ratios.filter(layer=layer).iter_rows(named=True)
        assert view.value(f'{MAIN} [data-number="ratio"]') == pytest.approx(row["ratio"], rel=1e-5)
        assert view.value(f'{MAIN} [data-number="ratio-lift"]') == pytest.approx(row["ratio_lift"], rel=1e-5)
        view.open(f"{server.link}?replan=1")
    # One head, by a click, then the next replan, by a key: the link names them and shows the same again.
    view.page.click('[data-cell="3:1"]')
    view.wait_for_link("head=1")
    view.page.locator("h1").click()
    view.page.keyboard.press("ArrowRight")
    view.wait_for_link("replan=2")
    view.settle()
    mass = view.value(f'{MAIN} [data-number="mass-visual"]')
    assert mass == pytest.approx(masses(store, 2, layer=3, head=1)["visual"], rel=1e-5)
    view.open(view.page.url)
    assert view.value(f'{MAIN} [data-number="mass-visual"]') == mass
    # Another episode, by the list.
    assert server.stores[0].summary.wait() is None
    wait_for_ratios(view, 4)
    episodes = va.open(store).analyze()["episodes"].filter(layer="layers_avg").sort("task_id", "episode_index")
    for i, row in enumerate(episodes.iter_rows(named=True)):
        shown = float(view.page.locator(".episodes li .ratio").nth(i).inner_text())
        assert shown == pytest.approx(row["geometric_mean"], rel=2e-3)
    for text, solved in (("failed", False), ("not solved", False), ("solved", True), ("success", True)):
        view.page.fill(".episodes input", text)
        listed = view.page.locator(".episodes li button").evaluate_all("all => all.map((one) => one.dataset.episode)")
        wanted = episodes.filter(success=solved).select("task_id", "episode_index").rows()
        assert listed == [f"task{task:03d}_episode{episode:03d}" for task, episode in wanted], text
    view.page.fill(".episodes input", "task001_episode001")
    view.page.locator(".episodes li").nth(1).wait_for(state="hidden")
    view.page.click(".episodes li button")
    view.wait_for_link("task001_episode001")


@pytest.mark.thorough
def test_a_run_and_its_rerun_stand_side_by_side(view, server, store, rerun):
    view.open(f"{server.link}?replan=1&layer=2")
    pair = '[data-panel="compare"]'
    view.page.select_option(f'{pair} select[name="other-store"]', "1")  # takes the same episode there
    for replan in (1, 2):
        view.page.wait_for_selector(f'{pair}[data-shown="no_words.zarr:task000_episode000:{replan}"]')
        for side, place in (("left", store), ("right", rerun)):
            expected = masses(place, replan, layer=2)
            for group in ("visual", "linguistic"):
                found = view.value(f'{pair} [data-compare="{side}-mass-{group}"]')
                assert found == pytest.approx(expected[group], rel=1e-5), (replan, side, group)
        tops = view.page.locator(f"{pair} canvas[data-top]").evaluate_all("all => all.map((one) => one.dataset.top)")
        assert len(set(tops)) == 1
        view.page.click(f'{pair} [aria-label="Next replan"]')
    assert "with the intervention no words" in view.page.inner_text(f'{pair} [aria-label="The other episode"]')
    assert "other=1%3Atask000_episode000" in view.page.url
    view.page.select_option(f'{pair} select[name="other-episode"]', "")
    view.page.wait_for_url(lambda link: "other=" not in link, wait_until="commit")
    view.page.locator(f"{pair} canvas").first.wait_for(state="hidden")


@pytest.mark.thorough
def test_texts_of_a_store_are_text(browser, tmp_path):
    from tests.analyze.test_hostile_stores import INSTRUCTION, hostile_texts

    store = write_store(tmp_path / "a.zarr", spec=replace(SPEC, tasks=(0,), episodes=1))
    hostile_texts(store)
    with served(store, summaries=True) as running, watched_page(browser) as watched:
        running.stores[0].summary.wait()
        watched.open(running.link)
        wait_for_ratios(watched, 1)
        assert watched.complaints == []
        assert watched.requests_beside(running.link) == []
        assert watched.page.locator("img, iframe, object, embed, script:not([src])").count() == 0
        assert SCRIPT in INSTRUCTION
        assert SCRIPT in watched.page.inner_text("h1")
        for shown in ("h1", ".episodes li"):
            assert "\\u{202e}" in watched.page.inner_text(shown)
            assert "\u202e" not in watched.page.inner_text(shown)
        assert watched.page.locator("body script").count() == 0


@pytest.mark.thorough
def test_a_damaged_chunk_is_a_sentence_and_no_number(browser, store, tmp_path):
    damaged = tmp_path / "a.zarr"
    shutil.copytree(store, damaged)
    (file,) = (damaged / "episodes/task000_episode000/joint/rows").glob("c*")
    content = bytearray(file.read_bytes())
    content[100] ^= 1  # in the first chunk: layer 0, denoise step 0
    file.write_bytes(content)
    with served(damaged) as running, watched_page(browser) as watched:
        watched.page.goto(f"{running.link}?layer=0&denoise=0")
        watched.page.wait_for_selector('#page[data-failed="1"]')
        assert "checksum" in watched.page.inner_text('[role="alert"]:visible')
        watched.open(f"{running.link}?layer=5&denoise=0")
        assert watched.value(f'{MAIN} [data-number="mass-visual"]') > 0


@pytest.mark.thorough
def test_a_static_site_shows_the_same(browser, server, store, tmp_path, capsys):
    assert main(["view", str(store), "--output", str(tmp_path / "site")]) == 0
    found = []
    with serve(tmp_path / "site") as site, watched_page(browser) as watched:
        for link in (server.link, f"{site.url}/index.html"):
            watched.open(f"{link}{'&' if '?' in link else '?'}replan=1&layer=2")
            found.append(watched.value(f'{MAIN} [data-number="mass-visual"]'))
        assert watched.complaints == []
    assert len(set(found)) == 1
