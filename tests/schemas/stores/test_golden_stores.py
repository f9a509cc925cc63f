"""Stores that were written when a version was frozen give the numbers that they gave then."""

from __future__ import annotations

import pytest

from tests.kit.golden_stores import GOLDEN_STORES, differences, flat, folder_of, numbers_of, read_table
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.verify import verify_store


@pytest.mark.parametrize(("version", "name"), GOLDEN_STORES)
def test_a_golden_store_gives_its_numbers(version, name):
    folder = folder_of(version)
    path = folder / f"{name}.zarr"
    store = open_store(path)
    assert store.attributes.version_text == f"version {version}"
    assert verify_store(store) == []
    found = numbers_of(path)
    assert {f"{table}.csv" for table in found} == {file.name for file in (folder / name).iterdir()}
    for table, values in found.items():
        assert differences(flat(values), read_table(folder / name / f"{table}.csv", values)) == [], table
