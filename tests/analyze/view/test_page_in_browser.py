"""The page in a real headless Chromium: Python's numbers in clicks, pictures as they were, hostile texts, copies."""

from __future__ import annotations

import io
import json
import re
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import vla_attention as va
from tests.kit.browser import Watched, needs_chromium, watched_page
from tests.kit.golden_stores import golden_store
from tests.kit.http_ranges import serve
from tests.kit.planted_effects import planted_effects
from tests.kit.stores import StoreSpec, rerun_source, write_store
from tests.kit.viewer import ask, served
from vla_attention.analyze.__main__ import main
from vla_attention.analyze.view.server import ViewerServer
from vla_attention.schemas.interventions import Interventions, PromptChange

pytestmark = needs_chromium

SPEC = StoreSpec(tasks=(0, 1), episodes=2, replans=3, layers=(0, 1, 2, 3, 4, 5), num_layers=6)
FIRST = "#episode=task000_episode000"


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
        running.stores[0].summary.wait()
        yield running


def mass(store: Path, group: str, replan: int, **cell: int) -> float:
    """Python's mass of a group in the first episode, the mean over the layers, denoise steps and heads of a cell."""
    steps = va.open(store).analyze(per_head=True, tasks=0)["steps_groups"].filter(episode_index=0, replan=replan)
    return float(steps.filter(group=group, **cell)["mass"].mean())


def test_numbers_are_pythons_for_the_mean_a_layer_and_a_head(view, server, store):
    ratios = va.open(store).analyze(tasks=0)["replans"].filter(episode_index=0, replan=1)
    for link, layer, cell in (("", "layers_avg", {}), ("&layer=4", "4", {"layer": 4})):
        view.open(f"{server.link}{FIRST}&replan=1{link}")
        for group in ("visual", "linguistic", "state", "action"):
            shown = view.value(f'[data-number="mass-{group}"]')
            assert shown == pytest.approx(mass(store, group, 1, **cell), rel=1e-6)
        (row,) = ratios.filter(layer=layer).iter_rows(named=True)
        assert view.value('[data-number="ratio"]') == pytest.approx(row["ratio"], rel=1e-9)
        assert view.value('[data-number="lift"]') == pytest.approx(row["ratio_lift"], rel=1e-9)
    # One head by a click, the next replan by a key: the link names them and shows the same again.
    view.page.locator(".heads td button").nth(3 * 2 + 1).click()
    view.wait_for_link("head=1")
    view.page.keyboard.press("ArrowRight")
    view.wait_for_link("replan=2")
    shown = view.value('[data-number="mass-visual"]')
    assert shown == pytest.approx(mass(store, "visual", 2, layer=3, head=1), rel=1e-6)
    view.open(view.page.url)
    assert view.value('[data-number="mass-visual"]') == shown


def test_clicked_patches_and_words_are_a_group_and_its_ratio(view, server, store):
    view.open(f"{server.link}{FIRST}")
    view.page.locator(".word").nth(1).click()
    stack = view.page.locator(".stack svg").first
    stack.click(position={"x": 1, "y": 1})
    view.wait_for_link("group=")
    camera = view.page.locator(".stack").first.get_attribute("data-camera")
    about = view.page.evaluate("fetch('runs/0/task000_episode000/about.json').then((reply) => reply.json())")
    how, word = about["sites"]["joint"]["cameras"][camera], about["sites"]["joint"]["prompts"][0]["words"][1]
    key = how["keys"][how["cells"].index(0)]
    selectors = {"patch": f"keys:{key}-{key}", "word": f"keys:{word['keys'][0]}-{word['keys'][-1]}"}
    result = va.open(store).analyze(groups=selectors, ratio=("patch", "word"), tasks=0)["replans_groups"]
    cells = result.filter(episode_index=0, replan=0, layer="layers_avg")
    expected = dict(cells.select("group", "mass").iter_rows())
    assert view.value('[data-number="own-patches"]') == pytest.approx(expected["patch"], rel=2**-10)
    assert view.value('[data-number="own-words"]') == pytest.approx(expected["word"], rel=2**-10)
    # A typed selector is resolved by the server, and so is what is wrong with it.
    view.page.fill('[aria-label="Selector"]', "word:nothing")
    view.page.locator(".own form button").first.click()
    view.page.wait_for_selector('[role="alert"]')
    assert "'nothing'" in view.page.inner_text('[role="alert"]')


