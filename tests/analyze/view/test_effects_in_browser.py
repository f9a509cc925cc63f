"""Effects on the page in a real headless Chromium: shading, sentence, table, and units that come later."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest

import vla_attention as va
from tests.analyze.view.test_page_effects import WAYS, planted
from tests.kit.browser import Watched, needs_chromium, watched_page
from tests.kit.http_ranges import serve
from tests.kit.viewer import served
from vla_attention.analyze.__main__ import main
from vla_attention.analyze.view.server import ViewerServer
from vla_attention.testing.stores import StoreSpec, write_store

pytestmark = [pytest.mark.thorough, needs_chromium]
SIZES = WAYS["through the pictures"] | {"the": (0.01, 0.01, 0, 0)}
SPEC = StoreSpec(tasks=(0,), episodes=1, plant_effects=partial(planted, SIZES))
SHADED = '.main .words[data-shade="effect"]'


@pytest.fixture(scope="module")
def store(tmp_path_factory) -> Path:
    return write_store(tmp_path_factory.mktemp("effects") / "run.zarr", spec=SPEC)


@pytest.fixture(scope="module")
def server(store) -> Iterator[ViewerServer]:
    with served(store, summaries=True) as running:
        running.stores[0].summary.wait()
        yield running


def word(view: Watched, text: str) -> Any:
    return view.page.locator(".main .word").filter(has_text=re.compile(rf"^{text}\b")).first


def opacity(view: Watched, text: str) -> int:
    """The shade of a word in per cent."""
    return int(word(view, text).evaluate("one => one.style.getPropertyValue('--part')").rstrip("%"))


def effects_of(store: Path) -> dict[str, float]:
    """Python's means of the episode by condition."""
    table = va.open(store).effects(table="episodes").filter(phase="all")
    return dict(table.select("condition", "effect").iter_rows())


def test_the_deciding_word_stands_above_the_words_and_is_shaded_most(view, server, store):
    view.open(server.link)
    view.page.wait_for_selector(SHADED)
    effect = effects_of(store)
    sentence = view.page.inner_text(".main .decides")
    assert sentence.startswith("'bowl' has the largest effect of 4 words: without it the action changes by ")
    assert "'bowl', 'plate' reach the action through the pictures, which have read them" in sentence
    assert opacity(view, "bowl") > opacity(view, "plate") > opacity(view, "put") > opacity(view, "the") == 0
    assert float(word(view, "bowl").get_attribute("data-effect")) == pytest.approx(
        effect["without_word_bowl_queries_all"], rel=1e-9
    )
    title = word(view, "bowl").get_attribute("title")
    assert "above the noise floor" in title
    assert re.search(r"hidden from the action queries alone by [0-9.]+, from the pictures alone by [0-9.]+", title)
    assert "times uniform attention" in title
    assert "below the noise floor" in word(view, "the").inner_text()  # as a screen reader says it
    assert "both" not in title
    assert "all its places together" in word(view, "the").get_attribute("title")


def test_the_shading_is_chosen_and_the_link_names_it(view, server):
    view.open(server.link)
    view.page.wait_for_selector(SHADED)
    sentence, colour = view.page.inner_text(".main .decides"), "one => getComputedStyle(one).backgroundColor"
    of_effect = word(view, "bowl").evaluate(colour)
    view.page.select_option('select[name="words"]', "attention")
    view.wait_for_link("words=attention")
    assert word(view, "bowl").locator("small").inner_text().startswith("\N{MULTIPLICATION SIGN}")
    assert word(view, "bowl").evaluate(colour) != of_effect
    assert view.page.inner_text(".main .decides") == sentence  # what decides does not change with what is shaded
    view.page.keyboard.press("Escape")
    view.page.locator("h1").click()
    view.page.keyboard.press("w")
    view.page.wait_for_url(lambda link: "words=" not in link)
    view.settle()
    view.page.keyboard.press("w")
    view.wait_for_link("words=replan")
    assert "at this replan" in view.page.inner_text(".main .decides")
    first = word(view, "bowl").get_attribute("data-effect")
    view.page.keyboard.press("ArrowRight")
    view.wait_for_link("replan=1")
    assert word(view, "bowl").get_attribute("data-effect") != first


def test_the_table_has_pythons_numbers_by_reader(view, server, store):
    view.open(server.link)
    view.page.wait_for_selector(SHADED)
    view.page.click(".main .effects summary")
    effect = effects_of(store)
    for reader, condition in (
        ("total", "without_word_plate_queries_all"),
        ("direct", "without_word_plate"),
        ("pictures", "without_word_plate_queries_prefix_of_role:image"),
    ):
        shown = view.value(f"""[data-effect="{reader}-'plate'"]""")
        assert shown == pytest.approx(effect[condition], rel=1e-9), reader
    assert view.value('[data-effect="total-another noise seed"]') == pytest.approx(effect["noise"], rel=1e-9)
    assert view.page.locator(".main .effects tbody tr").first.inner_text().startswith("'bowl'")


def test_units_that_come_later_are_waited_for(browser, store):
    with served(store) as running, watched_page(browser) as watched:
        watched.open(running.link)
        assert "as soon as their unit is known" in watched.page.inner_text(".main .decides")
        assert watched.page.get_attribute(".main .words", "data-shade") == "attention"
        assert not watched.page.locator('select[name="words"]').is_visible()
        running.stores[0].summary.begin(running.stores[0].store)
        watched.page.wait_for_selector(SHADED)
        assert watched.page.locator('select[name="words"]').is_visible()
        assert watched.complaints == []


def test_a_static_site_and_a_phone_show_the_same(browser, store, server, tmp_path):
    assert main(["view", str(store), "--site", str(tmp_path / "site")]) == 0
    assert json.loads((tmp_path / "site/stores/0.summary.json").read_text())["effect_units"]["spread"]
    found = []
    with serve(tmp_path / "site") as site:
        for link, width in ((server.link, 1280), (f"{site.url}/index.html", 390)):
            with watched_page(browser, width, 844, has_touch=width < 500) as watched:
                watched.open(f"{link}?other=0:task000_episode000")
                watched.page.wait_for_selector(SHADED)
                watched.page.wait_for_selector('[data-panel="compare"] .words[data-shade="effect"] >> nth=1')
                watched.page.click(".main .effects summary")
                found.append(watched.page.inner_text(".main .decides"))
                assert watched.page.evaluate("document.documentElement.scrollWidth") <= width
                assert watched.complaints == []
    assert found[0] == found[1] != ""


def test_a_store_without_effects_has_no_sentence_no_table_and_no_choice(browser, store, tmp_path):
    plain = write_store(tmp_path / "plain.zarr", spec=StoreSpec(tasks=(0,), episodes=1))
    with served(plain, store, summaries=True) as running, watched_page(browser) as watched:
        watched.open(f"{running.link}?other=1:task000_episode000")
        # Beside it the effects of a store that has some appear, when their unit is known.
        watched.page.wait_for_selector('[data-panel="compare"] .words[data-shade="effect"]')
        assert watched.page.locator(".words[data-shade='attention']").count() == 2
        for part in (".main .decides", ".main .effects", 'select[name="words"]'):
            assert not watched.page.locator(part).is_visible(), part
        assert watched.page.locator(".main .word small").first.inner_text().startswith("\N{MULTIPLICATION SIGN}")
        watched.page.keyboard.press("w")
        assert "words=" not in watched.page.url
        assert watched.complaints == []
