"""The stores that come along are whole and small, and differ in what they should."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import polars as pl
import pytest

import vla_attention as va
from tests.kit.archives import example_store
from tests.kit.paths import ROOT
from vla_attention.analyze.__main__ import main as analyze
from vla_attention.example_stores import EXAMPLES, FOLDER
from vla_attention.example_stores.command import main
from vla_attention.schemas.stores import tar_files
from vla_attention.schemas.stores.tar_files import unpack

CUBES, ONE_COLOUR, NOISE = map(example_store, EXAMPLES)


@pytest.mark.parametrize("store", [CUBES, ONE_COLOUR, NOISE], ids=lambda path: path.stem)
def test_every_store_is_whole(store, capsys):
    assert analyze(["store", "verify", str(store)]) == 0


def test_they_are_small():
    assert sum(path.stat().st_size for path in FOLDER.glob("*.tar.xz")) < 2.5e6


def test_the_second_run_differs_in_its_weights_alone():
    cubes, one_colour = va.open(CUBES), va.open(ONE_COLOUR)
    assert cubes.attributes.policy.digest != one_colour.attributes.policy.digest
    assert cubes.attributes.protocol == one_colour.attributes.protocol
    assert cubes.compare(one_colour)["unpaired"].height == 0
    assert cubes.episodes["success"].all()
    assert one_colour.episodes.filter(success=True)["instruction"].unique().to_list() == ["touch the blue cube"]


def test_another_colour_changes_the_action_of_the_first_policy_alone():
    """To the second all colours are one word; without any it does something else, as the first does."""
    for store, least, most in ((CUBES, 6.0, 10.0), (ONE_COLOUR, 0.0, 1e-5)):
        effects = va.open(store).effects()["effects_items"]
        exchanged = effects.filter(item_kind="exchange")
        assert exchanged.height == 6
        assert exchanged["effect"].is_between(least, most).all()
        without = effects.filter(pl.col("item").is_in(["red", "green", "blue"]), kind="without")
        assert without["total"].is_between(4, 9).to_list() == [True] * 3


def test_the_rerun_is_of_the_first_store():
    rerun = va.open(NOISE)
    assert rerun.attributes.rerun_of.run == va.open(CUBES).stores[0].run
    assert rerun.attributes.interventions.noise is not None
    assert set(rerun.episodes.select("task_id", "episode_index").rows()) == {(0, 0), (1, 0), (2, 0)}


def test_no_store_names_a_place_of_the_machine_that_made_it():
    for file in (file for store in (CUBES, ONE_COLOUR, NOISE) for file in store.rglob("*") if file.is_file()):
        content = file.read_bytes()
        assert b"/tmp/" not in content, file
        assert str(ROOT).encode() not in content, file


def test_copies_are_readable_and_none_is_written_over(tmp_path, capsys):
    folder = tmp_path / "example"
    assert main([str(folder)]) == 0
    assert f"vla-attention analyze {folder / 'cubes.zarr'}" in capsys.readouterr().out
    columns = ["instruction", "success", "num_replans"]
    assert va.open(folder / "cubes.zarr").episodes[columns].equals(va.open(CUBES).episodes[columns])
    assert main([str(folder)]) == 2
    assert "cubes.zarr" in capsys.readouterr().err


def test_on_a_full_disk_there_is_no_part_of_a_store(tmp_path, monkeypatch, capsys):
    left = [2]

    def until_full(archive: Path, into: Path) -> None:
        left[0] -= 1
        unpack(archive, into)
        if not left[0]:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(tar_files, "unpack", until_full)
    assert main([str(tmp_path / "example")]) == 2
    assert "No space left" in capsys.readouterr().err
    assert list((tmp_path / "example").iterdir()) == []


def test_an_example_is_unpacked_once(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    store = va.example("cubes")
    assert store.is_relative_to(tmp_path)
    marker = store / "zarr.json"
    before = marker.stat().st_mtime_ns
    assert (va.example("cubes"), marker.stat().st_mtime_ns) == (store, before)
    with pytest.raises(va.UserError, match="cubes_one_colour"):
        va.example("cube")
