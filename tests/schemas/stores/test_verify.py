"""Every kind of damage is reported with the episode's and the file's or array's name, and never becomes a number."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.kit.attacks import files_of, with_checksum
from tests.kit.examples import examples
from tests.kit.stores import StoreSpec, reseal, small_steps, write_store
from tests.kit.thorough import thorough_except
from vla_attention.analyze.__main__ import main
from vla_attention.schemas.stores.reader import StoredEpisode, open_store
from vla_attention.schemas.stores.store_format import CorruptEpisode
from vla_attention.schemas.stores.verify import Fault, verify_store

SPEC = StoreSpec(tasks=(0, 1), episodes=1, replans=3, heads=(0,), plant_steps=small_steps)
EPISODE = "task000_episode000"
ARRAYS = (
    "joint/rows",
    "joint/atoms",
    "joint/key_role",
    "frames/base_0_rgb",
    "objects/left_wrist_0_rgb",
    "state",
    "actions",
    "steps/poses",
    "steps/gripper",
    "steps/actions",
)
#: Those that the fast part of the suite damages.
FEW_ARRAYS = ("joint/rows", "joint/key_role", "frames/base_0_rgb", "state")
FEW_METADATA = ("zarr.json", "seal/zarr.json", "joint/rows/zarr.json", "state/zarr.json")
METADATA = (
    "zarr.json",
    "joint/zarr.json",
    "frames/zarr.json",
    "steps/zarr.json",
    "seal/zarr.json",
    *(f"{name}/zarr.json" for name in ARRAYS),
)


@pytest.fixture(scope="module")
def original(tmp_path_factory) -> Path:
    return write_store(tmp_path_factory.mktemp("original") / "a.zarr", spec=SPEC)


@pytest.fixture
def path(original, tmp_path) -> Path:
    copy = tmp_path / "a.zarr"
    shutil.copytree(original, copy)
    return copy


def faults(path: Path) -> list[Fault]:
    found = verify_store(open_store(path))
    assert all("\n" not in fault.problem for fault in found)
    return found


def only_fault_of(path: Path) -> str:
    """All problems of the damaged episode, in one text; the other episode must be whole."""
    found = faults(path)
    assert found, "the damage was not noticed"
    assert {fault.where for fault in found} == {EPISODE}
    return " | ".join(fault.problem for fault in found)


def chunk_file(path: Path, array: str, episode: str = EPISODE) -> Path:
    (file,) = files_of(path / "episodes" / episode, array)
    return file


def flip(file: Path, position: int, bits: int = 1) -> None:
    content = bytearray(file.read_bytes())
    content[position % len(content)] ^= bits
    file.write_bytes(content)


def check_unreadable(path: Path, array: str) -> None:
    with pytest.raises(CorruptEpisode, match=EPISODE):
        open_store(path).episodes[0].read(array)


def test_a_whole_store_has_no_faults(original):
    assert faults(original) == []


@pytest.mark.parametrize("array", thorough_except(FEW_ARRAYS, ARRAYS))
def test_a_flipped_byte_in_a_chunk(path, array):
    file = chunk_file(path, array)
    content = file.read_bytes()
    for position in (17, -1):
        file.write_bytes(content)
        flip(file, position)
        assert array in only_fault_of(path)
        check_unreadable(path, array)


@pytest.mark.parametrize("array", thorough_except(FEW_ARRAYS, ARRAYS))
def test_a_truncated_chunk(path, array):
    file = chunk_file(path, array)
    content = file.read_bytes()
    for keep in (0, 10, len(content) - 1):
        file.write_bytes(content[:keep])
        assert array in only_fault_of(path)
        check_unreadable(path, array)


@pytest.mark.parametrize("array", thorough_except(FEW_ARRAYS, ARRAYS))
def test_a_deleted_chunk(path, array):
    chunk_file(path, array).unlink()
    assert re.search(rf"{array} .*{EPISODE} .*{array}/c\.0", only_fault_of(path))
    check_unreadable(path, array)


@pytest.mark.parametrize(
    "array",
    [
        "joint/rows",
        "joint/atoms",
        "joint/key_role",
        "frames/base_0_rgb",
        "objects/base_0_rgb",
        "state",
        "actions",
    ],
)
def test_arrays_of_two_episodes_changed_places(path, array):
    first, second = (path / "episodes" / name / array for name in (EPISODE, "task001_episode000"))
    first.rename(path / "aside")
    second.rename(first)
    (path / "aside").rename(second)
    found = faults(path)
    assert {fault.where for fault in found} == {EPISODE, "task001_episode000"}
    for name in (EPISODE, "task001_episode000"):
        assert array in " | ".join(fault.problem for fault in found if fault.where == name)


def test_episodes_changed_places(path):
    first, second = path / "episodes" / EPISODE, path / "episodes" / "task001_episode000"
    first.rename(path / "aside")
    second.rename(first)
    (path / "aside").rename(second)
    for fault, other in zip(faults(path), ("task001_episode000", EPISODE), strict=True):
        assert re.search(f"{fault.where} .*{other}", fault.problem)


def test_an_episode_of_another_run(path, tmp_path):
    other = write_store(tmp_path / "other.zarr", spec=SPEC, policy="another")
    shutil.rmtree(path / "episodes" / EPISODE)
    shutil.copytree(other / "episodes" / EPISODE, path / "episodes" / EPISODE)
    assert EPISODE in only_fault_of(path)


@pytest.mark.parametrize("file", thorough_except(FEW_METADATA, METADATA))
def test_every_changed_byte_of_metadata_is_noticed(path, file):
    target = path / "episodes" / EPISODE / file
    content = target.read_bytes()
    generator = np.random.default_rng(len(content))
    for position in generator.integers(0, len(content), 2):
        changed = bytearray(content)
        changed[position] ^= 1 << generator.integers(7)
        target.write_bytes(changed)
        if file.startswith("seal/") and same_json(content, bytes(changed)):
            continue  # white space of the seal itself: nothing says anything else than before
        assert Path(file).parent.name in only_fault_of(path)


def same_json(one: bytes, other: bytes) -> bool:
    try:
        return json.loads(one) == json.loads(other)
    except ValueError:
        return False


def test_a_changed_run(path):
    root = path / "zarr.json"
    root.write_text(root.read_text().replace('"made-up"', '"made up"'))
    found = faults(path)
    assert [fault.where for fault in found] == ["zarr.json", EPISODE, "task001_episode000"]


def test_damaged_attributes_are_named_and_read_from_the_seal(path):
    file = path / "episodes" / EPISODE / "zarr.json"
    instruction = open_store(path).episodes[0].attributes.instruction
    file.write_text(file.read_text().replace("bowl", "bowk"))
    store = open_store(path)
    assert store.episodes[0].attributes.instruction == instruction
    assert re.search(rf"{EPISODE} .*zarr\.json", verify_store(store)[0].problem)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda attributes: attributes.update(num_replans=4), r"\(3, 2, 2, 1, 1, 39\).* \(4, "),
        (lambda attributes: attributes["prompts"].pop(), "prompt_index"),
        (lambda attributes: attributes["arrays"].update({"../../a": {"shape": [1], "sha256": ""}}), r"\.\./\.\./a"),
        (lambda attributes: attributes["noise_seed"].pop(), r"noise_seed .*\(2,\).* \(3,\)"),
        (lambda attributes: attributes["env_step"].reverse(), "env_step .*15 .*20"),
    ],
)
def test_attributes_that_contradict_the_arrays(path, change, named):
    """Changed and sealed anew, as somebody might who knows the format."""
    folder = path / "episodes" / EPISODE
    document = json.loads((folder / "zarr.json").read_text())
    change(document["attributes"])
    (folder / "zarr.json").write_text(json.dumps(document))
    reseal(folder)
    assert re.search(named, only_fault_of(path))


@pytest.fixture(scope="module")
def victim(original, tmp_path_factory) -> tuple[StoredEpisode, Path, dict[str, np.ndarray]]:
    """A copy to damage and repair, and what it holds."""
    copy = tmp_path_factory.mktemp("victim") / "a.zarr"
    shutil.copytree(original, copy)
    episode = open_store(copy).episodes[0]
    return episode, copy, {name: episode.read(name) for name in episode.attributes.arrays}


@settings(max_examples=examples(15), deadline=None)
@given(data=st.data())
def test_a_random_bit_flip_is_noticed_or_changes_nothing(victim, data):
    _, path, values = victim
    array = data.draw(st.sampled_from(sorted(values)))
    file = chunk_file(path, array)
    content = file.read_bytes()
    bit = data.draw(st.integers(0, 8 * len(content) - 1))
    try:
        flip(file, bit // 8, 1 << bit % 8)
        if EPISODE not in {fault.where for fault in faults(path)}:
            assert (open_store(path).episodes[0].read(array) == values[array]).all()
    finally:
        file.write_bytes(content)


def test_the_command_line_says_it_and_fails(path, capsys):
    for depth in ((), ("--quick",), ("--values",)):
        assert main(["store", "verify", str(path), *depth]) == 0
        assert "2 episodes" in capsys.readouterr().out
    flip(chunk_file(path, "joint/rows"), 30)
    assert main(["store", "verify", str(path)]) == 1
    output = capsys.readouterr().out
    assert re.search(f"{EPISODE}: .*joint/rows", output)
    assert "Traceback" not in output
    assert main(["store", "verify", str(path.with_name("b.zarr"))]) == 2
    assert "a.zarr" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("change", "where"),
    [
        (lambda path: (path / "episodes/zarr.json").unlink(), "episodes/zarr.json"),
        (
            lambda path: edit_json(
                path / "episodes/zarr.json", lambda group: group.update(attriButes=group.pop("attributes"))
            ),
            "episodes/zarr.json",
        ),
        (
            lambda path: edit_json(path / "episodes/zarr.json", lambda group: group["attributes"].update(a=1)),
            "episodes/zarr.json",
        ),
        (
            lambda path: edit_json(
                path / "zarr.json", lambda group: group["attributes"]["provenance"].update(numpy="1")
            ),
            "zarr.json",
        ),
        (lambda path: edit_json(path / "zarr.json", lambda group: group["attributes"].pop("digest")), "zarr.json"),
    ],
)
@pytest.mark.parametrize("quick", [False, True])
def test_the_files_beside_the_episodes_are_checked(path, change, where, quick):
    change(path)
    (fault,) = verify_store(open_store(path), "quick" if quick else "values")
    assert fault.where == where


def edit_json(file: Path, change) -> None:
    document = json.loads(file.read_text())
    change(document)
    file.write_text(json.dumps(document))


def test_bytes_of_a_shard_that_are_in_no_chunk_are_compared_too(path):
    """A shard with room between its chunks: nothing reads it, and it is a changed file all the same."""
    folder = path / "episodes" / EPISODE
    file = chunk_file(path, "joint/rows")
    content = file.read_bytes()
    size = 16 * 4 + 4
    index = np.frombuffer(content[-size:-4], dtype="<u8").reshape(-1, 2).copy()
    index[:, 0] += 8
    file.write_bytes(b"\0" * 8 + content[:-size] + with_checksum(index.tobytes()))
    reseal(folder)
    assert faults(path) == []
    flip(file, 3)
    assert "joint/rows/c.0.0.0.0.0.0" in only_fault_of(path)