def test_back_undoes_what_a_person_takes_for_a_step(view, server):
    view.open(server.link)
    view.page.locator(".card").first.click()
    view.wait_for_link("episode=task000_episode000")
    view.page.keyboard.press("ArrowRight")
    view.wait_for_link("replan=1")
    view.page.locator(".word").nth(1).click()
    view.wait_for_link("group=words")
    view.page.keyboard.press("ArrowRight")
    view.wait_for_link("replan=2")
    view.page.select_option(".controls label:has-text('compare') select", "0:task000_episode001")
    view.wait_for_link("beside=0")
    for there, gone in (("replan=2", "beside"), ("replan=1", "group"), (server.token, "episode")):
        view.page.go_back()
        view.wait_for_link(there)
        assert gone not in view.page.url
    view.page.go_forward()
    view.wait_for_link("replan=1")


def test_an_item_of_the_effects_is_taken_away_by_a_click_or_a_key(browser):
    with served(golden_store("effects")) as running, watched_page(browser) as watched:
        watched.open(f"{running.link}{FIRST}")
        items = json.loads(ask(running, "runs/0/task000_episode000/effects.json").body)["items"]
        watched.page.locator(".effects > button").click()
        rows = watched.page.locator(".effects tbody tr")
        for words, column in (("whole episode", 3), ("now", 2)):  # ranked as the words are shaded
            watched.page.locator(".shades").get_by_text(words).click()
            texts = watched.page.locator(f".effects td:nth-child({column})").all_inner_texts()
            assert [float(text) for text in texts] == sorted(map(float, texts), reverse=True)
        tried = {one["label"] for one in items if one["kind"] in ("without", "noise")}
        assert rows.count() == len(tried)
        assert watched.page.locator(".actions .chunk.without").count() == 0
        for item in tried - {"another noise seed"}:
            (button,) = rows.locator("button").filter(has_text=re.compile(f"^{re.escape(item)}$")).all()
            button.focus()
            watched.page.keyboard.press("Enter")
            watched.page.wait_for_selector(".actions .chunk.without")
            assert f"without {item}" in watched.page.inner_text(".actions")
        word = watched.page.locator(".word").first
        word.click()
        watched.wait_for_link("group=words")
        assert f"without '{word.inner_text()}'" in watched.page.inner_text(".actions")


def shading(watched: Watched) -> dict[str, tuple[float, float]]:
    """By word the strength of its colour, and of the line below."""
    style = "(words, name) => words.map((one) => [one.innerText, Number(one.style.getPropertyValue(name))])"
    colours, lines = (
        dict(watched.page.locator(".word").evaluate_all(style, name)) for name in ("--strength", "--line")
    )
    return {text: (colours[text], lines[text]) for text in colours}


def test_words_are_coloured_by_what_an_exchange_does(browser, tmp_path):
    silent, spoken = "put", "the"

    def scale(name: str, *_: int) -> float:
        return {f"exchange_word_{silent}": 0.0, f"without_word_{spoken}_queries_all": 0.0}.get(name, 1.0)

    plant = planted_effects(scale, exchanged=True)
    planted = write_store(tmp_path / "exchanged.zarr", spec=StoreSpec(tasks=(0,), replans=2, plant_effects=plant))
    with served(planted) as running, watched_page(browser) as watched:
        watched.open(f"{running.link}{FIRST}&group=words:0")
        found = shading(watched)
        assert found[silent][0] == 0 < found[silent][1]  # left out it does something, exchanged it does not
        assert found[spoken][0] > 0 == found[spoken][1]
        said = watched.page.inner_text(".about-words")
        assert f"'{silent}' as" in said
        assert f"'{silent}' left out" in said
        parts = json.loads(ask(running, "runs/0/task000_episode000/effects.json").body)["parts"]
        assert all(part["title"] in said for part in parts)


