"""Which versions are read, and a sentence for everything else."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import vla_attention as va
from tests.kit.paths import GOLDEN
from vla_attention.analyze.copy.copying import copy_store
from vla_attention.analyze.copy.merging import merge_stores
from vla_attention.capture.store.store_writer import open_run
from vla_attention.schemas.json_files import schema_documents
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.store_format import STORE_VERSION, FormatTooNew, RunMismatch, StoreError
from vla_attention.testing import assert_whole
from vla_attention.testing.stores import StoreSpec, write_store

SPEC = StoreSpec(tasks=(0,), episodes=1, replans=1, layers=(0,), heads=(0,), frames=False)
#: The fields of what a store of version 1 says, by the JSON Schemas; the rule is in docs/store.md, "Versions".
FIELDS = GOLDEN / "stores" / "version1_fields.json"


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


def test_a_new_store_is_of_version_2(original):
    attributes = json.loads((original / "zarr.json").read_text())["attributes"]
    assert (attributes["format"], attributes["store_version"]) == ("vla-attention", 2)
    assert open_store(original).attributes.version_text == "version 2"


def test_a_newer_version_is_refused_and_both_are_named(path):
    change_root(path, store_version=STORE_VERSION + 1, something_new={"a": 1})
    with pytest.raises(
        FormatTooNew, match="is a store of version 3, and this program reads stores up to version 2; in"
    ):
        open_store(path)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"store_version": None}, "has no store_version; expected a whole number, 1 to"),
        ({"format_version": 5}, "says format_version: it is of a draft of the format, before version 1"),
        ({"store_version": 0}, "has the store_version 0; expected a whole number"),
        ({"store_version": 10**40}, "store of version with more than 19 digits, and this program reads stores up to"),
        ({"store_version": True}, "has the store_version True; expected a whole number"),
        ({"store_version": "1"}, "has the store_version '1'; expected a whole number"),
        ({"store_version": 1.0}, "has the store_version 1.0; expected a whole number"),
        ({"store_version": [1] * 1000}, r"has the store_version \[1, 1.*\.\.\.; expected a whole number"),
        ({"store_version": None, "format_version": 2}, "of a draft of the format, .*; capture the episodes again"),
        ({"store_version": None, "format_version": "2"}, "it is of a draft of the format, before version 1"),
    ],
)
def test_what_is_no_version_is_refused_in_a_sentence(path, changes, message):
    change_root(path, **changes)
    with pytest.raises(StoreError, match=message) as caught:
        open_store(path)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 500


def without_texts(schema: Any) -> Any:
    """A JSON Schema without titles and descriptions, which may change."""
    if isinstance(schema, dict):
        return {
            name: without_texts(value)
            for name, value in schema.items()
            if not (name in ("title", "description") and isinstance(value, str))
        }
    return [without_texts(value) for value in schema] if isinstance(schema, list) else schema


def reached(schema: dict[str, Any]) -> dict[str, Any]:
    """The definitions that a schema refers to, also through others."""
    definitions, names = schema["$defs"], set[str]()
    new = {schema["$ref"].rpartition("/")[2]}
    while new:
        names |= new
        text = json.dumps([definitions[name] for name in new])
        new = {name for name in definitions if f'"#/$defs/{name}"' in text} - names
    return {name: values for name, values in definitions.items() if name in names}


#: What version 2 added, by document: the class and its field.
ADDED_VALUES = {"root_attributes": (("ImageChange", "kind", "mean"),)}
ADDED = {
    "root_attributes": (("Recording", "effects"),),
    "episode_attributes": tuple(("EpisodeAttributes", name) for name in ("task_family", "effects", "steps")),
    "episode_seal": (("FileRecord", "digests"),),
}


def test_the_fields_of_version_1_are_frozen():
    """A field that was removed or changed makes another version; what version 2 adds is named above."""
    found = {}
    for name in ("root_attributes", "episode_attributes", "episode_seal", "packed_index"):
        schema = without_texts(schema_documents()[f"{name}.schema.json"])
        for of, field, value in ADDED_VALUES.get(name, ()):
            schema["$defs"][of]["properties"][field]["enum"].remove(value)
        for of, field in ADDED.get(name, ()):
            del schema["$defs"][of]["properties"][field]
        found[name] = schema | {"$defs": reached(schema)}
    assert found == json.loads(FIELDS.read_text(encoding="utf-8"))


def test_a_store_of_version_1_is_not_continued(tmp_path):
    shutil.copytree(GOLDEN / "stores" / "version1" / "joint.zarr", tmp_path / "a.zarr")
    wanted = replace(open_store(tmp_path / "a.zarr").attributes, store_version=STORE_VERSION)
    with pytest.raises(RunMismatch, match=r"it is of version 1, and captures write version 2; give another --output"):
        open_run(tmp_path / "a.zarr", wanted, "resume")


@pytest.mark.parametrize("packed", [False, True])
def test_a_copy_of_version_1_is_of_version_1_with_its_numbers(tmp_path, packed):
    old = GOLDEN / "stores" / "version1" / "joint.zarr"
    for without in ((), ("frames", "objects")):
        path = tmp_path / f"{len(without)}.zarr"
        copy_store(open_store(old), path, without, packed=packed)
        assert open_store(path).attributes.version_text == "version 1"
        assert_whole(path)
        assert va.open(path).masses("tasks").equals(va.open(old).masses("tasks"))


def test_stores_of_two_versions_do_not_merge(tmp_path, original):
    old = open_store(GOLDEN / "stores" / "version1" / "joint.zarr")
    with pytest.raises(RunMismatch, match=r"the one is of version 1 and the other of version 2 of the store format"):
        merge_stores([old, open_store(original)], tmp_path / "both.zarr")
    halves = []
    for task in (0, 1):
        halves.append(tmp_path / f"{task}.zarr")
        shutil.copytree(str(old.path), halves[-1])
        shutil.rmtree(halves[-1] / "episodes" / f"task{task:03d}_episode000")
    merged = merge_stores([open_store(half) for half in halves], tmp_path / "merged.zarr")
    assert merged.episodes == 2
    assert open_store(tmp_path / "merged.zarr").attributes.version_text == "version 1"
