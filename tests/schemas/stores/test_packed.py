"""Damage to a packed store, by accident or on purpose, gives a sentence and never a number that was not recorded."""

from __future__ import annotations

import json
import shutil
import struct
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.kit.examples import examples
from tests.kit.thorough import thorough_except
from vla_attention.analyze.__main__ import main as analyze
from vla_attention.analyze.copy.copying import copy_store
from vla_attention.analyze.copy.packing import write_zip
from vla_attention.schemas.errors import Note, UserError
from vla_attention.schemas.stores.digest import seal_digest
from vla_attention.schemas.stores.packed_index import INDEX_FILE
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.verify import verify_store
from vla_attention.testing.stores import StoreSpec, write_store

SPEC = StoreSpec(tasks=(0,), episodes=2, replans=2, layers=(0, 2), denoise_steps=(0, 9), heads=(0,))
FIRST, SECOND = (f"episodes/task000_000/task000_episode00{i}.zip" for i in (0, 1))
Values = dict[str, dict[str, np.ndarray]]


@pytest.fixture(scope="module")
def folders(tmp_path_factory) -> tuple[Path, Path]:
    """Two stores of one configuration with other numbers."""
    made = tmp_path_factory.mktemp("folders")
    plant = {"plant_rows": lambda task, episode, tokens, rows: rows[:, ::-1]}
    return write_store(made / "a.zarr", spec=SPEC), write_store(made / "b.zarr", spec=SPEC, **plant)


@pytest.fixture(scope="module")
def originals(folders, tmp_path_factory) -> tuple[Path, Path]:
    made = tmp_path_factory.mktemp("packed")
    for folder in folders:
        copy_store(open_store(folder), made / folder.name, (), packed=True)
    return made / "a.zarr", made / "b.zarr"


@pytest.fixture
def path(originals, tmp_path) -> Path:
    return Path(shutil.copytree(originals[0], tmp_path / "a.zarr"))


@pytest.fixture
def other(originals, tmp_path) -> Path:
    return Path(shutil.copytree(originals[1], tmp_path / "b.zarr"))


@pytest.fixture(scope="module")
def recorded(folders) -> Values:
    return {
        one.name: {name: one.read(name) for name in one.attributes.arrays} for one in open_store(folders[0]).episodes
    }


def wrong_or_refused(path: Path, recorded: Values) -> list[str]:
    """The sentences with which the store, its episodes and their arrays are refused; what is read must be recorded."""
    said: list[str] = []

    def reads(what: Callable[[], Any]) -> Any:
        try:
            return what()
        except UserError as error:
            said.append(str(error))
            return None

    store = reads(lambda: open_store(path))
    for episode in () if store is None else store.episodes:
        if reads(lambda episode=episode: episode.attributes) is None:
            continue
        for name in episode.attributes.arrays:
            values = reads(lambda episode=episode, name=name: episode.read(name))
            expected = recorded[episode.name][name]
            assert values is None or np.array_equal(values, expected, equal_nan=True), (episode.name, name)
            if name.endswith("/rows"):
                layers = reads(lambda episode=episode, name=name: episode.read_layer(name, 1, 0))
                assert layers is None or np.array_equal(layers, expected[:, 1, 0])
    assert not any("\n" in sentence for sentence in said)
    return said


def check_refused(path: Path, recorded: Values, *, by_command: bool = True) -> list[str]:
    """Nothing wrong is read, something is refused, and the commands say so; returns the sentences."""
    said = wrong_or_refused(path, recorded)
    assert said
    if by_command:
        assert analyze(["verify", str(path)]) in (1, 2)
        assert analyze([str(path), "--no-plots", "--output", str(path.parent / "out")]) == 2
        assert not list((path.parent / "out").rglob("*.json"))
    return said


def edit_index(path: Path, change: Callable[[dict[str, Any]], object], *, seal: bool = True) -> None:
    """Change the index as its writer might have written it, with its digest, or leave the old one."""
    document = json.loads((path / INDEX_FILE).read_text())
    change(document)
    if seal:
        document["digest"] = seal_digest(document)
    (path / INDEX_FILE).write_text(json.dumps(document))


def test_a_whole_store_is_read(path, recorded):
    assert wrong_or_refused(path, recorded) == []