def test_both_episodes_have_heads_and_the_own_group(view, server, store):
    view.open(f"{server.link}{FIRST}&beside=0:task000_episode001&replan=1&group=words:0")
    view.page.wait_for_function("document.querySelectorAll('.grids table').length === 2")
    shown = view.page.locator('[data-number="own-words"]').evaluate_all("all => all.map((one) => +one.dataset.value)")
    about = json.loads(ask(server, "runs/0/task000_episode000/about.json").body)
    word = about["sites"]["joint"]["prompts"][0]["words"][0]["text"]
    result = va.open(store).analyze(groups={"word": f"word:{word}"}, tasks=0)["replans_groups"]
    cells = result.filter(group="word", replan=1, layer="layers_avg").sort("episode_index")
    assert shown == pytest.approx(cells["mass"].to_list(), rel=2**-10)


def test_from_the_grid_to_a_head_over_all_episodes_and_back_to_a_call(view, server):
    view.open(f"{server.link}{FIRST}&layer=2&head=1&target=role:instruction")
    assert view.page.locator(".heads select").input_value() == "role:instruction"
    view.page.get_by_text("layer 2, head 1 in all episodes").click()
    view.wait_for_link("of=head")
    assert "target=role%3Ainstruction" in view.page.url
    view.page.wait_for_selector(".of-calls .card:nth-child(12) .stack img")
    query = "site=joint&layer=2&selector=role:instruction&first=0"
    answer = json.loads(ask(server, f"runs/0/heads.json?{query}").body)
    lifts = {one["name"]: [line[1] for line in one["lift"]] for one in answer["episodes"]}
    expected = np.mean([np.mean(of) for of in lifts.values()])
    assert view.value("[data-number=head-lift]") == pytest.approx(expected, rel=1e-9)
    shown = [float(text.split()[0]) for text in view.page.locator(".of-calls b").all_inner_texts()]
    assert len(shown) == 12
    assert shown == sorted(shown, reverse=True)
    view.page.get_by_text("least first").click()
    view.page.locator(".of-calls .card").first.click()
    view.wait_for_link("episode=")
    name, replan = min(((name, at) for name in lifts for at in range(3)), key=lambda one: lifts[one[0]][one[1]])
    link = view.page.url
    assert f"episode={name}" in link
    assert ("replan" in link) == (replan > 0)
    assert {"layer=2", "head=1", "target=role%3Ainstruction"} <= set(link.split("#")[1].split("&"))
    view.page.get_by_text("all heads of layer 2").click()
    view.page.wait_for_selector(".layer-maps .stack img")
    assert view.page.locator(".layer-maps > button[aria-pressed=true]").inner_text().strip() == "head 1"
    for gone in ("episode=", "of=head"):  # back to the head, then to the list
        view.page.locator("body").press("Escape")
        view.page.wait_for_url(lambda link, gone=gone: gone not in link, wait_until="commit")


def test_the_overview_finds_episodes(view, server, store):
    view.open(server.link)
    episodes = va.open(store).episodes
    for text, solved in (("failed", False), ("not solved", False), ("solved", True)):
        view.page.fill('input[type="search"]', text)
        assert view.page.locator(".card").count() == episodes.filter(success=solved).height
        assert (
            view.page.locator(f".card.{'solved' if solved else 'failed'}").count() == view.page.locator(".card").count()
        )
    view.page.fill('input[type="search"]', "nothing like it")
    assert view.page.locator(".card").count() == 0
    view.page.get_by_text("Show all").click()
    view.page.locator(".card").first.click()
    view.wait_for_link("episode=task000_episode000")
    ratios = va.open(store).analyze()["episodes"].filter(layer="layers_avg").sort("task_id", "episode_index")
    view.page.go_back()
    view.page.wait_for_selector(".card .soft")
    shown = [float(text.split(" ")[0]) for text in view.page.locator(".card .soft").all_inner_texts()]
    assert shown == [float(f"{ratio:.3g}") for ratio in ratios["geometric_mean"]]


def test_the_overview_is_sorted(view, server, store):
    """By what every card says; unknown orders of a link are none."""
    view.open(server.link)
    view.page.wait_for_selector(".card .soft")
    names = va.open(store).episodes.sort("task_id", "episode_index")
    ratios = va.open(store).analyze()["episodes"].filter(layer="layers_avg").sort("task_id", "episode_index")
    known = {"outcome": names["success"], "shortest": names["num_steps"], "longest": -names["num_steps"]}
    known |= {"lowest": ratios["geometric_mean"], "highest": -ratios["geometric_mean"]}
    places = names.select("task_id", "episode_index").rows()
    for order, values in known.items():
        view.page.select_option('select[aria-label="Order"]', order)
        view.wait_for_link(f"sort={order}")
        shown = view.page.locator(".card").evaluate_all("all => all.map((one) => one.dataset.episode)")
        wanted = sorted(range(len(places)), key=lambda place, values=values: float(values[place]))
        assert shown == [f"task{places[place][0]:03}_episode{places[place][1]:03}" for place in wanted]
    view.open(f"{server.link}#sort=constructor&show=constructor")
    assert view.page.locator(".card").count() == len(places)


