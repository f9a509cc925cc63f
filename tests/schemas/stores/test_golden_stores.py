"""Stores that were written when version 1 was frozen give the numbers that they gave then."""

from __future__ import annotations

import pytest

from tests.kit.golden_stores import FOLDER, NAMES, differences, flat, numbers_of, read_table
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.verify import verify_store


@pytest.mark.parametrize("name", NAMES)
def test_a_golden_store_gives_its_numbers(name):
    path = FOLDER / f"{name}.zarr"
    store = open_store(path)
    assert store.attributes.version_text == "version 1"
    assert verify_store(store) == []
    found = numbers_of(path)
    assert {f"{table}.csv" for table in found} == {file.name for file in (FOLDER / name).iterdir()}
    for table, values in found.items():
        assert differences(flat(values), read_table(FOLDER / name / f"{table}.csv", values)) == [], table


def test_what_the_golden_stores_are():
    stores = {name: open_store(FOLDER / f"{name}.zarr") for name in NAMES}
    assert [site.name for site in stores["joint"].attributes.sites] == ["joint"]
    assert {site.name for site in stores["cosmos"].attributes.sites} == {"self", "cross"}
    assert stores["library"].attributes.protocol.name == "recorded"
    assert stores["packed"].run == stores["joint"].run
    assert all(episode.place is not None for episode in stores["packed"].episodes)
    assert stores["rerun"].attributes.rerun_of is not None
    assert stores["rerun"].attributes.rerun_of.run == stores["joint"].run
