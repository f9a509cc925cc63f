"""The panel "Groups live" in Chromium: its numbers are those of the command that it gives and of the file it saves.

Numbers on the page are compared with the tables `episodes`, `episodes_groups` (that the command writes) and `replans`,
`replans_groups` (of the Python API): within 1e-6, because vla-analyze adds up in float32.
"""

from __future__ import annotations

import math
import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import polars as pl
import pytest

import vla_attention as va
from tests.kit.browser import needs_chromium, shown_page, wait_until_ready
from vla_attention.schemas.groupings.vocabulary import EpisodeTokens
from vla_attention.testing import StoreSpec, write_site_store, write_store

pytestmark = [pytest.mark.thorough, needs_chromium]
CLOSE = 1e-6


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three layers, two denoise steps, two heads, three queries; prompts that change, objects."""
    folder = tmp_path_factory.mktemp("groups panel")  # a space in the path: the command quotes it
    spec = StoreSpec(tasks=(0, 1), replans=4, layers=(0, 1, 3), queries="all", seed=4)
    return write_store(folder / "a store.zarr", spec=spec)


def panel_of(page: Any) -> Any:
    panel = page.locator("[data-panel=groups]")
    if not panel.is_visible():
        page.locator("summary", has_text="Groups live").click()
    return panel


def measured(panel: Any, groups: int | None = None) -> None:
    """Wait until the numbers and the link are those of what is typed."""
    wait_until_ready(panel.page)
    panel.page.wait_for_selector("[data-panel=groups][data-settled='1'] .group-results:not(.old)")
    wait_until_ready(panel.page)
    assert groups is None or panel.locator(".group-results tbody tr").count() == groups


def numbers_of(panel: Any, of: str) -> dict[str, dict[str, float]]:
    """Group -> measure -> value, of this replan or of the episode."""
    found: dict[str, dict[str, float]] = {}
    for cell in panel.locator(f"td[data-of={of}]").all():
        own = found.setdefault(cell.get_attribute("data-group"), {})
        own[cell.get_attribute("data-measure")] = float(cell.get_attribute("data-value"))
    return found


def number(panel: Any, name: str) -> float:
    return float(panel.locator(f"[data-number='group-{name}']").get_attribute("data-value"))


def run_shell(command: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """The command as somebody pastes it into a shell."""
    assert command.startswith("vla-analyze ")
    program = f"{shlex.quote(sys.executable)} -m vla_attention.analyze"
    line = f"{program} {command.removeprefix('vla-analyze ')} --no-plots --no-cache --output out"
    return subprocess.run(["bash", "-c", line], capture_output=True, text=True, cwd=folder, check=False)


def compare_groups(found: dict[str, dict[str, float]], table: pl.DataFrame) -> None:
    """Numbers of the page's table and of one of vla-analyze's; both have a row a group."""
    rows = {row["group"]: row for row in table.iter_rows(named=True)}
    assert set(found) <= set(rows)
    for name, values in found.items():
        for measure, value in values.items():
            expected = rows[name][measure]
            assert value == pytest.approx(math.nan if expected is None else expected, rel=CLOSE, nan_ok=True)


def compare_with_command(page: Any, panel: Any, folder: Path, layer: str, **settings: Any) -> None:
    """The page's numbers of all replans and of the episode, and what its command writes."""
    command = panel.locator("[data-command]").text_content()
    done = run_shell(command, folder)
    assert done.returncode == 0, done.stderr
    this = {"task_id": 1, "episode_index": 0, "layer": layer}
    cells = pl.read_parquet(folder / "out/episodes.parquet").filter(**this)
    of_episode = pl.read_parquet(folder / "out/episodes_groups.parquet").filter(**this)
    compare_groups(numbers_of(panel, "episode"), of_episode)
    assert set(numbers_of(panel, "episode")) == set(of_episode.filter(pl.col("keys") > 0)["group"])
    if panel.locator(".group-ratio").is_visible():
        for name, column in (("ratio-mean", "geometric_mean"), ("ratio-lift-mean", "ratio_lift")):
            assert number(panel, name) == pytest.approx(cells[column][0], rel=CLOSE)
    question = {**settings, "tasks": 1}
    store = page.evaluate("window.viewer.shown().store.entry.path")
    replans = va.open(store).ratios("replans", **question).filter(**this)
    groups = va.open(store).masses("replans", **question).filter(**this)
    for replan in range(4):
        page.evaluate("(replan) => window.viewer.view.update({replan})", replan)
        wait_until_ready(page)
        compare_groups(numbers_of(panel, "replan"), groups.filter(replan=replan))
        if panel.locator(".group-ratio").is_visible():
            row = replans.filter(replan=replan).row(0, named=True)
            for name, column in (("ratio", "ratio"), ("uniform-ratio", "uniform_ratio"), ("ratio-lift", "ratio_lift")):
                assert number(panel, name) == pytest.approx(row[column], rel=CLOSE)


