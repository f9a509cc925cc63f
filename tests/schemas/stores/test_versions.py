"""Which versions are read: version 1, the drafts before it, and a sentence for everything else."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.kit.paths import GOLDEN
from vla_attention.analyze.copy.copying import copy_store
from vla_attention.capture.store.store_writer import open_run
from vla_attention.schemas.interventions import Interventions
from vla_attention.schemas.json_files import schema_documents
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.root import read_run
from vla_attention.schemas.stores.store_format import STORE_VERSION, FormatTooNew, RunMismatch, StoreError
from vla_attention.schemas.stores.versions import LAST_DRAFT, DraftAttributes
from vla_attention.testing import assert_whole
from vla_attention.testing.stores import StoreSpec, expected_arrays, root_attributes, write_store

SPEC = StoreSpec(tasks=(0,), episodes=1, replans=1, layers=(0,), heads=(0,), frames=False)
#: The digest of each draft's run; its episodes are sealed to it.
DRAFTS = {
    2: "7a4af44f6975fa886850346966b95c1ec3c46b2db61a2303358361a0b6a0b983",
    3: "6ab6c1fdf9394b17f9bf13dfb8280c4dd1d6165212ab5c24f52e153c23f655a8",
    4: "8a9c947887fc3a05e3058ce40c46db87f4e7247ac41c7c840fe3b0e643969242",
    5: "f915c321f82c7c9b295db61cf0e4c29978175da45811d8153ec9ed022476a1b8",
}
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


def test_a_new_store_is_of_version_1(original):
    attributes = json.loads((original / "zarr.json").read_text())["attributes"]
    assert (attributes["format"], attributes["store_version"]) == ("vla-attention", 1)
    assert "format_version" not in attributes
    assert open_store(original).attributes.version_text == "version 1"


def test_a_newer_version_is_refused_and_both_are_named(path):
    change_root(path, store_version=STORE_VERSION + 1, something_new={"a": 1})
    with pytest.raises(
        FormatTooNew, match="is a store of version 2, and this program reads stores up to version 1; in"
    ):
        open_store(path)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"store_version": None}, "has neither a store_version nor a format_version"),
        ({"format_version": 5}, "has both a store_version and a format_version"),
        ({"store_version": 0}, "has the store_version 0; expected a whole number"),
        ({"store_version": 10**40}, "store of version with more than 19 digits, and this program reads stores up to"),
        ({"store_version": True}, "has the store_version True; expected a whole number"),
        ({"store_version": "1"}, "has the store_version '1'; expected a whole number"),
        ({"store_version": 1.0}, "has the store_version 1.0; expected a whole number"),
        ({"store_version": [1] * 1000}, r"has the store_version \[1, 1.*\.\.\.; expected a whole number"),
        ({"store_version": None, "format_version": 1}, "of draft 1, whose seals do not bind .*capture the episodes ag"),
        ({"store_version": None, "format_version": LAST_DRAFT + 1}, "format_version 6, which no store has: the drafts"),
        ({"store_version": None, "format_version": "2"}, "has the format_version '2'; expected a whole number"),
    ],
)
def test_what_is_no_version_is_refused_in_a_sentence(path, changes, message):
    change_root(path, **changes)
    with pytest.raises(StoreError, match=message) as caught:
        open_store(path)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 500


@pytest.mark.parametrize("draft", DRAFTS)
def test_stores_of_drafts_have_the_same_numbers(draft):
    old = GOLDEN / "stores" / f"draft{draft}.zarr"
    attributes, run = read_run(old)
    assert isinstance(attributes, DraftAttributes)
    assert (attributes.format_version, attributes.version_text) == (draft, f"draft {draft}")
    # The digest is over the attributes as they stand in the file, to which its episodes were sealed.
    assert run == DRAFTS[draft]
    assert (attributes.interventions, attributes.rerun_of, attributes.data_set) == (Interventions(), None, None)
    (site,) = attributes.sites
    assert (site.layers, site.heads, site.num_action_queries, site.growing_span) == ((), 0, 0, None)
    assert attributes.recording_of("joint") is attributes.recording
    episode = open_store(old).episodes[0]
    expected = expected_arrays(StoreSpec(tasks=(0,), episodes=1), task=0, episode=0)
    if attributes.numbers_in_arrays:
        expected |= {
            f"joint/{axis}": np.array(numbers, dtype=np.int32)
            for axis, numbers in attributes.recording.axis_numbers.items()
        }
    assert {name: episode.read(name).tobytes() for name in expected} == {
        name: values.tobytes() for name, values in expected.items()
    }
    for layer in range(2):
        np.testing.assert_array_equal(episode.read_layer("joint/rows", layer, 1), expected["joint/rows"][:, layer, 1])
    assert_whole(old)


@pytest.mark.parametrize("draft", DRAFTS)
def test_a_copy_keeps_the_draft(draft, tmp_path):
    old = GOLDEN / "stores" / f"draft{draft}.zarr"
    copy_store(open_store(old), tmp_path / "same.zarr", ())
    assert {file.relative_to(old): file.read_bytes() for file in old.rglob("*") if file.is_file()} == {
        file.relative_to(tmp_path / "same.zarr"): file.read_bytes()
        for file in (tmp_path / "same.zarr").rglob("*")
        if file.is_file()
    }
    for packed in (False, True):
        path = tmp_path / f"less{packed}.zarr"
        copy_store(open_store(old), path, ("frames", "objects"), packed=packed)
        assert read_run(path)[0].version_text == f"draft {draft}"
        assert_whole(path)
        one, other = open_store(path).episodes[0], open_store(old).episodes[0]
        for name in ("joint/rows", "env_step", "noise_seed", "denoise_time"):
            assert one.read(name).tobytes() == other.read(name).tobytes()
        assert not one.has("frames/base_0_rgb")


def test_a_draft_is_not_continued(tmp_path):
    shutil.copytree(GOLDEN / "stores" / "draft5.zarr", tmp_path / "a.zarr")
    wanted = root_attributes(StoreSpec(tasks=(0,), episodes=1))
    with pytest.raises(RunMismatch, match=r"it is of draft 5, and captures write version 1; give another --store"):
        open_run(tmp_path / "a.zarr", wanted, "resume")


def without_texts(schema: Any) -> Any:
    """A JSON Schema without titles and descriptions, which may change."""
    if isinstance(schema, dict):
        return {
            name: without_texts(value)
            for name, value in schema.items()
            if not (name in ("title", "description") and isinstance(value, str))
        }
    return [without_texts(value) for value in schema] if isinstance(schema, list) else schema


def test_the_fields_of_version_1_are_frozen():
    """A field that was added, removed or changed makes version 2: raise `STORE_VERSION`, and keep this file."""
    names = ("root_attributes", "episode_attributes", "episode_seal", "packed_index")
    found = {name: without_texts(schema_documents()[f"{name}.schema.json"]) for name in names}
    assert STORE_VERSION == 1
    assert found == json.loads(FIELDS.read_text(encoding="utf-8"))
