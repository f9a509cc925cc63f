"""Opening stores that are there, that are not, and that are something else."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr
from msgspec.structs import replace

from tests.kit.attacks import exchange, files_of
from tests.kit.stores import (
    StoreSpec,
    episode_records,
    reseal,
    root_attributes,
    write_array,
    write_store,
)
from vla_attention.schemas.errors import Note
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.store_format import (
    CorruptEpisode,
    StoreError,
    StoreNotFound,
)
from vla_attention.schemas.stores.verify import verify_store

SPEC = StoreSpec(tasks=(1, 12), episodes=2, replans=2)


@pytest.fixture(scope="module")
def original(tmp_path_factory) -> Path:
    return write_store(tmp_path_factory.mktemp("original") / "libero_10.zarr", spec=SPEC)


@pytest.fixture
def path(original, tmp_path) -> Path:
    copy = tmp_path / "libero_10.zarr"
    shutil.copytree(original, copy)
    return copy


def test_a_store_lists_its_run_and_its_episodes_in_order(original):
    store = open_store(original)
    assert replace(store.attributes, digest="") == root_attributes(SPEC)
    assert store.suite == "made_up"
    assert store.task_ids == (1, 12)
    assert [episode.name for episode in store.episodes] == [
        "task001_episode000",
        "task001_episode001",
        "task012_episode000",
        "task012_episode001",
    ]


def test_order_is_by_number_and_not_by_letter(tmp_path):
    path = write_store(tmp_path / "a.zarr", tasks=(1000, 999), episodes=1, replans=1)
    assert [episode.name for episode in open_store(path).episodes] == ["task999_episode000", "task1000_episode000"]


def test_tokens_are_those_of_the_records(original):
    store = open_store(original)
    for stored, (task, episode) in zip(store.episodes, SPEC.names, strict=True):
        tokens = stored.tokens(store.attributes, "joint")
        _, records = episode_records(SPEC, task, episode)
        assert (tokens.key_role == np.stack([record.key_role["joint"] for record in records])).all()
        assert tokens.prompt_index is not None
        assert [tokens.prompts[i] for i in tokens.prompt_index] == [record.prompt for record in records]
        assert tokens.coverage is not None
        assert list(tokens.coverage) == ["base_0_rgb", "left_wrist_0_rgb"]
        for camera, coverage in tokens.coverage.items():
            assert (coverage == np.stack([record.coverage[camera] for record in records])).all()


def test_one_layer_does_not_need_the_others(path):
    """The chunk of one layer is damaged; the other layer is read, and this one is an error."""
    (file,) = files_of(path / "episodes/task001_episode000", "joint/rows")
    content = bytearray(file.read_bytes())
    content[20] ^= 1  # the first chunk: layer 0, first denoise step
    file.write_bytes(content)
    episode = open_store(path).episodes[0]
    _, records = episode_records(SPEC, 1, 0)
    rows = np.stack([record.rows["joint"].rows for record in records])
    np.testing.assert_allclose(episode.read_layer("joint/rows", 1, 0), rows[:, 1, 0], rtol=2**-11)
    with pytest.raises(CorruptEpisode, match=r"joint/rows.*task001_episode000"):
        episode.read_layer("joint/rows", 0, 0)


#: A span of one key.
ONE_KEY = {"name": "a", "kind": "image", "start": 0, "stop": 1}
LAYOUTS: dict[str, dict[str, Any]] = {
    "one chunk": {"chunks": (3, 2, 2, 2, 1, 39)},
    "shards of a layer a chunk": {"shards": (4, 2, 2, 2, 1, 39), "chunks": (2, 1, 1, 2, 1, 39)},
    "shards of a replan a chunk": {"shards": (3, 2, 2, 2, 1, 39), "chunks": (1, 2, 2, 2, 1, 39)},
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_chunks_of_any_size_are_bound_to_their_episode(path, layout):
    """Rows that somebody else stored, in other chunks than capture, and sealed."""
    folders = [path / "episodes" / name for name in ("task001_episode000", "task001_episode001")]
    written = []
    for folder in folders:
        values = zarr.open_array(folder / "joint/rows")[...]
        written.append(values)
        shutil.rmtree(folder / "joint/rows")
        write_array(folder / "joint/rows", values, attributes={"scale_factor": 2.0**-15}, **LAYOUTS[layout])
        reseal(folder)
    for episode, values in zip(open_store(path).episodes, written, strict=False):
        rows = values.astype(np.float32) * np.float32(2.0**-15)
        np.testing.assert_array_equal(episode.read("joint/rows"), rows)
        np.testing.assert_array_equal(episode.read("joint/rows", 1), rows[1])
        np.testing.assert_array_equal(episode.read("joint/rows", slice(1, 2)), rows[1:2])
    files = files_of(folders[0], "joint/rows")
    assert files
    for file in files:
        exchange(file, folders[1] / file.relative_to(folders[0]))
    store = open_store(path)
    faults = verify_store(store, "files")
    for episode, fault in zip(store.episodes[:2], faults, strict=True):
        assert fault.where == episode.name
        assert "joint/rows" in fault.problem
        if layout == "shards of a replan a chunk":
            continue  # incompressible numbers: both indices are the same bytes, only the whole files' digests differ
        for replan in (slice(None), 1):
            with pytest.raises(CorruptEpisode, match=f"joint/rows.*{episode.name}"):
                episode.read("joint/rows", replan)
    files[0].unlink()
    with pytest.raises(CorruptEpisode, match="joint/rows"):
        open_store(path).episodes[0].read("joint/rows")


def test_a_missing_store_names_its_neighbours(path):
    with pytest.raises(StoreNotFound, match=r"'.*libero_10\.zarr'") as caught:
        open_store(path.with_name("libero10.zarr"))
    assert isinstance(caught.value, FileNotFoundError)
    with pytest.raises(StoreNotFound, match=r"a\.zarr"):
        open_store(path.parent / "nowhere" / "a.zarr")


def test_a_folder_or_file_that_is_no_store(tmp_path):
    with pytest.raises(StoreError, match=r"zarr\.json"):
        open_store(tmp_path)
    file = tmp_path / "a.zarr"
    file.write_text("mine")
    with pytest.raises(StoreError, match=r"a\.zarr"):
        open_store(file)


def change_root(path: Path, **changes: object) -> None:
    document = json.loads((path / "zarr.json").read_text())
    document["attributes"].update(changes)
    (path / "zarr.json").write_text(json.dumps(document))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"format": "something else"}, "'format'"),
        ({"policy": "pi0.5"}, r"\$\.policy: .*'str'"),
        ({"protocol": {}}, r"\$\.protocol: .*'name'"),
        (
            {"sites": [{"name": "joint", "spans": [{"name": "a", "kind": "image", "start": 3, "stop": 5}]}]},
            "'a'",
        ),
        ({"sites": [{"name": "../up", "spans": []}]}, "'../up'"),
        ({"sites": [{"name": "self", "spans": [ONE_KEY]}] * 2}, "self, self"),
        ({"sites": [{"name": "self", "spans": [ONE_KEY], "layers": [1, 3]}]}, "'self'.* 0, 2; .* 1, 3"),
        ({"surprise": 1}, "'surprise'"),
    ],
)
def test_root_attributes_of_the_wrong_kind(path, changes, message):
    change_root(path, **changes)
    with pytest.raises(StoreError, match=message) as caught:
        open_store(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "content",
    [b"", b"{", b"\xff\xfe\xfd", b'{"node_type": "array", "zarr_format": 3}'],
)
def test_an_unreadable_root(path, content):
    (path / "zarr.json").write_bytes(content)
    with pytest.raises(StoreError) as caught:
        open_store(path)
    assert "\n" not in str(caught.value)


def test_a_folder_that_is_no_episode_is_named_and_ignored(path):
    (path / "episodes" / "my notes").mkdir()
    with pytest.warns(Note, match="my notes"):
        assert len(open_store(path).episodes) == 4


def test_a_store_without_its_episodes_group(path):
    shutil.rmtree(path / "episodes")
    with pytest.raises(StoreError):
        open_store(path)


@pytest.mark.parametrize(
    ("name", "cut"),
    [
        ("joint/rows", lambda values: values[..., 1:]),
        ("joint/rows", lambda values: values[:, :, :, :1]),
        ("joint/atoms", lambda values: values[1:]),
        ("joint/atoms", lambda values: values[..., 1:]),
        ("joint/atoms", lambda values: values.reshape(-1)),
    ],
    ids=["rows of fewer keys", "rows of fewer heads", "masses of fewer replans", "of fewer segments", "of one axis"],
)
def test_rows_and_masses_of_another_shape_are_refused(path, name, cut):
    """Arrays that somebody else wrote and sealed, with attributes that say so."""
    folder = path / "episodes/task001_episode000"
    values = np.ascontiguousarray(cut(zarr.open_array(folder / name)[...]))
    shutil.rmtree(folder / name)
    scale = {"scale_factor": 2.0**-15} if values.dtype == np.float16 else {}
    write_array(folder / name, values, chunks=values.shape, attributes=scale)
    document = json.loads((folder / "zarr.json").read_text())
    document["attributes"]["arrays"][name]["shape"] = list(values.shape)
    (folder / "zarr.json").write_text(json.dumps(document))
    reseal(folder)
    store = open_store(path)
    with pytest.raises(CorruptEpisode, match=rf"task001_episode000 .*{name} has the shape"):
        store.episodes[0].tokens(store.attributes, "joint")
    assert any(name in fault.problem for fault in verify_store(store, "values"))
