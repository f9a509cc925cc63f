"""Pages of the viewer in a real headless Chromium, driven by playwright; what a page says or asks for is kept."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import pytest

#: Debian's; playwright brings one of its own only where it is asked to download it.
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
needs_chromium = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on the PATH")
READY = '#page[data-ready="1"]'
#: Milliseconds after which a page that is not drawn is a failure; a machine with other work may need seconds.
PATIENCE = 60_000


@dataclass
class Watched:
    """A page, what it wrote to the console as a warning or an error, and the addresses that it asked for."""

    page: Any
    complaints: list[str] = field(default_factory=list)
    requests: list[str] = field(default_factory=list)

    def open(self, link: str) -> None:
        """Go to a link and wait until all is drawn."""
        self.page.goto(link)
        self.settle()

    def settle(self) -> None:
        """Wait until the present state is drawn."""
        wait_until_ready(self.page)

    def wait_for_link(self, part: str) -> None:
        """Wait until the link names something, and what it names is drawn."""
        self.page.wait_for_url(lambda link: part in link, wait_until="commit")
        self.settle()

    def value(self, selector: str) -> float:
        """The full value of a number on the page."""
        return float(self.page.locator(selector).get_attribute("data-value"))

    def requests_beside(self, link: str) -> list[str]:
        """What was asked for anywhere but below a link, and not made by the page itself."""
        return [address for address in self.requests if not address.startswith((link, "blob:", "data:"))]


@contextmanager
def chromium() -> Iterator[Any]:
    """A browser; its pages are closed with it."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        options = ["--no-sandbox", "--disable-gpu"]
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=options, timeout=3 * PATIENCE)
        try:
            yield browser
        finally:
            browser.close()


@contextmanager
def watched_page(browser: Any, width: int = 1280, height: int = 900, **options: Any) -> Iterator[Watched]:
    """A new page of a size; options are those of playwright's `new_context`."""
    context = browser.new_context(**{"viewport": {"width": width, "height": height}, **options})
    try:
        page = context.new_page()
        page.set_default_timeout(PATIENCE)
        watched = Watched(page)
        page.on("console", lambda said: said.type in ("error", "warning") and watched.complaints.append(said.text))
        page.on("response", lambda got: got.status >= 400 and watched.complaints.append(f"{got.status} {got.url}"))
        page.on("pageerror", lambda error: watched.complaints.append(str(error)))
        page.on("request", lambda request: watched.requests.append(request.url))
        yield watched
    finally:
        context.close()


def wait_until_ready(page: Any) -> None:
    """Wait until everything of the present state is drawn."""
    page.wait_for_selector(READY)
