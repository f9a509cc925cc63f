"""Fixtures that several test folders share."""

from __future__ import annotations

import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def libero_assets() -> Path:
    """The LIBERO asset folder: VLA_LIBERO_ASSETS, else ../shared/libero-assets beside the checkout, else skip."""
    given = os.environ.get("VLA_LIBERO_ASSETS")
    if given:
        return Path(given)
    beside = Path(__file__).resolve().parents[2] / "shared" / "libero-assets"
    if beside.is_dir():
        return beside
    pytest.skip("no LIBERO assets: set VLA_LIBERO_ASSETS to the asset folder")
