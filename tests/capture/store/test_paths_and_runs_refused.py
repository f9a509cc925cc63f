"""Which paths and which runs are refused: nothing that is not this run's store is continued, overwritten or touched."""

from __future__ import annotations

import errno
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from msgspec import structs

from tests.kit.durable_stores import SPEC, store_bytes, write_store
from tests.kit.stores import (
    denoise_times,
    episode_records,
    root_attributes,
    write_episode,
)
from vla_attention.capture.store.store_writer import open_run
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.stores.locks import episode_locks
from vla_attention.schemas.stores.store_format import (
    STORE_VERSION,
    FormatTooNew,
    RunMismatch,
    StoreError,
    StoreExists,
)


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"seed": 1}, "protocol.seed .*0,.* 1"),
        ({"mantissa_bits": 7}, "recording.mantissa_bits .*10,.* 7"),
        ({"policy": "other"}, "policy.name"),
    ],
)
def test_a_different_run_cannot_be_resumed(tmp_path, uninterrupted, change, field):
    path = write_store(tmp_path / "a.zarr", spec=SPEC)
    with pytest.raises(RunMismatch, match=field) as caught:
        write_store(path, mode="resume", spec=SPEC, **change)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 300 + len(str(path))
    assert store_bytes(path) == uninterrupted


def test_a_different_layout_names_the_span(tmp_path):
    path = write_store(tmp_path / "a.zarr", spec=SPEC)
    attributes = root_attributes(SPEC)
    (site,) = attributes.sites
    other = structs.replace(
        site, spans=(*site.spans[:-1], structs.replace(site.spans[-1], stop=site.spans[-1].stop + 1))
    )
    with pytest.raises(RunMismatch, match=r"sites\[0\]\.spans\[4\]\.stop .*39,.* 40"):
        open_run(path, structs.replace(attributes, sites=(other,)), "resume")


def test_other_provenance_and_another_checkpoint_path_may_resume(tmp_path, uninterrupted):
    path = write_store(tmp_path / "a.zarr", spec=replace(SPEC, episodes=1))
    attributes = root_attributes(SPEC)
    moved = structs.replace(
        attributes, provenance={"numpy": "9"}, policy=structs.replace(attributes.policy, checkpoint="elsewhere")
    )
    store = open_run(path, moved, "resume")
    assert structs.replace(store.attributes, digest="") == attributes  # what the store says, not what this process is
    write_episode(store, SPEC, 0, 1)
    assert store_bytes(path) == uninterrupted


def test_an_existing_store_is_refused_resumed_or_overwritten(tmp_path, uninterrupted):
    path = write_store(tmp_path / "a.zarr", spec=replace(SPEC, seed=5))
    with pytest.raises(StoreExists, match=r"2 episodes.*--resume.*--overwrite"):
        write_store(path, spec=SPEC)
    write_store(path, mode="overwrite", spec=SPEC)
    assert store_bytes(path) == uninterrupted
    assert list(tmp_path.iterdir()) == [path]


def test_a_run_begins_at_a_store_without_an_episode(tmp_path, uninterrupted):
    path = tmp_path / "a.zarr"
    for left in (
        SPEC,
        replace(SPEC, seed=5),
    ):  # of the same run and of another one, each ended before its first episode
        open_run(path, root_attributes(left), "new")
        write_store(path, spec=SPEC)
        assert store_bytes(path) == uninterrupted
        shutil.rmtree(path)
    assert list(tmp_path.iterdir()) == []


def test_a_store_whose_first_episode_is_being_recorded_is_not_taken(tmp_path, uninterrupted):
    path, other = tmp_path / "a.zarr", root_attributes(replace(SPEC, seed=5))
    store = open_run(path, root_attributes(SPEC), "new")
    start, _ = episode_records(SPEC, 0, 0)
    with (
        store.episode(start, denoise_times(SPEC)),
        pytest.raises(StoreExists, match="--overwrite"),
    ):
        open_run(path, other, "new")
    with episode_locks(path) as locks:
        locks.acquire("task005_episode000")
        with pytest.raises(StoreExists, match="--overwrite"):
            open_run(path, other, "new")
        write_store(path, spec=SPEC)  # another process of the same run
    assert store_bytes(path) == uninterrupted


