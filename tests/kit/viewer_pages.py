"""The viewer's page in a real headless Chromium, driven by playwright."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from tests.kit.viewer import served

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
needs_browser = pytest.mark.skipif(BROWSER is None, reason="no Chromium on the PATH")


@contextmanager
def shown_page(*stores: Path, query: str = "", **context: Any) -> Iterator[Any]:
    """The page of stores, ready. At the end of the block a test fails on every error that the page met.

    Args:
        stores: what is served.
        query: of the page's link, with its question mark.
        context: of playwright's `new_context`, for instance the size of the window.
    """
    sync = pytest.importorskip("playwright.sync_api", reason="playwright is not installed (the extra dev)")
    with served(*stores) as server, sync.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=BROWSER, args=["--no-sandbox"])
        page = browser.new_context(**{"viewport": {"width": 1300, "height": 1400}, **context}).new_page()
        errors: list[str] = []
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.on("console", lambda said: errors.append(said.text) if said.type in ("error", "warning") else None)
        page.on("response", lambda got: errors.append(f"{got.status} {got.url}") if got.status >= 400 else None)
        page.goto(f"{server.link}{query}")
        wait_until_ready(page)
        yield page
        browser.close()
        assert not errors, errors


def wait_until_ready(page: Any) -> None:
    """Wait until everything of the present state is drawn."""
    page.wait_for_selector("#page[data-ready='1']", timeout=30_000)
