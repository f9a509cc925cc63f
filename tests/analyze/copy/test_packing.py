"""Packed stores: commands give what they give of the folder, other readers open a zip, copies go on."""

from __future__ import annotations

import json
import shutil
import signal
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
import tensorstore
import zarr

from tests.kit.crashes import before_call, die, run_child
from tests.kit.thorough import thorough_except
from vla_attention.analyze.__main__ import main as analyze
from vla_attention.analyze.commands import COMMANDS
from vla_attention.analyze.copy import packing
from vla_attention.analyze.copy.copying import copy_store
from vla_attention.capture.__main__ import main as capture
from vla_attention.schemas.errors import Note
from vla_attention.schemas.stores.packed_index import INDEX_FILE
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.verify import verify_store
from vla_attention.testing.site_stores import SiteStoreSpec, write_site_store
from vla_attention.testing.stores import StoreSpec, rerun_source, write_store

SPEC = StoreSpec(tasks=(0, 1), episodes=2, replans=2, contributions=True)
FIRST = "episodes/task000_000/task000_episode000.zip"


@pytest.fixture(scope="module")
def original(tmp_path_factory) -> Path:
    return write_store(tmp_path_factory.mktemp("original") / "a.zarr", spec=SPEC)


@pytest.fixture(scope="module")
def packed(original, tmp_path_factory) -> Path:
    return pack(original, tmp_path_factory.mktemp("packed") / "a.zarr")


def pack(store: Path, to: Path) -> Path:
    copy_store(open_store(store), to, (), packed=True)
    return to


def all_bytes(folder: Path) -> dict[str, bytes]:
    return {str(file.relative_to(folder)): file.read_bytes() for file in folder.rglob("*") if file.is_file()}


def test_an_episode_is_one_file_and_holds_the_same_numbers(original, packed):
    files = {file.relative_to(packed).as_posix() for file in packed.rglob("*") if file.is_file()}
    names = {f"episodes/task{task:03d}_000/task{task:03d}_episode{i:03d}.zip" for task in (0, 1) for i in (0, 1)}
    assert files == names | {"zarr.json", "episodes/zarr.json", INDEX_FILE}
    mine, theirs = open_store(packed), open_store(original)
    assert (mine.attributes, mine.run) == (theirs.attributes, theirs.run)
    assert verify_store(mine) == []
    for one, other in zip(mine.episodes, theirs.episodes, strict=True):
        assert (one.name, one.seal) == (other.name, other.seal)
        for name in other.attributes.arrays:
            assert np.array_equal(one.read(name), other.read(name), equal_nan=True), name
        with zipfile.ZipFile(packed / f"episodes/{one.name[:7]}_000/{one.name}.zip") as found:
            assert found.testzip() is None
            assert {member.compress_type for member in found.infolist()} == {zipfile.ZIP_STORED}


def test_other_readers_open_an_episode(original, packed):
    episode = open_store(original).episodes[0]
    store = zarr.storage.ZipStore(packed / FIRST, mode="r")
    group = zarr.open_group(store, mode="r")
    kinds = ("joint/rows", "joint/key_role", "state", "frames/base_0_rgb", "actions")
    for name in kinds:
        expected = episode.read(name)
        assert np.array_equal(group[name][...], expected), name
        stored = tensorstore.open(
            {
                "driver": "zarr3",
                "kvstore": {"driver": "zip", "base": f"file://{packed / FIRST}", "path": f"{name}/"},
            },
            open=True,
            read=True,
        ).result()
        assert np.array_equal(stored.read().result(), expected), name
    store.close()


def test_the_same_episode_packed_twice_has_the_same_bytes(original, packed, tmp_path):
    assert all_bytes(pack(original, tmp_path / "again.zarr")) == all_bytes(packed)


def test_a_copy_of_a_packed_store_is_the_captured_one_again(original, packed, tmp_path):
    copy_store(open_store(packed), tmp_path / "b.zarr", ())
    assert all_bytes(tmp_path / "b.zarr") == all_bytes(original)
    copied = copy_store(open_store(packed), tmp_path / "c.zarr", ("frames",), packed=True)
    assert copied.left_bytes > 0
    slim = open_store(tmp_path / "c.zarr")
    assert verify_store(slim) == []
    assert "frames/base_0_rgb" not in slim.episodes[0].attributes.arrays


