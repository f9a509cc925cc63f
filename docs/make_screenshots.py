"""Draw `docs/pictures/viewer_*.png`: the viewer's page on a store of `make capture`, in the machine's Chromium.

python docs/make_screenshots.py [STORE]
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from tests.kit.browser import Watched, chromium, watched_page
from tests.kit.viewer import served
from vla_attention.schemas.errors import BadArgument

FOLDER = Path(__file__).parent / "pictures"
FIRST = {"episode": "task003_episode000", "replan": "2"}
GROUPS = "cube = object:red_cube\ncolour = word:red\nverb = word:lift"


@dataclass(frozen=True)
class Screenshot:
    """A picture: what the link names, the part of the page that is taken (without one the window), and its window."""

    link: dict[str, str]
    part: str = ""
    ready: str = ""
    width: int = 1280
    height: int = 900
    options: dict[str, Any] = field(default_factory=dict)


SCREENSHOTS = {
    "viewer_episode": Screenshot({**FIRST, "layer": "2"}),
    "viewer_groups": Screenshot(
        {**FIRST, "grouping": GROUPS}, part='details.panel:has([data-panel="groups"])', ready='[data-panel="groups"]'
    ),
    "viewer_compare": Screenshot(
        {**FIRST, "layer": "2", "other": "0:task004_episode000"},
        part='details.panel:has([data-panel="compare"])',
        ready='[data-panel="compare"][data-ready="1"]',
    ),
    "viewer_phone": Screenshot(
        FIRST, width=390, height=844, options={"color_scheme": "dark", "has_touch": True, "device_scale_factor": 2}
    ),
}


def take(watched: Watched, link: str, wanted: Screenshot, path: Path) -> None:
    """Open the page and write one picture."""
    watched.open(f"{link}?{urlencode(wanted.link)}")
    watched.page.wait_for_load_state("networkidle")
    if not wanted.part:
        watched.page.screenshot(path=path)
        return
    part = watched.page.locator(wanted.part)
    if part.get_attribute("open") is None:
        part.locator("summary").first.click()
    watched.page.wait_for_selector(wanted.ready)
    watched.page.wait_for_timeout(500)  # what is drawn after it was unfolded
    part.screenshot(path=path)


def main() -> None:
    """Take all of them."""
    store = Path(sys.argv[1] if len(sys.argv) > 1 else "runs/cubes.zarr")
    if not store.exists():
        raise SystemExit(str(BadArgument(f"There is no store at {store}: run make capture first.")))
    with served(store, summaries=True) as server, chromium() as browser:
        server.stores[0].summary.wait()
        for name, wanted in SCREENSHOTS.items():
            with watched_page(browser, wanted.width, wanted.height, **wanted.options) as watched:
                take(watched, server.link, wanted, FOLDER / f"{name}.png")
            print(FOLDER / f"{name}.png")


if __name__ == "__main__":
    main()