@pytest.mark.parametrize("bits", thorough_except((0x01,), (0x01, 0x80, 0xFF)))
def test_a_byte_that_was_flipped_anywhere_gives_no_other_number(path, recorded, bits):
    zip_file = path / FIRST
    whole = zip_file.read_bytes()
    tail = json.loads((path / INDEX_FILE).read_text())["episodes"]["task000_episode000"]["tail"]
    generator = np.random.default_rng(bits)
    places = {
        *generator.integers(0, len(whole), examples(25)).tolist(),
        *generator.integers(tail, len(whole), examples(25)).tolist(),
        *range(len(whole) - 22, len(whole), 3),
    }
    refused = 0
    for place in sorted(places):
        zip_file.write_bytes(whole[:place] + bytes([whole[place] ^ bits]) + whole[place + 1 :])
        refused += bool(wrong_or_refused(path, recorded))
    # Names and dates before each file, which nothing is read by, are the rest.
    assert refused > len(places) // 3


def test_a_flipped_byte_of_a_file_is_named_by_verify(path, capsys):
    with zipfile.ZipFile(path / FIRST) as found:
        member = next(one for one in found.infolist() if "joint/rows/c" in one.filename)
    content = bytearray((path / FIRST).read_bytes())
    content[member.header_offset + 30 + len(member.filename) + 100] ^= 4
    (path / FIRST).write_bytes(bytes(content))
    assert analyze(["verify", str(path)]) == 1
    said = capsys.readouterr().out
    assert f"{path}: task000_episode000: Array joint/rows" in said
    assert f"{path}: task000_episode001: whole" in said
    (fault,) = {fault.where for fault in verify_store(open_store(path))}
    assert fault == "task000_episode000"


