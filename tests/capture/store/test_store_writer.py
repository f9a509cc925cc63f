"""What is written is what is read, by our reader and by readers that know nothing of us."""

from __future__ import annotations

import json
import math
from pathlib import Path

import jsonschema
import numpy as np
import pytest
import tensorstore
import xarray
import zarr
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from msgspec import structs

from tests.kit.attacks import files_of
from tests.kit.examples import examples
from tests.kit.raw_rows import probabilities
from tests.kit.stores import (
    StoreSpec,
    denoise_times,
    episode_records,
    root_attributes,
    write_store,
)
from tests.kit.strategies import episode_tokens
from tests.kit.thorough import thorough_except
from vla_attention.capture.store import codecs as store_codecs
from vla_attention.capture.store.codecs import write_whole
from vla_attention.capture.store.store_writer import open_run
from vla_attention.schemas.json_files import FOLDER
from vla_attention.schemas.precision import mass_error_bound
from vla_attention.schemas.segments import segment_members
from vla_attention.schemas.stores import store_format as contract
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.verify import verify_store


def check_equals_spec(path: Path, spec: StoreSpec) -> None:
    """Every array and attribute of every episode against what the spec says."""
    store = open_store(path)
    assert verify_store(store) == []
    assert [(e.attributes.task_id, e.attributes.episode_index) for e in store.episodes] == spec.names
    assert structs.replace(store.attributes, digest="") == root_attributes(spec)
    for stored, (task, episode) in zip(store.episodes, spec.names, strict=True):
        start, records = episode_records(spec, task, episode)
        attributes = stored.attributes
        for name in (
            "task_name",
            "instruction",
            "initial_state_index",
            "initial_state_digest",
            "objects",
            "provenance",
        ):
            assert getattr(attributes, name) == getattr(start, name)
        assert attributes.success == (episode % 2 == 1)
        assert attributes.num_steps == 5 * spec.num_replans - episode % 2
        assert attributes.num_replans == len(records)
        index = stored.read("prompt_index")
        assert [attributes.prompts[i] for i in index] == [record.prompt for record in records]
        assert len(set(attributes.prompts)) == len(attributes.prompts)

        rows = np.stack([record.rows["joint"].rows for record in records])
        read = stored.read("joint/rows")
        assert read.dtype == np.float32
        assert (np.abs(read - rows) <= mass_error_bound(spec.mantissa_bits) * rows).all()
        assert (read[rows == 0] == 0).all()
        assert (stored.row_sum("joint") == np.stack([record.rows["joint"].row_sum for record in records])).all()
        roles = np.stack([record.key_role["joint"] for record in records])
        assert (stored.read("joint/key_role") == roles).all()
        members = segment_members(spec.layout, roles, attributes.segments["joint"])
        atoms = np.einsum("rldhqk,rks->rldhqs", rows.astype(np.float64), members.astype(np.float64))
        np.testing.assert_allclose(stored.read("joint/atoms")[..., :-1], atoms, rtol=1e-7, atol=0)
        np.testing.assert_allclose(stored.read("joint/atoms")[..., :-1].sum(-1), stored.row_sum("joint"), rtol=1e-6)

        for name in ("state", "actions", "env_step", "noise_seed"):
            assert (stored.read(name) == np.stack([getattr(record, name) for record in records])).all(), name
        assert (stored.read("denoise_time") == denoise_times(spec).astype(np.float32)).all()
        site = zarr.open_group(stored.folder / "joint", mode="r")
        assert dict(site.attrs) == {
            "layer": list(spec.layers),
            "denoise": list(spec.denoise_steps),
            "head": list(spec.heads),
        }
        for group, field in (("frames", "frames"), ("objects", "coverage")):
            cameras = {name.split("/")[1] for name in attributes.arrays if name.startswith(f"{group}/")}
            assert cameras == set(getattr(records[0], field))
            for camera in cameras:
                written = np.stack([getattr(record, field)[camera] for record in records])
                assert (stored.read(f"{group}/{camera}") == written).all()
                assert stored.read(f"{group}/{camera}").dtype == written.dtype