def test_an_episode_is_not_added_to_another_run_that_took_the_place(tmp_path):
    path = tmp_path / "a.zarr"
    store = open_run(path, root_attributes(SPEC), "new")
    start, records = episode_records(SPEC, 0, 0)
    with store.episode(start, denoise_times(SPEC)) as writer:
        writer.append(records[0])
        open_run(path, root_attributes(replace(SPEC, seed=3)), "overwrite")
        with pytest.raises(RunMismatch, match=r"protocol\.seed"):
            writer.commit(False, 5)
        shutil.rmtree(path)
    with pytest.raises(StoreError, match=r"a\.zarr"), store.episode(start, denoise_times(SPEC)):
        pass


def make_foreign(path: Path, kind: str) -> None:
    if kind == "file":
        path.write_text("mine")
        return
    path.mkdir()
    if kind == "folder with files":
        (path / "thesis.txt").write_text("mine")
    else:
        (path / "zarr.json").write_text('{"zarr_format": 3, "node_type": "group", "attributes": {"mine": 1}}')


@pytest.mark.parametrize("mode", ["new", "resume", "overwrite"])
@pytest.mark.parametrize(
    "kind",
    ["file", "folder with files", "other Zarr group"],
)
def test_what_is_not_a_store_is_never_touched(tmp_path, kind, mode):
    path = tmp_path / "a.zarr"
    make_foreign(path, kind)
    before = store_bytes(tmp_path)
    with pytest.raises(StoreError):
        write_store(path, mode=mode, spec=SPEC)
    assert store_bytes(tmp_path) == before
    assert path.exists()


@pytest.mark.parametrize("mode", ["new", "resume", "overwrite"])
def test_a_store_of_a_later_format_is_never_touched(tmp_path, mode):
    path = write_store(tmp_path / "a.zarr", spec=SPEC)
    root = path / "zarr.json"
    versions = (f'"store_version": {version}' for version in (STORE_VERSION, STORE_VERSION + 1))
    root.write_text(root.read_text().replace(*versions))
    before = store_bytes(path)
    with pytest.raises(FormatTooNew):
        write_store(path, mode=mode, spec=SPEC)
    assert store_bytes(path) == before


@pytest.mark.parametrize("name", ["a", "a.zarr.zip"])
def test_a_path_without_the_suffix_is_refused(tmp_path, name):
    with pytest.raises(BadArgument, match=r"'\.zarr'"):
        write_store(tmp_path / name, spec=SPEC)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("parent", ["file/a.zarr"])
def test_a_parent_that_is_a_file(tmp_path, parent):
    (tmp_path / "file").write_text("mine")
    with pytest.raises(BadArgument, match=parent):
        write_store(tmp_path / parent, spec=SPEC)


def test_permission_denied_is_one_sentence(tmp_path, monkeypatch):
    def refuse(*_: object, **__: object) -> None:
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(Path, "mkdir", refuse)
    with pytest.raises(BadArgument, match="--output"):
        open_run(tmp_path / "a.zarr", root_attributes(SPEC), "new")


def test_a_link_to_a_store_is_followed(tmp_path, uninterrupted):
    (tmp_path / "elsewhere").mkdir()
    link = tmp_path / "a.zarr"
    link.symlink_to(tmp_path / "elsewhere/real.zarr")
    for mode in ("new", "resume", "overwrite"):
        write_store(link, mode=mode, spec=SPEC)
        assert store_bytes(tmp_path / "elsewhere/real.zarr") == uninterrupted
        assert link.is_symlink()
