"""Questions: the selection, and episodes that cannot be used."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import polars as pl
import pytest

from tests.kit.attacks import files_of
from tests.kit.questions import question_about, with_attributes
from tests.kit.stores import write_store
from vla_attention.analyze.__main__ import main
from vla_attention.analyze.commands.analyze import analyze
from vla_attention.schemas.stores.reader import Store, open_store
from vla_attention.schemas.stores.store_format import StoreError


def damage_rows(store: Path, episode: str) -> None:
    """Flip bits in the middle of an episode's rows."""
    (file,) = files_of(store / "episodes" / episode, "joint/rows")
    content = bytearray(file.read_bytes())
    content[len(content) // 3] ^= 0xFF
    file.write_bytes(bytes(content))


def without_replans(store: Store, position: int) -> Store:
    """The opened store, one of whose episodes says that it holds no replan. The writer makes no such episode."""
    empty = with_attributes(store.episodes[position], num_replans=0)
    return replace(store, episodes=(*store.episodes[:position], empty, *store.episodes[position + 1 :]))


def test_a_damaged_episode_ends_the_analysis_with_its_name_and_a_way_out(tmp_path, capsys):
    path = write_store(tmp_path / "a.zarr")
    damage_rows(path, "task000_episode001")
    words = [str(path), "--group", "a=word:the", "--no-plots", "--output", str(tmp_path / "out")]
    assert main(words) == 2
    said = capsys.readouterr().err.strip()
    assert "task000_episode001" in said
    assert "--skip-corrupt" in said
    assert "vla-attention store verify" in said
    assert "\n" not in said
    assert not (tmp_path / "out").exists()


def test_a_damaged_episode_is_left_out_by_name_when_asked(tmp_path, capsys):
    path = write_store(tmp_path / "a.zarr")
    whole = analyze(question_about(path))
    damage_rows(path, "task000_episode001")
    words = [str(path), "--no-plots", "--output", str(tmp_path / "out"), "--skip-corrupt"]
    assert main(words) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "task000_episode001" in printed
    left = ~((pl.col("task_id") == 0) & (pl.col("episode_index") == 1))
    for name in ("episodes", "episodes_groups"):
        assert pl.read_parquet(tmp_path / "out" / f"{name}.parquet").equals(whole[name].filter(left))


def test_an_episode_without_replans_is_named_and_left_out_only_when_asked(tmp_path):
    path = write_store(tmp_path / "a.zarr")
    with pytest.raises(StoreError, match=r"task000_episode001 .*--skip-corrupt"):
        question_about(without_replans(open_store(path), 1))
    question = question_about(without_replans(open_store(path), 1), skip_corrupt=True)
    assert [item.episode.name for item in question.selected] == [
        "task000_episode000",
        "task001_episode000",
        "task001_episode001",
    ]
    (line,) = question.skipped
    assert "task000_episode001" in line