def groups_of(panel: Any) -> dict[str, str]:
    lines = panel.locator(".group-line").all()
    return {line.locator(".name").input_value(): line.locator(".selector").input_value() for line in lines}


def paint(page: Any, camera: str, start: tuple[float, float], stop: tuple[float, float]) -> None:
    """A stroke between two points of a picture, 0 to 1 from its left and top."""
    canvas = page.locator(f"canvas[data-camera='{camera}']")
    canvas.scroll_into_view_if_needed()
    box = canvas.bounding_box()
    (x0, y0), (x1, y1) = ((box["x"] + x * box["width"], box["y"] + y * box["height"]) for x, y in (start, stop))
    page.mouse.move(x0, y0)
    page.mouse.down()
    page.mouse.move(x1, y1, steps=3)
    page.mouse.up()


def test_clicked_groups_have_the_numbers_of_the_command(store, tmp_path):
    with shown_page(store, query="?episode=task001_episode000") as page:
        panel = panel_of(page)
        panel.locator("[data-part='object:plate_1']").click()
        panel.get_by_text("New group").click()
        words = page.locator("[data-word]")
        assert [word.locator("span").first.text_content() for word in words.all()] == ["open", "the", "top", "drawer"]
        for place in (2, 3, 0):
            words.nth(place).click()
        words.nth(0).click()  # taken out again
        panel.get_by_text("New group").click()
        panel.locator("button.brush").click()
        paint(page, "left_wrist_0_rgb", (0.2, 0.2), (0.8, 0.2))
        paint(page, "left_wrist_0_rgb", (0.2, 0.8), (0.2, 0.8))
        panel.locator("button.erase").click()
        paint(page, "left_wrist_0_rgb", (0.2, 0.8), (0.2, 0.8))
        panel.locator("button.brush").click()
        groups = groups_of(panel)
        assert groups["plate_1"] == "object:plate_1"
        assert groups["group"] == "word:top | word:drawer"
        assert groups["group_2"] == "patch:left_wrist_0_rgb[0:1,0:2]"
        panel.locator(".group-line").nth(0).locator(".selector").fill("object:plate_1 & camera:base_0_rgb")
        panel.locator("input.ratio").fill("plate_1,group_2/group")
        measured(panel, 4)
        groups = {**groups_of(panel), "rest": "*"}
        compare_with_command(page, panel, tmp_path, "layers_avg", groups=groups, ratio="plate_1,group_2/group")
        # The link names what is shown.
        link = page.url
        page.goto("about:blank")
        page.goto(link)
        wait_until_ready(page)
        measured(panel_of(page), 4)
        assert groups_of(panel) == {name: text for name, text in groups.items() if name != "rest"}


def patches_below(page: Any, camera: str, points: list[tuple[float, float]]) -> np.ndarray:
    """The patches (row, column) that are shown at points of a picture, 0 to 1 from its left and top, as a mask."""
    seen = page.evaluate("window.viewer.shown().store.root.policy.cameras.map(({name, ...view}) => [name, view])")
    grids = page.evaluate("window.viewer.shown().site.layout.spans.map(({camera, grid}) => [camera, grid])")
    view, grid = dict(seen)[camera], {name: grid for name, grid in grids if name}[camera]
    mask = np.zeros((grid["rows"], grid["columns"]), dtype=bool)
    for x, y in points:
        across, down = (1 - x if view["mirrored"] else x), (y if view["upright"] else 1 - y)
        mask[int(down * grid["rows"]), int(across * grid["columns"])] = True
    return mask