def test_a_zip_that_was_cut_off_or_has_grown_is_refused(path, recorded):
    zip_file = path / FIRST
    whole = zip_file.read_bytes()
    for length in (0, 1, 21, 22, len(whole) // 2, len(whole) - 1):
        zip_file.write_bytes(whole[:length])
        check_refused(path, recorded, by_command=length in (0, len(whole) - 1))
    for more in (b"\0", whole):
        zip_file.write_bytes(whole + more)
        assert "has not the" in " ".join(check_refused(path, recorded, by_command=False))


def test_a_missing_zip_is_refused(path, recorded):
    (path / FIRST).unlink()
    assert "No such file" in " ".join(check_refused(path, recorded))
    (path / FIRST).mkdir()
    check_refused(path, recorded)


def packed_again(path: Path, zip_name: str, change: Callable[[Path], object]) -> None:
    """Pack an episode again after its files were changed, with the index that its writer would write."""
    folder = path.parent / "unpacked"
    shutil.rmtree(folder, ignore_errors=True)
    with zipfile.ZipFile(path / zip_name) as found:
        found.extractall(folder)
    change(folder)
    tail = write_zip(folder, path / zip_name)

    def say(index: dict[str, Any]) -> None:
        index["episodes"][Path(zip_name).stem] |= {"bytes": (path / zip_name).stat().st_size, "tail": tail}

    edit_index(path, say)


def swap(folder: Path, one: str, other: str) -> None:
    (folder / one).rename(folder / "aside")
    (folder / other).rename(folder / one)
    (folder / "aside").rename(folder / other)


@pytest.mark.parametrize(
    "change",
    [
        lambda folder: swap(folder, "joint/row_sum/c.0.0.0.0.0", "joint/atoms/c.0.0.0.0.0.0"),
        lambda folder: swap(folder, "frames/base_0_rgb", "frames/left_wrist_0_rgb"),
        lambda folder: swap(folder, "state", "actions"),
        lambda folder: (folder / "joint/rows").rename(folder / "joint/other"),
        lambda folder: (folder / "joint/rows/c.0.0.0.0.0.0").unlink(),
        lambda folder: shutil.rmtree(folder / "seal"),
        lambda folder: (folder / "zarr.json").unlink(),
        lambda folder: (folder / "joint/rows/zarr.json").write_text("{}"),
    ],
    ids=["swapped", "pictures swapped", "small swapped", "renamed", "lost", "no seal", "no attributes", "metadata"],
)
def test_members_that_were_swapped_renamed_or_removed_are_refused(path, recorded, change):
    packed_again(path, FIRST, change)
    check_refused(path, recorded, by_command=False)
    assert analyze(["verify", str(path)]) == 1


def test_what_a_zip_holds_besides_is_never_read(path, recorded):
    packed_again(path, FIRST, lambda folder: (folder / "joint/evil").write_text("more"))
    assert wrong_or_refused(path, recorded) == []


def rewritten(path: Path, write: Callable[[zipfile.ZipFile, zipfile.ZipFile], object]) -> None:
    """Write the first zip anew by hand; its whole content passes for the tail."""
    whole = path / FIRST
    building = whole.with_suffix(".new")
    with zipfile.ZipFile(whole) as old, zipfile.ZipFile(building, "w", zipfile.ZIP_STORED) as new:
        write(old, new)
    building.replace(whole)
    size = whole.stat().st_size
    edit_index(path, lambda index: index["episodes"]["task000_episode000"].update(bytes=size, tail=0))


@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_two_files_of_one_name_are_refused(path, recorded):
    def twice(old: zipfile.ZipFile, new: zipfile.ZipFile) -> None:
        for member in old.infolist():
            if "rows/c.0" in member.filename:
                new.writestr(member.filename, b"\0" * member.file_size)
            new.writestr(member.filename, old.read(member))

    rewritten(path, twice)
    assert "names a file twice" in " ".join(check_refused(path, recorded))


@pytest.mark.parametrize("way", ["compressed", "encrypted", "descriptor"])
def test_another_kind_of_zip_is_refused(path, recorded, way):
    def write(old: zipfile.ZipFile, new: zipfile.ZipFile) -> None:
        for member in old.infolist():
            kind = zipfile.ZIP_DEFLATED if way == "compressed" else zipfile.ZIP_STORED
            new.writestr(member.filename, old.read(member), kind)

    rewritten(path, write)
    if way != "compressed":
        whole = bytearray((path / FIRST).read_bytes())
        at = whole.find(b"PK\x01\x02")
        while at >= 0:
            (flags,) = struct.unpack_from("<H", whole, at + 8)
            struct.pack_into("<H", whole, at + 8, flags | (1 if way == "encrypted" else 8))
            at = whole.find(b"PK\x01\x02", at + 4)
        (path / FIRST).write_bytes(bytes(whole))
    assert "in another way than vla-attention copy --packed" in " ".join(check_refused(path, recorded))


def test_members_that_point_elsewhere_in_the_zip_are_refused(path, recorded):
    """Directory entries whose offsets changed places, or lead beyond the zip: what is found there is not sealed."""
    whole = (path / FIRST).read_bytes()
    entries, at = [], whole.find(b"PK\x01\x02")
    while at >= 0:
        entries.append(at)
        at = whole.find(b"PK\x01\x02", at + 4)
    for one, two in ((0, 1), (1, 2), (len(entries) - 1, 0)):
        changed = bytearray(whole)
        offsets = [whole[entries[i] + 42 : entries[i] + 46] for i in (one, two)]
        changed[entries[one] + 42 : entries[one] + 46] = offsets[1]
        changed[entries[two] + 42 : entries[two] + 46] = offsets[0]
        (path / FIRST).write_bytes(bytes(changed))
        check_refused(path, recorded, by_command=False)
    for offset in (0, 0x7FFFFFFF, 0xFFFFFFFF):
        changed = bytearray(whole)
        struct.pack_into("<I", changed, entries[1] + 42, offset)
        (path / FIRST).write_bytes(bytes(changed))
        check_refused(path, recorded, by_command=False)


def test_zips_of_other_episodes_and_other_stores_are_refused(path, other, recorded):
    whole = {name: (path / name).read_bytes() for name in (FIRST, SECOND)}
    (path / FIRST).write_bytes(whole[SECOND])
    check_refused(path, recorded)
    (path / SECOND).write_bytes(whole[FIRST])  # both changed places
    check_refused(path, recorded)
    (path / SECOND).write_bytes(whole[SECOND])
    (path / FIRST).write_bytes((other / FIRST).read_bytes())
    check_refused(path, recorded)


def test_an_index_that_gives_an_episode_the_zip_of_another_is_refused(path, recorded):
    whole = (path / INDEX_FILE).read_bytes()

    def exchange(index: dict[str, Any]) -> None:
        one, two = index["episodes"].values()
        index["episodes"] = dict(zip(index["episodes"], (two, one), strict=True))

    edit_index(path, exchange)
    said = " ".join(check_refused(path, recorded))
    assert f"the zip of task000_episode000 is {SECOND}; expected {FIRST}" in said
    # With the files exchanged, too, each entry names the zip that its episode must have.
    (path / INDEX_FILE).write_bytes(whole)
    (path / FIRST).rename(path / "aside")
    (path / SECOND).rename(path / FIRST)
    (path / "aside").rename(path / SECOND)

    def exchange_all_but_names(index: dict[str, Any]) -> None:
        one, two = index["episodes"].values()
        one["file"], two["file"] = two["file"], one["file"]
        exchange(index)

    edit_index(path, exchange_all_but_names)
    assert "its seal is that of task000_episode001" in " ".join(check_refused(path, recorded))


def test_an_index_of_another_store_of_the_same_run_is_refused(path, other, recorded):
    """Equal configurations: the runs' digests agree, and the seals do not."""
    assert open_store(path).run == open_store(other).run
    shutil.copyfile(other / INDEX_FILE, path / INDEX_FILE)
    check_refused(path, recorded)
    # With the sizes of this store's zips it gets as far as the seals.
    mine, theirs = (json.loads((store / INDEX_FILE).read_text())["episodes"] for store in (path, other))
    sizes = {name: (path / entry["file"]).stat().st_size for name, entry in mine.items()}
    assert set(mine) == set(theirs)
    shutil.copytree(path, path.parent / "c.zarr")
    copy_index = {name: {**theirs[name], "bytes": sizes[name], "tail": 0} for name in theirs}
    edit_index(path.parent / "c.zarr", lambda index: index.update(episodes=copy_index))
    said = check_refused(path.parent / "c.zarr", recorded)
    assert "holds another seal than the index.json" in " ".join(said)


def test_an_index_of_another_run_is_refused(path, tmp_path, recorded):
    folder = write_store(tmp_path / "folder.zarr", spec=replace(SPEC, suite="another"))
    copy_store(open_store(folder), tmp_path / "c.zarr", (), packed=True)
    shutil.copyfile(tmp_path / "c.zarr" / INDEX_FILE, path / INDEX_FILE)
    assert "belongs to a run of another configuration" in " ".join(check_refused(path, recorded))


@pytest.mark.parametrize(
    "content", [b"", b"{}", b"[]", b"null", b"\xff\xfe", b'{"format": "vla-attention-index"}', b"[" * 9999]
)
def test_an_index_that_is_none_is_refused(path, recorded, content):
    (path / INDEX_FILE).write_bytes(content)
    assert "index.json" in " ".join(check_refused(path, recorded, by_command=False))


@pytest.mark.parametrize(
    "entry",
    [
        {"file": "../../secret.zip"},
        {"file": "/etc/passwd"},
        {"file": ""},
        {"file": "zarr.json"},
        {"file": "episodes/mine.zip"},
        {"bytes": -1},
        {"bytes": 2**70},
        {"tail": -5},
        {"tail": 2**62},
        {"bytes": 2**50, "tail": 1},
        {"bytes": 2**50, "tail": 2**50 - 100},
        {"bytes": "7"},
        {"seal": "0" * 64},
        {"seal": ""},
        {"seal": "0" * 63},
        {"frame": ""},
        {"frame": "x" * 64},
        {"frame": None},
    ],
    ids=str,
)
def test_an_index_with_entries_that_cannot_be_is_refused(path, recorded, entry):
    document = json.loads((path / INDEX_FILE).read_text())
    document["episodes"]["task000_episode000"].update(entry)
    (path / INDEX_FILE).write_text(json.dumps(document | {"digest": seal_digest(document)}))
    check_refused(path, recorded, by_command=False)


@pytest.mark.parametrize("frame", ["", None])
def test_an_index_without_frames_hides_no_change_of_a_zip(path, recorded, frame):
    """The name of a file before its bytes, which the zip's directory repeats: only the frame is compared with it."""
    whole = (path / FIRST).read_bytes()
    at = whole.index(b"joint/rows/c.")
    (path / FIRST).write_bytes(whole[:at] + b"x" + whole[at + 1 :])
    assert analyze(["verify", str(path)]) == 1

    def forget(index: dict[str, Any]) -> None:
        for entry in index["episodes"].values():
            entry.pop("frame")
            if frame is not None:
                entry["frame"] = frame

    edit_index(path, forget)
    assert "its index.json is damaged" in " ".join(check_refused(path, recorded))


def test_a_root_nested_deeper_than_any_is_refused(path, recorded):
    (path / "zarr.json").write_bytes(b'{"zarr_format": 3, "node_type": "group", "attributes": ' + b"[" * 9999)
    assert "nested more than 64 deep" in " ".join(check_refused(path, recorded))


def test_a_changed_index_without_its_digest_is_refused(path, recorded):
    edit_index(path, lambda index: index["episodes"].pop("task000_episode001"), seal=False)
    assert "its own digest does not fit" in " ".join(check_refused(path, recorded))


def test_without_its_index_a_packed_store_is_refused(path, recorded):
    (path / INDEX_FILE).unlink()
    check_refused(path, recorded)


def test_a_copy_refuses_damage_and_packs_none_of_it(path, tmp_path, capsys):
    content = bytearray((path / SECOND).read_bytes())
    content[len(content) // 3] ^= 1
    (path / SECOND).write_bytes(bytes(content))
    assert analyze(["copy", str(path), str(tmp_path / "c.zarr"), "--packed"]) == 2
    assert "task000_episode001 is damaged" in capsys.readouterr().err
    assert [episode.name for episode in open_store(tmp_path / "c.zarr").episodes] == ["task000_episode000"]
    assert verify_store(open_store(tmp_path / "c.zarr")) == []


@pytest.mark.parametrize("bits", thorough_except((0x01,), (0x01, 0x80, 0xFF)))
def test_every_byte_of_a_zip_is_compared_by_verify(path, bits):
    """Names and dates before each file, by which nothing is read, too."""
    zip_file = path / FIRST
    whole = zip_file.read_bytes()
    with zipfile.ZipFile(zip_file) as found:
        headers = [one.header_offset for one in found.infolist()]
        directory = found.start_dir
    generator = np.random.default_rng(bits)
    places = {
        *(int(place) + int(generator.integers(30)) for place in generator.choice(headers, examples(8))),
        *generator.integers(directory, len(whole), examples(8)).tolist(),
    }
    for place in sorted(places):
        zip_file.write_bytes(whole[:place] + bytes([whole[place] ^ bits]) + whole[place + 1 :])
        assert {fault.where for fault in verify_store(open_store(path))} == {"task000_episode000"}, place
    zip_file.write_bytes(whole)
    assert verify_store(open_store(path)) == []


def without_second(path: Path) -> None:
    """An index that lacks a whole, sealed zip, with its right digest."""
    edit_index(path, lambda index: index["episodes"].pop("task000_episode001"))


@pytest.mark.parametrize("quick", [[], ["--quick"]])
def test_a_zip_that_the_index_lacks_is_a_fault_and_a_note(path, capsys, quick):
    """Numbers are those of fewer episodes, without a sign of damage in what is read."""
    without_second(path)
    assert analyze(["verify", str(path), *quick]) == 1
    said = capsys.readouterr()
    assert f"{path}: {SECOND}: index.json does not list it, so that nothing reads it. A copy that" in said.out
    assert "no part of the store" not in said.out
    assert "1 episode, 1 fault" in said.out
    assert said.err == ""
    assert analyze(["verify", str(path), "--json"]) == 1
    (report,) = json.loads(capsys.readouterr().out)
    assert (report["whole"], report["unchecked"], report["foreign"]) == (False, [], [])
    assert report["faults"][0]["where"] == SECOND
    for words in (["--list"], ["--no-plots", "--output", str(path.parent / "out")]):
        assert analyze([str(path), *words]) == 0
        said = capsys.readouterr()
        assert said.err.count(f"Left out of {path}: what its index.json does not list, {SECOND}. A copy that") == 1
    with pytest.warns(Note, match="Left out of"):
        assert len(open_store(path).episodes) == 1


def test_every_zip_that_the_index_lacks_is_named(path, folders, capsys):
    """Of another task, of an index without any episode, and the folder of an episode."""
    shutil.copytree(path / "episodes/task000_000", path / "episodes/task007_000")
    (path / "episodes/task007_000/task000_episode001.zip").rename(path / "episodes/task007_000/task007_episode001.zip")
    shutil.copytree(folders[0] / "episodes/task000_episode000", path / "episodes/task007_episode000")
    edit_index(path, lambda index: index["episodes"].clear())
    assert analyze(["verify", str(path)]) == 1
    said = capsys.readouterr().out.splitlines()
    assert [line.split(": ")[1] for line in said[:-1]] == [
        FIRST,
        SECOND,
        "episodes/task007_000/task000_episode000.zip",
        "episodes/task007_000/task007_episode001.zip",
        "episodes/task007_episode000",
    ]


def test_a_copy_lists_what_the_index_lacks(path, folders, recorded, capsys):
    without_second(path)
    assert analyze(["copy", str(folders[0]), str(path), "--packed"]) == 0
    assert wrong_or_refused(path, recorded) == []
    assert analyze(["verify", str(path)]) == 0
    assert "fault" not in capsys.readouterr().out