def test_outside_of_the_lines_no_pixel_of_a_picture_changes(view, server):
    """The picture is laid out in its own size; where no line is drawn, the screen shows its pixels."""
    view.open(f"{server.link}{FIRST}")
    stack = view.page.locator(".stack").first
    camera = stack.get_attribute("data-camera")
    lines = np.array(Image.open(io.BytesIO(stack.screenshot())).convert("RGB")).astype(int)
    view.page.evaluate("document.querySelectorAll('.stack svg').forEach((one) => one.remove())")
    plain = np.array(Image.open(io.BytesIO(stack.screenshot())).convert("RGB")).astype(int)
    reply = ask(server, f"runs/0/task000_episode000/pictures/{camera}/0.png")
    assert reply.status == 200
    changed = (lines != plain).any(axis=-1)
    assert 0 < changed.mean() < 0.35
    # What changed is lines: no changed area holds a square as wide as two lines.
    width = 12
    counts = np.lib.stride_tricks.sliding_window_view(changed, (width, width)).mean(axis=(2, 3))
    assert counts.max() < 1


def test_a_run_and_its_rerun_stand_side_by_side(view, server, rerun):
    view.open(f"{server.link}{FIRST}&replan=1")
    view.page.select_option(".controls select >> nth=-1", "1:task000_episode000")
    view.wait_for_link("beside=1")
    verdicts = view.page.locator(".beside .verdict").all_inner_texts()
    assert len(verdicts) == 2
    ratio = va.open(rerun).analyze(tasks=0)["replans"].filter(episode_index=0, replan=1, layer="layers_avg")["ratio"][0]
    assert f"ratio {float(f'{ratio:.3g}'):g}," in view.page.locator(".beside > div").nth(1).inner_text()


def test_another_prompt_is_a_banner(browser, server):
    with watched_page(browser) as watched:
        watched.open(f"{server.link}#run=1&episode=task000_episode000")
        assert "do nothing" in watched.page.locator(".banner").first.inner_text()


def texts_are_text(watched: Watched, link: str) -> None:
    from tests.analyze.test_hostile_stores import MARKUP

    watched.open(f"{link}{FIRST}")
    assert watched.complaints == []
    assert watched.page.locator("iframe, object, embed, body script").count() == 0
    assert MARKUP in watched.page.inner_text(".heads")
    assert watched.page.locator("img[src=x]").count() == 0
    assert "\u202e" not in watched.page.inner_text("body")
    assert watched.requests_beside(link) == []


def test_texts_of_a_store_are_text(browser, tmp_path):
    from tests.analyze.test_hostile_stores import hostile_texts

    store = write_store(tmp_path / "a.zarr", spec=replace(SPEC, tasks=(0,), episodes=1))
    hostile_texts(store)
    with served(store, summaries=True) as running, watched_page(browser) as watched:
        running.stores[0].summary.wait()
        texts_are_text(watched, running.link)


def test_a_damaged_chunk_is_a_sentence_and_no_number(browser, store, tmp_path):
    damaged = shutil.copytree(store, tmp_path / "a.zarr")
    (file,) = (damaged / "episodes/task000_episode000/joint/rows").glob("c*")
    content = bytearray(file.read_bytes())
    content[100] ^= 1  # in the first chunk: layer 0, denoise step 0
    file.write_bytes(content)
    with served(damaged) as running, watched_page(browser) as watched:
        watched.page.goto(f"{running.link}{FIRST}&layer=0")
        watched.page.wait_for_selector('[role="alert"]')
        assert "task000_episode000" in watched.page.locator('[role="alert"]').first.inner_text()
        watched.open(f"{running.link}{FIRST}&layer=5")
        assert watched.value('[data-number="mass-visual"]') > 0