@pytest.mark.parametrize("size", [(1280, 900), (800, 700)], ids=str)
def test_a_drag_without_a_group_paints_the_patches_below_the_pointer(store, size):
    # The panel is below the window's edge: what takes the focus there moves the picture away from the pointer.
    size = {"width": size[0], "height": size[1]}
    with shown_page(store, query="?episode=task001_episode000", viewport=size) as page:
        panel = panel_of(page)
        panel.locator("button.brush").click()
        canvas = page.locator(".main canvas[data-camera='base_0_rgb']")
        canvas.scroll_into_view_if_needed()
        box, scrolled = canvas.bounding_box(), page.evaluate("scrollY")
        points = [(0.02 + 0.96 * i / 20, 0.06 + 0.3 * i / 20) for i in range(21)]
        for i, (x, y) in enumerate(points):
            page.mouse.move(box["x"] + x * box["width"], box["y"] + y * box["height"])
            if i == 0:
                page.mouse.down()
            page.wait_for_timeout(20)  # a hand takes its time: what the page does meanwhile is done
        page.mouse.up()
        assert canvas.bounding_box() == box
        assert page.evaluate("scrollY") == scrolled
        assert page.evaluate("document.activeElement.tagName") != "INPUT"
        measured(panel)
        expected = patches_below(page, "base_0_rgb", points)
        assert 1 < expected.sum() < expected.size
        ((name, selector),) = groups_of(panel).items()
        assert name == "patches"
        masses = va.open(store).masses("replans", groups=[f"patches={selector}"], tasks=1)
        assert masses.filter(group="patches")["keys"].unique().to_list() == [expected.sum()]
        painted = np.zeros_like(expected)
        for r0, r1, c0, c1 in re.findall(r"base_0_rgb\[(\d+):(\d+),(\d+):(\d+)\]", selector):
            painted[int(r0) : int(r1), int(c0) : int(c1)] = True
        assert painted.tolist() == expected.tolist()


def test_keys_paint_one_patch_after_the_other(store):
    with shown_page(store, query="?episode=task001_episode000", viewport={"width": 1280, "height": 900}) as page:
        panel = panel_of(page)
        panel.locator("button.brush").click()
        page.locator(".main canvas[data-camera='base_0_rgb']").focus()
        for key in ("Enter", " ", "ArrowDown", " "):
            page.keyboard.press(key)
        measured(panel)
        ((_, selector),) = groups_of(panel).items()
        assert re.fullmatch(r"patch:base_0_rgb\[0:2,(\d):(\d)\]", selector)


def test_a_grouping_of_whole_segments_at_one_layer_and_head(store, tmp_path):
    text = quote("@base cameras\nlinguistic = role:instruction\nbegin = role:bos | role:template")
    query = f"?episode=task001_episode000&layer=3&head=1&denoise=9&grouping={text}"
    with shown_page(store, query=query, permissions=["clipboard-read", "clipboard-write"]) as page:
        panel = panel_of(page)
        measured(panel)
        command = panel.locator("[data-command]").text_content()
        assert command.endswith("--tasks 1 --layers 3 --denoise 9 --heads 1")
        panel.get_by_text("Copy the command").click()
        page.wait_for_function("async (text) => (await navigator.clipboard.readText()) === text", arg=command)
        settings = {"grouping": "cameras", "groups": groups_of(panel), "layers": 3, "denoise": 9, "heads": 1}
        compare_with_command(page, panel, tmp_path, "3", **settings)


def test_the_saved_file_is_read_by_the_command(store, tmp_path):
    text = quote(
        '@overlap\n@ratio seen/noun\nseen = role:image\nmiddle = patch:base_0_rgb[1:2,1:3]\nnoun = word:"top drawer"'
    )
    query = f"?episode=task001_episode000&layer=1&grouping={text}"
    with shown_page(store, query=query) as page:
        panel = panel_of(page)
        measured(panel, 4)
        with page.expect_download() as download:
            panel.get_by_text("Save as TOML").click()
        download.value.save_as(tmp_path / download.value.suggested_filename)
        assert download.value.suggested_filename in panel.locator("[data-command]").text_content()
        grouping = tmp_path / download.value.suggested_filename
        compare_with_command(page, panel, tmp_path, "1", grouping=str(grouping), layers=1)
        # The file opened again is the same grouping.
        before = numbers_of(panel, "episode")
        page.evaluate("window.viewer.view.update({grouping: ''})")
        panel.locator("input[type=file]").set_input_files(grouping)
        measured(panel, 4)
        assert numbers_of(panel, "episode") == before


MISTAKES: tuple[tuple[dict[str, str], str], ...] = (
    ({"bowl": "object:plate"}, ""),
    ({"bowl": "word:drawerr | role:image"}, ""),
    ({"bowl": "role:image | (keys:0-3"}, ""),
    ({"a": "role:image", "b": "camera:base_0_rgb"}, ""),
    ({"a": "patch:base_0_rgb[0:9,0:1]"}, ""),
    ({"a": "role:image"}, "a/nouns"),
)