#: Further arguments of each command; OUT is its folder of output.
WORDS: dict[str, tuple[str, ...]] = {
    "ratios": ("STORE", "--output", "OUT", "--no-plots", "--grouping", "objects"),
    "groups": ("STORE", "--output", "OUT"),
    "heads": ("STORE", "--output", "OUT", "--no-plots"),
    "words": ("STORE", "--output", "OUT", "--task", "0", "--no-plots"),
    "objects": ("STORE", "--output", "OUT", "--no-plots"),
    "time": ("STORE", "--output", "OUT", "--no-plots"),
    "compare": ("one=STORE", "two=OTHER", "--allow-mismatch", "seed", "--output", "OUT", "--no-plots"),
    "effects": ("STORE", "OTHER", "--output", "OUT", "--no-plots"),
    "deviation": ("STORE", "--output", "OUT", "--no-plots"),
    "overlay": ("STORE", "--output", "OUT", "--episode", "0", "--task", "0"),
    "report": ("STORE", "--output", "OUT", "--episodes", "1", "--task", "0", "--layers", "0"),
    "export": ("STORE", "--csv", "--output", "OUT"),
}


def test_every_command_that_reads_numbers_is_tried():
    assert set(WORDS) == set(COMMANDS) - {"copy", "verify", "repair", "cache", "view"}


def prepared(command: str, folder: Path) -> tuple[Path, Path]:
    """A store for the command, and another one: a rerun of it, or one of another suite."""
    store = folder / "stores" / "a.zarr"
    if command == "deviation":
        write_site_store(store, SiteStoreSpec(kind="split", dataset_actions=0.5, protocol="dataset"))
    else:
        write_store(store, spec=SPEC)
    changes: dict[str, Any] = {"rerun_of": rerun_source(store)} if command == "effects" else {"suite": "other"}
    if command == "compare":
        changes = {"policy": "another", "seed": 3}
    return store, write_store(folder / "stores" / "b.zarr", spec=SPEC, **changes)


def numbers_of(folder: Path, stores: dict[str, str]) -> dict[str, object]:
    """Every table and text in a folder; paths of stores are replaced by names."""
    found: dict[str, object] = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if path.suffix == ".parquet":
            found[name] = pl.read_parquet(path).to_dicts()
        elif path.suffix in (".csv", ".json", ".txt", ".html"):
            text = path.read_text(encoding="utf-8")
            for place, called in stores.items():
                text = text.replace(place, called)
            found[name] = text
        elif path.is_file():
            found[name] = None
    return found


@pytest.mark.parametrize("command", thorough_except(("ratios", "objects", "export"), WORDS))
def test_every_command_gives_the_same_tables_as_from_the_folder(command, tmp_path, monkeypatch, capsys):
    folders = prepared(command, tmp_path)
    packed = tuple(pack(path, tmp_path / "packed" / path.name) for path in folders)
    found = []
    for store, other in (folders, packed):
        here = tmp_path / f"of_{store.parent.name}"
        here.mkdir()
        monkeypatch.chdir(here)
        words = [
            word.replace("STORE", str(store)).replace("OTHER", str(other)).replace("OUT", "out")
            for word in WORDS[command]
        ]
        code = analyze([command, *words])
        printed = capsys.readouterr()
        assert code == 0, printed.err
        places = {str(store): "STORE", str(other): "OTHER"}
        found.append((numbers_of(here, places), printed.out.replace(str(store), "S").replace(str(other), "O")))
    assert found[0][0], command
    assert sorted(found[0][0]) == sorted(found[1][0])
    for name, content in found[0][0].items():
        assert repr(content) == repr(found[1][0][name]), name
    if command not in ("groups", "overlay"):
        assert any(content is not None for content in found[0][0].values())


def test_verify_and_list_read_a_packed_store(packed, capsys):
    assert analyze(["verify", str(packed)]) == 0
    assert "4 episodes, all whole" in capsys.readouterr().out
    assert analyze([str(packed), "--list"]) == 0
    listed = capsys.readouterr().out
    assert listed.count("solved") >= 1, listed


def test_workers_read_a_packed_store(packed, tmp_path, capsys):
    tables = []
    for workers in ("1", "2"):
        out = tmp_path / workers
        assert analyze([str(packed), "--output", str(out), "--no-plots", "--workers", workers]) == 0
        tables.append(numbers_of(out, {}))
    assert repr(tables[0]) == repr(tables[1])


def test_an_interrupted_copy_goes_on(original, packed, tmp_path, monkeypatch):
    class Interrupted(Exception):
        pass

    done = 0
    write_zip = packing.write_zip

    def stop_in_the_third(folder: Path, path: Path) -> int:
        nonlocal done
        if done == 2:
            path.write_bytes(b"PK\x03\x04 half of a zip")
            raise Interrupted
        done += 1
        return write_zip(folder, path)

    target = tmp_path / "b.zarr"
    with monkeypatch.context() as patch:
        patch.setattr(packing, "write_zip", stop_in_the_third)
        with pytest.raises(Interrupted):
            copy_store(open_store(original), target, (), packed=True)
    assert not list(target.rglob("*.partial*"))
    assert not list(tmp_path.glob("*.partial"))
    # What is there is a packed store of the whole zips, and nothing else passes for an episode.
    assert verify_store(open_store(target)) == []
    assert len(open_store(target).episodes) == 2
    again = copy_store(open_store(original), target, (), packed=True)
    assert (again.present, again.added) == (2, 2)
    assert all_bytes(target) == all_bytes(packed)


