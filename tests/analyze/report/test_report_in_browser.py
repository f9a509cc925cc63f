"""The report in a real headless Chromium: no error, nothing requested, slider, tables, narrow and dark pages."""

from __future__ import annotations

import json
import re
import subprocess
from pathlib import Path
from typing import Any

import pytest

import vla_attention.testing.stores as kit
from tests.kit.browser import CHROMIUM, needs_chromium
from vla_attention.analyze.__main__ import main

pytestmark = [pytest.mark.thorough, needs_chromium]

#: Runs before the page's own script, and after it everything that a user would do; the findings go into the page.
_LISTEN = """<script>
window.found = {errors: []};
addEventListener("error", (event) => window.found.errors.push(String(event.message)), true);
addEventListener("securitypolicyviolation", (event) => window.found.errors.push(event.blockedURI));
for (const kind of ["error", "warn"]) {
  const say = console[kind];
  console[kind] = (...words) => { window.found.errors.push(words.join(" ")); say(...words); };
}
</script>"""
_ACT = """<script>
addEventListener("load", function () {
  const found = window.found;
  const shownImage = (episode) => {
    const shown = Array.from(episode.querySelectorAll(".replan")).filter((one) => one.offsetParent !== null);
    found.visible = (found.visible || []).concat([shown.length]);
    return Array.from(shown[0].querySelectorAll("img.heat")).map((image) => image.src).join();
  };
  const requests = performance.getEntriesByType("resource").map((entry) => entry.name);
  found.requests = requests.filter((name) => !name.startsWith("data:"));
  found.broken = Array.from(document.images).filter((image) => !image.complete || !image.naturalWidth).length;
  found.images = document.images.length;
  const episode = document.querySelector(".episode");
  const slider = episode.querySelector("input[type=range]");
  const dot = episode.querySelector(".curve circle");
  const before = shownImage(episode), placeBefore = dot.getAttribute("cx");
  const labelBefore = episode.querySelector("output").textContent;
  slider.value = "2";
  slider.dispatchEvent(new Event("input", {bubbles: true}));
  found.pictureChanged = shownImage(episode) !== before;
  found.dotMoved = dot.getAttribute("cx") !== placeBefore;
  found.labels = [labelBefore, episode.querySelector("output").textContent, slider.getAttribute("aria-valuetext")];
  const box = episode.querySelector("input[type=checkbox]");
  const plain = episode.querySelector(".replan.shown img.plain");
  const hidden = getComputedStyle(plain).display;
  box.click();
  found.plain = [hidden, getComputedStyle(plain).display];
  const table = document.querySelector("#tasks table.sortable");
  const heads = Array.from(table.tHead.rows[0].cells);
  found.sorted = {};
  for (const name of ["instruction", "ratio"]) {
    const head = heads.find((cell) => cell.textContent === name);
    for (const turn of ["ascending", "descending"]) {
      head.querySelector("button").click();
      const keys = Array.from(table.tBodies[0].rows).map((row) => row.cells[heads.indexOf(head)].dataset.key);
      found.sorted[name + " " + turn] = {keys: keys, said: head.getAttribute("aria-sort"),
        marked: heads.filter((cell) => cell.hasAttribute("aria-sort")).length};
    }
  }
  const column = heads.findIndex((cell) => cell.textContent === "lift");
  Array.from(table.tBodies[0].rows).forEach((row, i) => { row.cells[column].dataset.key = ["100.5", "", "9.25"][i]; });
  found.mixed = [0, 1].map(() => {
    heads[column].querySelector("button").click();
    return Array.from(table.tBodies[0].rows).map((row) => row.cells[column].dataset.key);
  });
  found.announced = document.getElementById("announcer").textContent;
  found.width = [document.documentElement.scrollWidth, innerWidth];
  found.paper = getComputedStyle(document.body).backgroundColor;
  const probe = document.createElement("pre");
  probe.id = "probe";
  probe.textContent = JSON.stringify(found);
  document.body.append(probe);
});
</script>"""


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("browser")
    store = kit.write_store(folder / "made.zarr", tasks=(0, 1, 2), episodes=2, contributions=True)
    assert main(["report", str(store), "--output", str(folder / "report.html")]) == 0
    html = (folder / "report.html").read_text(encoding="utf-8")
    probed = html.replace("<head>", f"<head>{_LISTEN}", 1).replace("</body>", f"{_ACT}</body>", 1)
    (folder / "probed.html").write_text(probed, encoding="utf-8")
    return folder / "probed.html"


def browse(page: Path, *options: str) -> dict[str, Any]:
    """What the page says of itself after it was used."""
    assert CHROMIUM is not None
    profile = f"--user-data-dir={page.parent / 'profile'}"
    setup = ["--headless=new", "--no-sandbox", "--disable-gpu", "--no-first-run", profile]
    offline = ["--virtual-time-budget=8000", "--host-resolver-rules=MAP * ~NOTFOUND"]
    command = [CHROMIUM, *setup, *offline, *options, "--dump-dom", page.as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    match = re.search(r'<pre id="probe">(.*?)</pre>', done.stdout, re.DOTALL)
    assert match is not None, done.stderr[-2000:]
    import html

    found: dict[str, Any] = json.loads(html.unescape(match[1]))
    return found


@pytest.fixture(scope="module")
def found(page: Path) -> dict[str, Any]:
    return browse(page, "--window-size=1200,900")


def test_the_page_loads_without_an_error_and_without_the_network(found: dict[str, Any]) -> None:
    assert found["errors"] == []
    assert found["requests"] == []
    assert found["images"] > 20
    assert found["broken"] == 0


def test_the_slider_changes_the_picture_the_curve_and_the_words(found: dict[str, Any]) -> None:
    assert found["visible"] == [1, 1]
    assert found["pictureChanged"]
    assert found["dotMoved"]
    before, after, spoken = found["labels"]
    assert before != after == spoken
    assert before.startswith("replan 0, step 10, ratio ")
    assert after.startswith("replan 2, step 20, ratio ")
    assert found["plain"][0] == "none"
    assert found["plain"][1] != "none"


def test_tables_sort_by_words_and_by_numbers_in_both_directions(found: dict[str, Any]) -> None:
    for column, key in (("instruction", str), ("ratio", float)):
        for turn, reverse in (("ascending", False), ("descending", True)):
            result = found["sorted"][f"{column} {turn}"]
            assert result["said"] == turn
            assert result["marked"] == 1
            assert len(result["keys"]) == 3
            assert result["keys"] == sorted(result["keys"], key=key, reverse=reverse)
    # Numbers are no words, and what has no value comes last either way.
    assert found["mixed"] == [["9.25", "100.5", ""], ["100.5", "9.25", ""]]
    assert found["announced"] == "Sorted by lift, descending."


def test_a_narrow_page_does_not_scroll_sideways(page: Path) -> None:
    narrow = browse(page, "--window-size=500,900")
    assert narrow["errors"] == []
    width, window = narrow["width"]
    assert width <= window


def test_the_page_is_dark_where_people_want_it_dark(page: Path, found: dict[str, Any]) -> None:
    dark = browse(page, "--window-size=1200,900", "--blink-settings=preferredColorScheme=0")

    def lightness(color: str) -> int:
        return sum(map(int, re.findall(r"\d+", color)[:3]))

    assert lightness(found["paper"]) > 700
    assert lightness(dark["paper"]) < 120