def test_a_mistake_is_the_sentence_of_vla_analyze(store):
    with shown_page(store, query="?episode=task001_episode000") as page:
        panel = panel_of(page)
        for lines, ratio in MISTAKES:
            text = [f"@ratio {ratio}"] * bool(ratio) + [f"{name} = {selector}" for name, selector in lines.items()]
            page.evaluate("(grouping) => window.viewer.view.update({grouping})", "\n".join(text))
            wait_until_ready(page)
            shown = [problem.text_content() for problem in panel.locator(".problem:visible").all()]
            assert len(shown) == 1
            groups = [f"{name}={selector}" for name, selector in lines.items()]
            with pytest.raises(va.UserError) as error:
                va.open(store).masses("replans", groups=groups, ratio=ratio or None, tasks=1)
            assert shown[0] == str(error.value)


def test_generated_tokens_and_sites_of_some_layers(tmp_path):
    path = write_site_store(tmp_path / "growing.zarr", kind="growing")
    text = quote("@ratio seen/made\nseen = role:image\nmade = span:generated\nothers = keys:16-20")
    with shown_page(path, query=f"?episode=task001_episode000&grouping={text}") as page:
        panel = panel_of(page)
        measured(panel)
        groups = {**groups_of(panel), "rest": "*"}
        compare_with_command(page, panel, tmp_path, "layers_avg", groups=groups, ratio="seen/made")
        now = numbers_of(panel, "replan")
        assert now["made"]["keys"] == 6
        # Only later queries see them, so that uniform attention gives them less than their number says.
        assert number(panel, "uniform-ratio") > 1.1 * now["seen"]["keys"] / now["made"]["keys"]


def masks(tokens: EpisodeTokens, cells: tuple[int, int, int, int]) -> np.ndarray:
    """What uniform attention gives where each replan, layer, denoise step, head and query sees other keys."""
    seen = np.random.default_rng(3).random((tokens.num_replans, *cells, tokens.layout.num_keys)) < 0.6
    seen[..., [span.start for span in tokens.layout.spans]] = True
    return seen / seen.sum(axis=-1, keepdims=True)


def masked(task: int, episode: int, tokens: EpisodeTokens, rows: np.ndarray) -> np.ndarray:
    rows = np.where(masks(tokens, rows.shape[1:5]) > 0, rows, 0.0)
    return rows / rows.sum(axis=-1, keepdims=True)


@pytest.mark.parametrize("cell", [{}, {"layer": 3, "head": 1, "denoise": 9}], ids=["means", "one head"])
def test_queries_layers_and_heads_that_see_different_keys(tmp_path, cell):
    spec = StoreSpec(
        tasks=(1,), replans=4, layers=(0, 1, 3), queries="all", plant_uniform=masks, plant_rows=masked, mantissa_bits=23
    )
    path = write_store(tmp_path / "masked.zarr", spec=spec)
    asked = {{"layer": "layers", "head": "heads"}.get(axis, axis): value for axis, value in cell.items()}
    link = "&".join(f"{axis}={value}" for axis, value in cell.items())
    # Whole segments, and groups that cut them.
    for noun in ("role:instruction", "word:drawer"):
        text = quote(f"@ratio seen/noun\nseen = camera:base_0_rgb\nnoun = {noun}")
        with shown_page(path, query=f"?episode=task001_episode000&grouping={text}&{link}") as page:
            panel = panel_of(page)
            measured(panel)
            groups = {**groups_of(panel), "rest": "*"}
            layer = str(cell.get("layer", "layers_avg"))
            compare_with_command(page, panel, tmp_path, layer, groups=groups, ratio="seen/noun", **asked)


def test_the_panel_on_a_telephone(store):
    text = quote("seen = role:image\nlong = patch:base_0_rgb[0:1,0:1] | patch:base_0_rgb[1:2,2:3]\nbad = role:imag")
    query = f"?episode=task001_episode000&grouping={text}"
    with shown_page(store, query=query, viewport={"width": 380, "height": 800}, has_touch=True) as page:
        panel = panel_of(page)
        assert "Did you mean 'image'?" in panel.locator(".group-line .problem:visible").text_content()
        panel.locator(".group-line .remove").nth(2).tap()
        panel.get_by_text("groups may overlap").tap()
        measured(panel, 3)
        assert page.evaluate("document.documentElement.scrollWidth") <= 380