def shown_of(watched: Watched, link: str) -> list[Any]:
    watched.open(link)
    values = [watched.value(f'[data-number="{name}"]') for name in ("ratio", "mass-visual", "mass-linguistic")]
    paths = watched.page.locator(".stack path").evaluate_all("all => all.map((one) => one.getAttribute('d'))")
    widths = watched.page.locator(".stack img").evaluate_all("all => all.map((one) => one.naturalWidth)")
    return [*values, *paths, *widths, *watched.page.locator(".heads p").all_inner_texts()[:1]]


def test_copies_show_the_same_from_a_folder_below_a_path_and_from_disk(browser, server, store, tmp_path):
    assert main(["view", str(store), "--site", str(tmp_path / "www/deep/site")]) == 0
    assert main(["view", str(store), "--file", str(tmp_path / "one.html"), "--task", "0", "--episode", "0"]) == 0
    state = f"{FIRST}&replan=1&layer=2&denoise=9"
    with serve(tmp_path / "www") as site, watched_page(browser) as watched:
        expected = shown_of(watched, f"{server.link}{state}")
        assert len(expected) > 6
        assert shown_of(watched, f"{site.url}/deep/site/index.html{state}") == expected
        assert shown_of(watched, f"{(tmp_path / 'one.html').as_uri()}{state}") == expected
        assert watched.complaints == []
        selector = watched.page.locator('[aria-label="Selector"]')
        assert selector.is_disabled()
        assert "vla-attention view" in selector.get_attribute("placeholder")


def test_a_walk_by_keyboard_comes_back_to_its_card(view, server):
    page = view.page
    view.open(server.link)
    assert page.title() == "run.zarr · Attention"
    page.locator("button.card").nth(1).focus()
    page.keyboard.press("Enter")
    view.wait_for_link("episode=task000_episode001")
    assert page.title() == "task 0, episode 1 · run.zarr · Attention"
    seen = set()
    for _ in range(60):
        page.keyboard.press("Tab")
        seen.add(page.evaluate("document.activeElement.tagName"))
    assert {"BUTTON", "svg", "SELECT"} <= seen
    page.locator(".stack svg").first.focus()
    page.keyboard.press("Escape")
    view.settle()
    page.wait_for_selector("[data-episode=task000_episode001]:focus")


@pytest.mark.parametrize(
    "part", ["curve=constructor", "site=nowhere", "layer=constructor&head=-3&denoise=x", "replan=1e9"]
)
def test_links_that_name_what_is_not_there_show_what_is(view, server, part):
    view.open(f"{server.link}{FIRST}&{part}")
    assert view.page.locator(".timeline .plot").count() == 1
    said = view.page.locator(".banner").all_inner_texts()
    assert said == (["The run has no site 'nowhere': 'joint' is shown."] if "site" in part else [])


def test_a_server_that_ended_is_a_banner(browser, server):
    with watched_page(browser) as view:
        view.open(f"{server.link}{FIRST}")
        view.page.context.set_offline(True)
        view.page.keyboard.press("]")
        view.page.wait_for_selector('.banner[role="alert"]')
        assert "Start it again" in view.page.inner_text('.banner[role="alert"]')
        view.page.context.set_offline(False)
        view.page.keyboard.press("]")
        view.page.wait_for_selector('.banner[role="alert"]', state="detached")


def test_two_episodes_are_one_time_line_over_the_longer_one(browser, store, tmp_path):
    longer = write_store(tmp_path / "longer.zarr", spec=replace(SPEC, replans=5, seed=3))
    ends = [va.open(path).episodes["num_steps"][0] for path in (store, longer)]
    starts = [[5 * replan for replan in range(count)] for count in (3, 5)]
    with served(store, longer) as running, watched_page(browser) as view:
        view.open(f"{running.link}{FIRST}&beside=1:task000_episode000")
        for step in starts[1]:
            said = view.page.inner_text(".scrub output")
            calls = [sum(start <= step for start in of) - 1 for of in starts]
            assert said.startswith(f"step {step} of {max(ends)}, run.zarr, task 0, episode 0: call {calls[0]} (0 to 2)")
            assert f"longer.zarr, task 0, episode 0: call {calls[1]} (0 to 4)" in said
            assert (", ended" in said) is (step >= ends[0])
            view.page.keyboard.press("ArrowRight")
            view.settle()
        curves = view.page.locator(".u-legend .u-series").all_inner_texts()
        assert sum("longer.zarr" in one for one in curves) == sum("run.zarr" in one for one in curves) > 0
        view.page.click("text=swap")
        view.wait_for_link("run=1")
        assert view.page.inner_text(".scrub output").startswith(f"step {starts[1][-1]} of {max(ends)}, longer.zarr")
        assert view.complaints == []


