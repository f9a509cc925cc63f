"""Stores that were written earlier give the numbers that they gave then."""

from __future__ import annotations

import pytest

from tests.kit.golden_stores import FOLDER, NAMES, differences, flat, golden_store, numbers_of, read_table
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.verify import verify_store


@pytest.mark.parametrize("name", NAMES)
def test_a_golden_store_gives_its_numbers(name):
    path = golden_store(name)
    assert verify_store(open_store(path)) == []
    found = numbers_of(path)
    assert {f"{table}.csv" for table in found} == {file.name for file in (FOLDER / name).iterdir()}
    for table, values in found.items():
        assert differences(flat(values), read_table(FOLDER / name / f"{table}.csv", values)) == [], table
