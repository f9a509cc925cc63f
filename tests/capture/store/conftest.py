from __future__ import annotations

import pytest

from tests.kit.durable_stores import SPEC, store_bytes, write_store


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory) -> dict[str, bytes]:
    return store_bytes(write_store(tmp_path_factory.mktemp("reference") / "a.zarr", spec=SPEC))