@pytest.mark.parametrize("bits", [1, 10, 23])
@pytest.mark.parametrize("queries", ["mean", "all"])
def test_everything_written_is_read_back(tmp_path, bits, queries):
    spec = StoreSpec(tasks=(0, 3), episodes=1, mantissa_bits=bits, queries=queries)
    check_equals_spec(write_store(tmp_path / "a.zarr", spec=spec), spec)


@pytest.mark.parametrize(
    "spec",
    [
        StoreSpec(frames=False, tasks=(12,), episodes=1),
        StoreSpec(coverage=False, prompts="same", tasks=(0,), episodes=1),
        StoreSpec(
            layers=(3,), layer_labels=(21,), denoise_steps=(4,), heads=(1,), tasks=(1234,), episodes=1, replans=1
        ),
    ],
)
def test_unusual_recordings(tmp_path, spec):
    check_equals_spec(write_store(tmp_path / "a.zarr", spec=spec), spec)


@settings(max_examples=examples(5), deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(tokens=episode_tokens(), bits=st.sampled_from([4, 10, 23]))
def test_random_layouts_are_read_back(tmp_path_factory, tokens, bits):
    spec = StoreSpec(tokens=tokens, mantissa_bits=bits, tasks=(0,), episodes=1)
    check_equals_spec(write_store(tmp_path_factory.mktemp("stores") / "a.zarr", spec=spec), spec)


@pytest.mark.parametrize("replans", thorough_except((7, 8, 17), (7, 8, 9, 15, 16, 17, 24, 30)))
def test_episodes_around_the_size_of_a_block(tmp_path, monkeypatch, replans):
    monkeypatch.setattr(store_codecs, "TARGET_CHUNK_BYTES", 1)
    spec = StoreSpec(replans=replans, tasks=(0,), episodes=1, heads=(0,), layers=(0, 1))
    path = write_store(tmp_path / "a.zarr", spec=spec)
    array = zarr.open_array(path / "episodes/task000_episode000/joint/rows")
    assert array.shards is not None
    assert array.chunks[0] == 8  # 39 keys: only eight replans make the chunk a multiple of 8 numbers
    assert array.shards[0] == 8 * math.ceil(replans / 8)
    assert math.prod(array.chunks) % 8 == 0
    assert len(files_of(path / "episodes/task000_episode000", "joint/rows")) == 1
    check_equals_spec(path, spec)


@pytest.fixture(scope="module")
def written(tmp_path_factory) -> tuple[Path, StoreSpec]:
    spec = StoreSpec(replans=9)
    return write_store(tmp_path_factory.mktemp("written") / "a.zarr", spec=spec), spec


def test_chunks_that_hold_only_the_fill_value_are_written(tmp_path):
    group = zarr.create_group(tmp_path / "g", zarr_format=3)
    for name, values in {
        "black": np.zeros((20, 30, 30, 3), dtype=np.uint8),
        "nan": np.full((4, 2), np.nan, dtype=np.float32),
    }.items():
        write_whole(group, name, values, [f"axis{i}" for i in range(values.ndim)])
        assert files_of(tmp_path / "g", name), name
    many = np.zeros((20, 300, 300, 3), dtype=np.uint8)
    array = write_whole(group, "many", many, ("replan", "row", "column", "channel"))
    assert array.shards is not None
    (file,) = files_of(tmp_path / "g", "many")
    count = array.shards[0] // array.chunks[0]
    index = np.frombuffer(file.read_bytes()[-16 * count - 4 : -4], dtype="<u8")
    assert count > 1
    assert (index != 2**64 - 1).all()  # what the index of a shard says of a chunk that was left out


def test_attributes_fit_the_json_schemas(written):
    path, _ = written
    root = json.loads((path / "zarr.json").read_text())["attributes"]
    schema = json.loads((FOLDER / "root_attributes.schema.json").read_text())
    jsonschema.validate(root, schema)
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate({**root, "surprise": 1}, schema)
    schema = json.loads((FOLDER / "episode_attributes.schema.json").read_text())
    for folder in (path / "episodes").glob("task*"):
        jsonschema.validate(json.loads((folder / "zarr.json").read_text())["attributes"], schema)


def test_xarray_reads_it(written):
    path, _ = written
    episode = open_store(path).episodes[-1]
    group = f"episodes/{episode.name}"
    site = xarray.open_zarr(path, group=f"{group}/joint", consolidated=False)
    joint = site.assign_coords(site.attrs)
    assert joint["rows"].dims == contract.ROW_AXES
    assert joint["atoms"].dims == contract.ATOM_AXES
    assert set(joint.coords) == {"layer", "denoise", "head"}
    assert joint["rows"].sel(layer=2, denoise=9, head=1).equals(joint["rows"].isel(layer=1, denoise=1, head=1))
    for name in ("rows", "atoms", "key_role"):
        stored = episode.read(f"joint/{name}")
        # A fill value must not turn integers into floats; xarray applies the scale of rows in float64.
        assert joint[name].dtype == (np.float64 if name == "rows" else stored.dtype)
        assert (joint[name].to_numpy() == stored).all()
    side = xarray.open_zarr(path, group=group, consolidated=False)
    assert side.attrs["instruction"] == episode.attributes.instruction
    assert dict(side.sizes) == {"replan": 9, "state_dim": 8, "horizon": 5, "action_dim": 7}
    assert side.attrs["env_step"] == episode.read("env_step").tolist()
    for name in side.variables:
        assert (side[name].to_numpy() == episode.read(str(name))).all()
    # Cameras of different sizes share the names of their axes: open one at a time.
    frames = xarray.open_zarr(path, group=f"{group}/frames", consolidated=False, drop_variables="left_wrist_0_rgb")
    assert frames["base_0_rgb"].dims == ("replan", "row", "column", "channel")
    assert frames["base_0_rgb"].dtype == np.uint8


def test_tensorstore_reads_it(written):
    path, _ = written
    episode = open_store(path).episodes[0]
    for name in episode.attributes.arrays:
        file_store = {"driver": "file", "path": str(episode.folder / name)}
        array = tensorstore.open({"driver": "zarr3", "kvstore": file_store}, read=True).result()
        assert tuple(array.domain.labels) == episode.array(name).metadata.axes, name
        scale = np.float32(episode.document(f"{name}/zarr.json")["attributes"].get("scale_factor", 1))
        found = array.read().result()
        assert ((found.astype(np.float32) * scale if scale != 1 else found) == episode.read(name)).all(), name


@pytest.mark.parametrize("bits", [10, 23])
def test_other_readers_give_the_numbers_of_members_of_real_size(tmp_path, bits):
    """Some megabytes in one shard, with zarr, xarray and tensorstore, which know nothing of this project."""
    spec = StoreSpec(tasks=(0,), episodes=1, replans=1400, frames=False, queries="all", mantissa_bits=bits)
    path = write_store(tmp_path / "a.zarr", spec=spec)
    episode = open_store(path).episodes[0]
    (file,) = (episode.folder / "joint/rows").glob("c.*")
    assert file.stat().st_size > 2 << 20
    rows = episode.read("joint/rows")
    assert (probabilities(zarr.open_group(path, mode="r")[f"episodes/{episode.name}/joint/rows"]) == rows).all()
    joint = xarray.open_zarr(path, group=f"episodes/{episode.name}/joint", consolidated=False)
    assert (joint["rows"].to_numpy() == rows).all()
    kept = {"driver": "zarr3", "kvstore": {"driver": "file", "path": str(file.parent)}}
    stored = tensorstore.open(kept, read=True).result().read().result()
    assert stored.dtype == (np.float16 if bits == 10 else np.float32)
    assert (stored.astype(np.float32) * np.float32(2.0**-15 if bits == 10 else 1) == rows).all()


def test_an_episode_without_replans_is_refused(tmp_path):
    spec = StoreSpec()
    store = open_run(tmp_path / "a.zarr", root_attributes(spec), "new")
    start, _ = episode_records(spec, 0, 0)
    with store.episode(start, denoise_times(spec)) as writer, pytest.raises(ValueError, match="replans"):
        writer.commit(False, 0)
    assert not list(tmp_path.glob("*.partial"))
