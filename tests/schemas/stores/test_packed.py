"""Damage to a packed store, by accident or on purpose, gives a sentence and never a number that was not recorded."""

from __future__ import annotations

import json
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.kit.stores import StoreSpec, write_store
from vla_attention.analyze.__main__ import main as analyze
from vla_attention.analyze.store.copying import copy_store
from vla_attention.analyze.store.packing import write_zip
from vla_attention.schemas.errors import UserError
from vla_attention.schemas.stores.digest import seal_digest
from vla_attention.schemas.stores.packed_index import INDEX_FILE
from vla_attention.schemas.stores.reader import open_store

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
        assert analyze(["store", "verify", str(path)]) in (1, 2)
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


def test_a_zip_that_was_cut_off_or_has_grown_is_refused(path, recorded):
    zip_file = path / FIRST
    whole = zip_file.read_bytes()
    for length in (0, 1, 21, 22, len(whole) // 2, len(whole) - 1):
        zip_file.write_bytes(whole[:length])
        check_refused(path, recorded, by_command=length in (0, len(whole) - 1))
    for more in (b"\0", whole):
        zip_file.write_bytes(whole + more)
        assert "has not the" in " ".join(check_refused(path, recorded, by_command=False))


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
        lambda folder: (folder / "joint/rows/c.0.0.0.0.0.0").unlink(),
        lambda folder: shutil.rmtree(folder / "seal"),
        lambda folder: (folder / "joint/rows/zarr.json").write_text("{}"),
    ],
    ids=["swapped", "lost", "no seal", "metadata"],
)
def test_members_that_were_swapped_renamed_or_removed_are_refused(path, recorded, change):
    packed_again(path, FIRST, change)
    check_refused(path, recorded, by_command=False)
    assert analyze(["store", "verify", str(path)]) == 1


def test_zips_of_other_episodes_and_other_stores_are_refused(path, other, recorded):
    whole = {name: (path / name).read_bytes() for name in (FIRST, SECOND)}
    (path / FIRST).write_bytes(whole[SECOND])
    check_refused(path, recorded)
    (path / SECOND).write_bytes(whole[FIRST])  # both changed places
    check_refused(path, recorded)
    (path / SECOND).write_bytes(whole[SECOND])
    (path / FIRST).write_bytes((other / FIRST).read_bytes())
    check_refused(path, recorded)
