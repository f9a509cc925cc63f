"""Stores of effects that were recorded before these named their items: refused, and brought up to date by a script."""

from __future__ import annotations

import json
import shutil

import pytest
from scripts.convert_effects import convert

import vla_attention as va
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.seal import read_seal, seal_episode
from vla_attention.schemas.stores.store_format import StoreError
from vla_attention.schemas.stores.verify import verify_store


@pytest.fixture
def older(tmp_path):
    store = tmp_path / "older.zarr"
    shutil.copytree(va.example("cubes"), store)
    for folder in (store / "episodes").glob("task*"):
        document = json.loads((folder / "zarr.json").read_text())
        del document["attributes"]["effects"]["items"]
        (folder / "zarr.json").write_text(json.dumps(document))
        seal_episode(folder, folder.name, read_seal(folder).run)
    return store


def test_the_script_gives_each_condition_the_item_that_a_capture_gives_it(older):
    with pytest.raises(StoreError, match="convert_effects"):
        va.open(older).effects()
    assert convert(older) == 6
    assert verify_store(open_store(older)) == []
    for mine, theirs in zip(open_store(older).episodes, open_store(va.example("cubes")).episodes, strict=True):
        assert mine.attributes.effects == theirs.attributes.effects
    assert convert(older) == 0
