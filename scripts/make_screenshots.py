"""Draw `docs/pictures/viewer_*.png`: the page of `vla-attention view`, in the machine's Chromium.

python scripts/make_screenshots.py [STORE], a store of `make capture ARGS="--effects text,objects"`
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

FOLDER = Path(__file__).resolve().parents[1] / "docs/pictures"
FIRST = {"episode": "task003_episode000", "replan": "3"}


@dataclass(frozen=True)
class Screenshot:
    """A picture: what the link names, and the window."""

    link: dict[str, str]
    width: int = 1440
    height: int = 900
    options: dict[str, Any] = field(default_factory=dict)


SCREENSHOTS = {
    "viewer_overview": Screenshot({}),
    "viewer_episode": Screenshot({**FIRST, "group": "words:2", "without": "'red'"}),
    "viewer_compare": Screenshot({**FIRST, "beside": "0:task003_episode001"}),
    "viewer_phone": Screenshot(
        FIRST, width=390, height=844, options={"color_scheme": "dark", "has_touch": True, "device_scale_factor": 2}
    ),
}


def take(watched: Watched, link: str, wanted: Screenshot, path: Path) -> None:
    """Open the page and write one picture."""
    watched.open(f"{link}#{urlencode(wanted.link)}")
    watched.page.wait_for_load_state("networkidle")
    watched.page.screenshot(path=path)


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
