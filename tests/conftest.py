"""Fixtures that several test folders share, and how many random examples property tests try."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from hypothesis import settings

from tests.kit.examples import PROFILES

for _name, _count in PROFILES.items():
    settings.register_profile(_name, max_examples=_count, deadline=None)
# `pytest --hypothesis-profile thorough` loads the other one afterwards, and before test modules are imported.
settings.load_profile("fast")


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
