"""The viewer in a real headless Chromium: numbers are Python's, controls and links work, nothing else is asked for."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import polars as pl
import pytest

import vla_attention as va
from tests.kit.browser import Watched, needs_chromium, watched_page
from tests.kit.golden_stores import FOLDER
from tests.kit.http_ranges import serve
from tests.kit.viewer import served
from vla_attention.analyze.__main__ import main
from vla_attention.analyze.measures.baselines import baseline_notes
from vla_attention.analyze.view.server import ViewerServer
from vla_attention.schemas.interventions import Interventions, PromptChange
from vla_attention.schemas.stores.reader import open_store
from vla_attention.testing.stores import StoreSpec, rerun_source, write_store

pytestmark = [pytest.mark.thorough, needs_chromium]

SPEC = StoreSpec(tasks=(0, 1), episodes=2, replans=3, layers=(0, 1, 2, 3, 4, 5), num_layers=6)
MAIN = ".main"
#: Visible controls that a screen reader has no name for.
NAMELESS = """() => {
  const named = (one) => (one.innerText || "").trim() || one.getAttribute("aria-label") || one.labels?.length
    || one.title || one.placeholder;
  const controls = document.querySelectorAll("button, select, input, textarea, canvas[tabindex]");
  return Array.from(controls).filter((one) => one.checkVisibility() && !named(one)).map((one) => one.outerHTML);
}"""
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
    steps = va.open(store).masses("steps", per_head=True, tasks=0).filter(episode_index=0, replan=replan)
    names = {"layer": "layer", "denoise": "denoise_step", "head": "head"}
    chosen = steps.filter(*(pl.col(names[axis]) == value for axis, value in cell.items()))
    return dict(chosen.group_by("group").agg(pl.col("mass").mean()).iter_rows())


@pytest.mark.parametrize("cell", [{}, {"layer": 3}, {"head": 1}, {"layer": 5, "head": 0, "denoise": 9}], ids=str)
def test_masses_on_the_page_are_pythons(view, server, store, cell):
    view.open(f"{server.link}?replan=2&{'&'.join(f'{axis}={value}' for axis, value in cell.items())}")
    expected = masses(store, 2, **cell)
    for group in ("visual", "linguistic", "state", "action"):
        assert view.value(f'{MAIN} [data-number="mass-{group}"]') == pytest.approx(expected[group], rel=1e-5), group


def test_ratio_and_lift_are_pythons_in_one_layer_and_over_all(view, server, store):
    ratios = va.open(store).ratios("replans", tasks=0).filter(episode_index=0, replan=1)
    for link, layer in (("replan=1", "layers_avg"), ("replan=1&layer=4", "4")):
        view.open(f"{server.link}?{link}")
        (row,) = ratios.filter(layer=layer).iter_rows(named=True)
        assert view.value(f'{MAIN} [data-number="ratio"]') == pytest.approx(row["ratio"], rel=1e-5)
        assert view.value(f'{MAIN} [data-number="ratio-lift"]') == pytest.approx(row["ratio_lift"], rel=1e-5)
        assert view.value(f'{MAIN} [data-number="uniform-ratio"]') == pytest.approx(row["uniform_ratio"], rel=1e-6)


def test_the_grid_has_pythons_lift_of_every_head_and_chooses_one(view, server, store):
    view.open(f"{server.link}?denoise=0")
    table = va.open(store).masses("steps", per_head=True, tasks=0, denoise=0)
    table = table.filter(episode_index=0, replan=0, group="visual")
    for row in table.iter_rows(named=True):
        assert view.value(f'[data-cell="{row["layer"]}:{row["head"]}"]') == pytest.approx(row["lift"], rel=1e-5)
    assert table.height == 12
    view.page.click('[data-cell="3:1"]')
    view.wait_for_link("head=1")
    assert view.page.get_attribute('[data-cell="3:1"]', "aria-pressed") == "true"
    assert view.value(f'{MAIN} [data-number="mass-visual"]') == pytest.approx(
        masses(store, 0, layer=3, head=1, denoise=0)["visual"], rel=1e-5
    )


def test_a_patch_and_a_word_have_the_attention_of_their_keys(view, server, store):
    view.open(f"{server.link}?layer=2&head=1&denoise=9")
    episode = va.open(store).stores[0].episodes[0]
    rows = episode.read("joint/rows")[0, 2, 1, 1, 0]
    spans = {span.camera: span for span in SPEC.layout.spans if span.camera}
    camera = view.page.locator(f"{MAIN} canvas[data-camera]").first
    camera.focus()
    view.page.keyboard.press("Enter")  # the cursor, on the first patch
    first = spans[camera.get_attribute("data-camera")].start
    assert view.value(f'{MAIN} [data-number="patch-mass"]') == pytest.approx(float(rows[first]), rel=1e-6)
    found = []
    for replan in range(3):
        view.wait_for_link(f"replan={replan}" if replan else "layer=2")
        shown = view.page.locator(f"{MAIN} [data-word]")
        found.append([float(shown.nth(i).get_attribute("data-mass")) for i in range(shown.count())])
        view.page.keyboard.press("Escape")
        view.page.click('.player [aria-label="next replan"]')
    words = va.open(store).words("episodes", tasks=0, layers=2, heads=1, denoise=9)
    words = words.filter(episode_index=0, kind="word").sort("place")
    assert [sum(masses) / 3 for masses in zip(*found, strict=True)] == pytest.approx(words["mass"].to_list(), rel=1e-5)


def test_a_baseline_of_version_1_that_may_be_of_too_many_keys_is_noted(browser):
    for name, count in (("library", 1), ("joint", 0)):
        store = FOLDER / f"{name}.zarr"
        with served(store) as running, watched_page(browser) as watched:
            watched.open(running.link)
            notes = watched.page.locator(f'{MAIN} [role="note"]:visible')
            assert notes.count() == count
            if count:
                assert (notes.inner_text(),) == baseline_notes([open_store(store)])
            assert watched.complaints == []


def test_controls_change_the_link_and_the_link_shows_the_same(view, server):
    view.open(server.link)
    for name, value in (("layer", "2"), ("head", "1"), ("denoise", "9"), ("measure", "rank"), ("colours", "viridis")):
        view.page.select_option(f'select[name="{name}"]', value)
        view.wait_for_link(f"{name}={value}")
    view.settle()
    link, mass = view.page.url, view.value(f'{MAIN} [data-number="mass-visual"]')
    view.open(link)
    assert view.value(f'{MAIN} [data-number="mass-visual"]') == mass
    assert view.page.input_value('select[name="colours"]') == "viridis"
    view.page.select_option('select[name="layer"]', "4")
    view.wait_for_link("layer=4")
    view.page.go_back()
    view.wait_for_link("layer=2")
    view.settle()
    assert view.value(f'{MAIN} [data-number="mass-visual"]') == mass


def test_a_link_to_what_does_not_exist_says_so(view, server):
    view.open(f"{server.link}?layer=77&replan=99&episode=task000_episode001")
    said = view.page.inner_text(f"{MAIN} .warning")
    assert "layer 77 was not recorded" in said
    assert "no replan 99" in said


def test_keys_go_through_replans_layers_and_episodes(view, server):
    view.open(server.link)
    for key, expected in (
        ("ArrowRight", "replan=1"),
        ("End", "replan=2"),
        ("]", "layer=0"),
        ("n", "task000_episode001"),
    ):
        view.page.keyboard.press(key)
        view.wait_for_link(f"{expected}")
    view.page.keyboard.press("?")
    assert view.page.locator("dialog[open]").count() == 1
    view.page.keyboard.press("Escape")
    assert view.page.locator("dialog[open]").count() == 0


def test_it_plays_to_the_end(view, server):
    view.open(server.link)
    view.page.keyboard.press(" ")
    view.wait_for_link("replan=2")
    view.page.wait_for_selector('.player [aria-label="Play"]')


def test_the_list_has_pythons_ratios_and_is_searched(view, server, store):
    assert server.stores[0].summary.wait() is None
    view.open(server.link)
    wait_for_ratios(view, 4)
    assert view.page.locator(".episodes li").count() == 4
    expected = va.open(store).ratios("episodes").filter(layer="layers_avg").sort("task_id", "episode_index")
    for i, row in enumerate(expected.iter_rows(named=True)):
        shown = float(view.page.locator(".episodes li .ratio").nth(i).inner_text())
        assert shown == pytest.approx(row["geometric_mean"], rel=2e-3)
    view.page.fill(".episodes input", "task001_episode001")
    view.page.locator(".episodes li").nth(1).wait_for(state="hidden")
    view.page.click(".episodes li button")
    view.wait_for_link("task001_episode001")


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


@pytest.fixture(scope="module")
def light(store) -> Path:
    """The first episodes again with less recorded, as light reruns are."""
    changed = Interventions("noise", prompt=PromptChange("text", text="do nothing"))
    less = replace(SPEC, seed=8, layers=(1, 4), denoise_steps=(9,), heads=(1,), rerun_of=rerun_source(store))
    return write_store(store.parent / "light.zarr", spec=replace(less, interventions=changed))


def test_side_by_side_are_means_over_what_both_recorded(browser, store, light):
    pair = '[data-panel="compare"]'
    sides = (("left", store), ("right", light))
    common = {"layers": [1, 4], "denoise": 9, "heads": 1}
    with served(store, light) as running, watched_page(browser) as watched:
        # The lighter store is shown first, or stands beside.
        for link, places in (
            ("?other=1:task000_episode000", sides),
            ("?store=1&other=0:task000_episode000", sides[::-1]),
        ):
            watched.open(f"{running.link}{link}&replan=1")
            watched.page.wait_for_selector(f'{pair}[data-ready="1"]')
            said = watched.page.locator(pair).inner_text()
            assert "Means are over what both recorded: layers 1, 4; denoise step 9; head 1." in said
            for side, (_, place) in zip(("left", "right"), places, strict=True):
                steps = {"tasks": 0, **common}
                row = va.open(place).ratios("replans", **steps).filter(episode_index=0, replan=1, layer="layers_avg")
                assert watched.value(f'{pair} [data-compare="{side}-ratio"]') == pytest.approx(
                    row["ratio"][0], rel=1e-5
                )
                assert watched.value(f'{pair} [data-compare="{side}-ratio-lift"]') == pytest.approx(
                    row["ratio_lift"][0], rel=1e-5
                )
                columns = watched.page.locator(f"{pair} section .about").all_inner_texts()
                assert all("mean of 2 layers, head 1, denoise step 9" in column for column in columns)
        # Only where the timeline is of the same cells is the other's ratio a line of it.
        assert watched.page.locator(".timeline").inner_text().count("ratio of") == 1
        watched.open(f"{running.link}?other=1:task000_episode000")
        watched.page.wait_for_selector(f'{pair}[data-ready="1"]')
        assert "ratio of" not in watched.page.locator(".timeline").inner_text()
        assert watched.complaints == []


@pytest.mark.parametrize(
    ("query", "sentence"),
    [
        ("layer=3", "light.zarr has no layer 3. Choose one that both recorded (1, 4), or the mean over layers."),
        (
            "layer=4&denoise=0",
            "light.zarr has no denoise step 0. Choose one that both recorded (9), or the mean over denoise steps.",
        ),
        ("head=0", "light.zarr has no head 0. Choose one that both recorded (1), or the mean over heads."),
    ],
)
def test_side_by_side_refuses_what_one_did_not_record(browser, store, light, query, sentence):
    pair = '[data-panel="compare"]'
    with served(store, light) as running, watched_page(browser) as watched:
        watched.open(f"{running.link}?other=1:task000_episode000&{query}")
        watched.page.wait_for_selector(f'{pair}[data-ready="1"]')
        assert watched.page.inner_text(f'{pair} [role="alert"]') == sentence
        assert not watched.page.locator(f"{pair} .compare-table").is_visible()
        assert not watched.page.locator(f"{pair} canvas").first.is_visible()


def test_side_by_side_of_nothing_in_common_is_a_sentence(browser, store, tmp_path):
    other = write_store(tmp_path / "b.zarr", spec=replace(SPEC, layers=(0, 1)))
    third = write_store(tmp_path / "c.zarr", spec=replace(SPEC, layers=(4, 5)))
    with served(other, third) as running, watched_page(browser) as watched:
        watched.open(f"{running.link}?other=1:task000_episode000")
        watched.page.wait_for_selector('[data-panel="compare"][data-ready="1"]')
        said = watched.page.inner_text('[data-panel="compare"] [role="alert"]')
    assert said == "There is no layer that both recorded: b.zarr has 0, 1, c.zarr 4, 5."


def test_only_the_chunks_that_are_shown_are_read(browser, store):
    with served(store) as running, watched_page(browser) as watched:
        watched.open(f"{running.link}?layer=0&denoise=0")
        (file,) = (store / "episodes/task000_episode000/joint/rows").glob("c*")
        rows = f"0/{file.relative_to(store).as_posix()}"
        whole = file.stat().st_size
        # One of twelve chunks, that of the layer beside it, which is read ahead, and the index.
        assert 0 < running.sent[rows] < whole / 3
        assert not [name for name in running.sent if "task001" in name or "task000_episode001" in name]
        assert not [name for name in running.sent if name.endswith("contribution/c")]


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


def test_a_static_site_shows_the_same_and_a_packed_store_too(browser, server, store, tmp_path, capsys):
    packed = tmp_path / "packed.zarr"
    assert main(["copy", str(store), str(packed), "--packed"]) == 0
    assert main(["view", str(store), str(packed), "--site", str(tmp_path / "site")]) == 0
    found = []
    with serve(tmp_path / "site") as site, watched_page(browser) as watched:
        for link in (server.link, f"{site.url}/index.html", f"{site.url}/index.html?store=1"):
            watched.open(f"{link}{'&' if '?' in link else '?'}replan=1&layer=2")
            found.append(watched.value(f'{MAIN} [data-number="mass-visual"]'))
        assert watched.complaints == []
    assert len(set(found)) == 1


@pytest.mark.parametrize("width", [390, 800])
def test_narrow_pages_do_not_scroll_sideways(browser, server, width):
    with watched_page(browser, width, 844, has_touch=True) as watched:
        watched.open(f"{server.link}?replan=1&other=1:task000_episode000")
        watched.page.wait_for_selector('[data-panel="compare"][data-ready="1"]')
        assert watched.page.evaluate("document.documentElement.scrollWidth") <= width
        assert watched.complaints == []


def test_it_is_dark_where_people_want_it_dark(browser, server):
    found = []
    for scheme in ("light", "dark"):
        with watched_page(browser, color_scheme=scheme) as watched:
            watched.open(server.link)
            ground = watched.page.evaluate("getComputedStyle(document.body).backgroundColor")
            found.append(sum(map(int, re.findall(r"\d+", ground)[:3])))
    assert found[0] > 700
    assert found[1] < 120


def test_everything_that_acts_has_a_name(view, server):
    view.open(f"{server.link}?other=1:task000_episode000")
    view.page.wait_for_selector('[data-panel="compare"][data-ready="1"]')
    nameless = view.page.evaluate(NAMELESS)
    assert nameless == []
    assert view.page.locator("h1").count() == 1
    assert view.page.locator('[aria-live="polite"]').count() == 1
