"""A page in this machine's Chromium, for tests of the viewer; the served stores are each file's own `server`."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from tests.kit.browser import Watched, chromium, watched_page


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as running:
        yield running


@pytest.fixture
def view(browser, server) -> Iterator[Watched]:
    with watched_page(browser) as watched:
        yield watched
        assert watched.complaints == []
        assert watched.requests_beside(server.link) == []