def test_two_copies_into_one_store_at_once(original, packed, tmp_path, monkeypatch, capsys):
    """The second is refused with a sentence and changes nothing; the first ends with all episodes."""
    target, write_zip, codes = tmp_path / "b.zarr", packing.write_zip, []

    def meanwhile(folder: Path, path: Path) -> int:
        if not codes:
            codes.append(analyze(["copy", str(original), str(target), "--packed"]))
        return write_zip(folder, path)

    monkeypatch.setattr(packing, "write_zip", meanwhile)
    assert copy_store(open_store(original), target, (), packed=True).added == 4
    said = capsys.readouterr().err
    assert codes == [2]
    assert "another copy is writing into it" in said
    assert said.count("\n") == 1
    assert all_bytes(target) == all_bytes(packed)
    assert not list(tmp_path.glob("*.partial"))


def killed_in_the_third(original: Path, target: Path) -> None:
    with before_call("replaced", 2, die):
        copy_store(open_store(original), target, (), packed=True)


def test_a_killed_copy_leaves_nothing_behind_for_long(original, packed, tmp_path):
    target = tmp_path / "b.zarr"
    assert run_child(killed_in_the_third, original, target) == -signal.SIGKILL
    assert {file.suffix for file in target.rglob("*") if file.is_file()} == {".json", ".zip"}
    (left,) = (tmp_path / "b.zarr.partial").iterdir()
    assert left.name.startswith("copy-")
    with pytest.warns(Note, match="Left out of .*b.zarr"):
        faults = verify_store(open_store(target))
    # What it has packed is on the disk, and in no index yet.
    assert [fault.where for fault in faults] == [
        str(file.relative_to(target)) for file in sorted(target.rglob("*.zip"))
    ]
    pack(original, target)
    assert verify_store(open_store(target)) == []
    assert all_bytes(target) == all_bytes(packed)
    assert list(tmp_path.iterdir()) == [target]


def test_a_packed_copy_is_brought_up_to_date_and_mends_what_is_missing(tmp_path):
    path = write_store(tmp_path / "a.zarr", spec=SPEC, episodes=1)
    pack(path, tmp_path / "b.zarr")
    write_store(path, mode="resume", spec=SPEC)
    again = copy_store(open_store(path), tmp_path / "b.zarr", (), packed=True)
    assert (again.present, again.added) == (2, 2)
    (tmp_path / "b.zarr" / FIRST).unlink()
    assert copy_store(open_store(path), tmp_path / "b.zarr", (), packed=True).added == 1
    assert verify_store(open_store(tmp_path / "b.zarr")) == []


def test_folders_and_zips_are_not_mixed(original, packed, tmp_path, capsys):
    shutil.copytree(original, tmp_path / "folders.zarr")
    shutil.copytree(packed, tmp_path / "zips.zarr")
    for words, expected in (
        ([str(tmp_path / "folders.zarr"), "--packed"], "its episodes are folders"),
        ([str(tmp_path / "zips.zarr")], "is packed: its episodes are zip files"),
    ):
        before = all_bytes(tmp_path)
        assert analyze(["copy", str(original), *words]) == 2
        said = capsys.readouterr().err
        assert expected in said
        assert said.count("\n") == 1
        assert all_bytes(tmp_path) == before


def test_capture_refuses_a_packed_store_with_a_sentence(packed, tmp_path, capsys):
    shutil.copytree(packed, tmp_path / "b.zarr")
    before = all_bytes(tmp_path)
    assert capture(["status", str(tmp_path / "b.zarr")]) == 2
    said = capsys.readouterr().err
    assert "is packed" in said
    assert "vla-attention copy" in said
    assert said.count("\n") == 1
    with pytest.raises(Exception, match="is packed") as caught:
        write_store(tmp_path / "b.zarr", mode="resume", spec=SPEC)
    assert "\n" not in str(caught.value)
    assert all_bytes(tmp_path) == before


def test_the_index_lists_where_small_files_begin(packed):
    index = json.loads((packed / INDEX_FILE).read_text())
    for entry in index["episodes"].values():
        with zipfile.ZipFile(packed / entry["file"]) as found:
            in_tail = [member for member in found.infolist() if member.header_offset >= entry["tail"]]
            before = [member for member in found.infolist() if member.header_offset < entry["tail"]]
        assert in_tail[-1].filename == "seal/zarr.json"
        assert all(member.filename.endswith("zarr.json") or member.file_size <= 4096 for member in in_tail)
        assert not any(member.filename.endswith("zarr.json") for member in before)
