"""Which versions are read, and a sentence for everything else."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from tests.kit.stores import StoreSpec, write_store
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.store_format import STORE_VERSION, FormatTooNew, StoreError

SPEC = StoreSpec(tasks=(0,), episodes=1, replans=1, layers=(0,), heads=(0,), frames=False)


@pytest.fixture(scope="module")
def original(tmp_path_factory) -> Path:
    return write_store(tmp_path_factory.mktemp("original") / "a.zarr", spec=SPEC)


@pytest.fixture
def path(original, tmp_path) -> Path:
    shutil.copytree(original, tmp_path / "a.zarr")
    return tmp_path / "a.zarr"


def change_root(path: Path, **changes: Any) -> None:
    """Set fields of the root's attributes; None removes one."""
    document = json.loads((path / "zarr.json").read_text())
    document["attributes"] |= changes
    for name in [name for name, value in changes.items() if value is None]:
        del document["attributes"][name]
    (path / "zarr.json").write_text(json.dumps(document))


def test_a_new_store_is_of_version_1(original):
    attributes = json.loads((original / "zarr.json").read_text())["attributes"]
    assert (attributes["format"], attributes["store_version"]) == ("vla-attention", 1)


def test_a_newer_version_is_refused_and_both_are_named(path):
    change_root(path, store_version=STORE_VERSION + 1, something_new={"a": 1})
    with pytest.raises(FormatTooNew, match=r" 2, .* 1;"):
        open_store(path)


@pytest.mark.parametrize(
    ("changes", "given"),
    [
        ({"store_version": None}, "no store_version"),
        ({"store_version": 0}, "0"),
        ({"store_version": True}, "True"),
        ({"store_version": "1"}, "'1'"),
        ({"store_version": 1.0}, r"1\.0"),
        ({"store_version": [1] * 1000}, r"\[1, 1.*\.\.\."),
    ],
)
def test_what_is_no_version_is_refused_in_a_sentence(path, changes, given):
    change_root(path, **changes)
    with pytest.raises(StoreError, match=f" {given}; expected 1") as caught:
        open_store(path)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 500