def saved(view: Watched, kind: str) -> bytes:
    """What the page's button saves."""
    if not view.page.locator(".drawer").count():
        view.page.click("text=share")
    with view.page.expect_download() as download:
        view.page.click(f"text=Save {kind}")
    return Path(download.value.path()).read_bytes()


def test_a_saved_figure_is_drawn_by_a_program_that_is_no_browser(browser):
    """The pictures as they were stored, thin lines on them, and what both sides are."""
    import resvg_py

    path = va.example("cubes")
    names = [
        f"task{task:03}_episode{number:03}"
        for task, number in va.open(path).episodes.select("task_id", "episode_index").rows()
    ]
    with served(path) as running, watched_page(browser) as view:
        view.open(f"{running.link}#episode={names[0]}&beside=0:{names[1]}&replan=1&group=words:0")
        text = saved(view, "SVG").decode()
        assert view.complaints == []
        abouts = [json.loads(ask(running, f"runs/0/{name}/about.json").body) for name in names[:2]]
        (camera, _), *_ = abouts[0]["sites"]["joint"]["cameras"].items()
        stored = Image.open(io.BytesIO(ask(running, f"runs/0/{names[0]}/pictures/{camera}/1.png").body))
        png = Image.open(io.BytesIO(saved(view, "PNG")))
    written = re.findall(r"<text[^>]*>([^<]*)</text>", text)
    for about in abouts:
        assert f"step {about['starts'][1]} of {about['end']}, call 1 (0 to {len(about['starts']) - 1})" in written
        assert about["verdict"] in written
    place = re.search(r'<g transform="translate\((\d+) (\d+)\)"><image width="(\d+)" height="(\d+)"', text)
    assert place is not None
    x, y, width, height = map(int, place.groups())
    drawn = Image.open(io.BytesIO(bytes(resvg_py.svg_to_bytes(svg_string=text)))).convert("RGB")
    assert (2 * drawn.width, 2 * drawn.height) == pytest.approx(png.size, abs=2)
    shown = np.asarray(drawn.crop((12 + x, 12 + y, 12 + x + width, 12 + y + height)), dtype=int)
    plain = np.asarray(stored.convert("RGB").resize((width, height), Image.Resampling.BICUBIC), dtype=int)
    changed = (np.abs(shown - plain) > 60).any(axis=-1).mean()
    assert 0.001 < changed < 0.2


def test_the_film_is_of_what_is_shown(server):
    films = {
        asked: ask(server, f"runs/0/task000_episode000/film.gif?{asked}").body
        for asked in ("", "layer=mean&head=mean&denoise=mean&site=joint", "layer=2", "head=1", "denoise=0")
    }
    plain = films.pop("")
    assert films.pop("layer=mean&head=mean&denoise=mean&site=joint") == plain
    assert len({*films.values(), plain}) == 4
    assert "no layer 99" in json.loads(ask(server, "runs/0/task000_episode000/film.gif?layer=99").body)["error"]
    assert ask(server, "runs/0/task000_episode000/film.gif?layer=x").status == 404


@pytest.mark.parametrize("chosen", [{}, {"layers": 2}, {"layers": 3, "heads": 1}])
def test_lines_stand_where_overlay_has_them(browser, chosen):
    path = va.example("cubes")
    (task, number), *_ = va.open(path).episodes.select("task_id", "episode_index").rows()
    figure = va.open(path).overlay(tasks=task, episode=number, replans=[0], **chosen).figures[0]
    asked = "".join(f"&{name.removesuffix('s')}={value}" for name, value in chosen.items())
    with served(path) as running, watched_page(browser) as view:
        view.open(f"{running.link}#episode=task{task:03}_episode{number:03}{asked}")
        said = " ".join(view.page.locator(".legend span").all_inner_texts())
    assert [float(one) for one in re.findall(r"(\d+) times", said)] == list(figure.options["levels"])
