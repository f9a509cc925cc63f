"""Questions: the selection, and episodes that cannot be used."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import polars as pl
import pytest

from tests.kit.attacks import files_of
from tests.kit.questions import question_about
from vla_attention.analyze.__main__ import main
from vla_attention.analyze.ratios.analysis import analyse
from vla_attention.schemas.stores.reader import Store, open_store
from vla_attention.schemas.stores.store_format import StoreError
from vla_attention.testing.stores import reseal, write_store


def damage_rows(store: Path, episode: str) -> None:
    """Flip bits in the middle of an episode's rows."""
    (file,) = files_of(store / "episodes" / episode, "joint/rows")
    content = bytearray(file.read_bytes())
    content[len(content) // 3] ^= 0xFF
    file.write_bytes(bytes(content))


def without_replans(store: Store, position: int) -> Store:
    """The opened store, one of whose episodes says that it holds no replan. The writer makes no such episode."""
    episode = store.episodes[position]
    episode.__dict__["attributes"] = replace(episode.attributes, num_replans=0)
    return store


def test_a_damaged_episode_ends_the_analysis_with_its_name_and_a_way_out(tmp_path, capsys):
    path = write_store(tmp_path / "a.zarr")
    damage_rows(path, "task000_episode001")
    words = [str(path), "--group", "a=word:the", "--no-plots", "--output", str(tmp_path / "out")]
    assert main(words) == 2
    said = capsys.readouterr().err.strip()
    assert "task000_episode001" in said
    assert "--skip-corrupt" in said
    assert "vla-attention verify" in said
    assert "\n" not in said
    assert not (tmp_path / "out").exists()


def test_a_damaged_episode_is_left_out_by_name_when_asked(tmp_path, capsys):
    path = write_store(tmp_path / "a.zarr")
    whole = analyse(question_about(path)).episodes
    damage_rows(path, "task000_episode001")
    words = [str(path), "--no-plots", "--output", str(tmp_path / "out"), "--skip-corrupt"]
    assert main(words) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "task000_episode001 of" in printed
    assert "is left out" in printed
    expected = whole.filter(~((pl.col("task_id") == 0) & (pl.col("episode_index") == 1)))
    assert pl.read_parquet(tmp_path / "out" / "episodes.parquet").equals(expected.cells)
    assert pl.read_parquet(tmp_path / "out" / "episodes_groups.parquet").equals(expected.groups)


def test_when_every_episode_is_damaged_nothing_is_left_to_analyse(tmp_path, capsys):
    path = write_store(tmp_path / "a.zarr", tasks=(0,), episodes=2)
    for episode in ("task000_episode000", "task000_episode001"):
        damage_rows(path, episode)
    assert main([str(path), "--skip-corrupt", "--no-plots"]) == 2
    said = capsys.readouterr().err
    assert "None of the 2 selected episodes can be used" in said
    assert ". Capture them again." in said
    assert ".. " not in said


def test_an_episode_without_replans_is_named_and_left_out_only_when_asked(tmp_path):
    path = write_store(tmp_path / "a.zarr")
    with pytest.raises(StoreError, match=r"task000_episode001 of .* holds no replan.*--skip-corrupt"):
        question_about(without_replans(open_store(path), 1))
    question = question_about(without_replans(open_store(path), 1), skip_corrupt=True)
    assert [item.episode.name for item in question.selected] == [
        "task000_episode000",
        "task001_episode000",
        "task001_episode001",
    ]
    (line,) = question.skipped
    assert "task000_episode001" in line


def test_a_misspelt_command_is_no_store(capsys):
    assert main(["haeds", "a.zarr"]) == 2
    said = capsys.readouterr().err
    assert "Did you mean 'heads'" in said
    assert "compare" in said


def texts_of(folder: Path, capsys: pytest.CaptureFixture[str], *words: str) -> tuple[str, str]:
    """What is printed, and the line on denoise steps in the summary file."""
    assert main([*words, "--output", str(folder)]) == 0
    return " ".join(capsys.readouterr().out.split()), " ".join((folder / "summary.txt").read_text().split())


def test_results_of_one_denoise_step_say_so_wherever_they_go(tmp_path, capsys):
    path = str(write_store(tmp_path / "a.zarr"))
    folder = tmp_path / "out"
    only = "These numbers are of denoise step 0 (the first) of 10 only, as --denoise asks."
    printed, summary = texts_of(folder, capsys, path, "--denoise", "first", "--no-plots")
    assert only in printed
    assert only in summary
    results = json.loads((folder / "attention_ratio_results_made_up.json").read_text())
    assert [episode["denoise_steps"] for episode in results] == [[0]] * 4
    about = pl.read_parquet_metadata(folder / "tasks.parquet")
    assert about["mean_over"] == "denoise step 0 (the first) of 10"
    assert about["grouping"] == "default"
    for command in ("heads", "words", "time"):
        assert main([command, path, "--denoise", "first", "--no-plots", "--output", str(tmp_path / command)]) == 0
        assert only in " ".join(capsys.readouterr().out.split()), command
    printed, summary = texts_of(folder, capsys, path, "--no-plots")
    assert "These numbers are of" not in printed + summary
    assert json.loads((folder / "attention_ratio_results_made_up.json").read_text())[0]["denoise_steps"] == [0, 9]


def test_the_grouping_reference_says_which_denoise_step_the_published_numbers_are_of(tmp_path, capsys):
    path = str(write_store(tmp_path / "a.zarr"))
    words = (path, "--grouping", "reference", "--no-plots")
    printed, _ = texts_of(tmp_path / "out", capsys, *words)
    assert "are means over denoise steps 0, 9 of 10; those of the published scripts are of denoise step 0" in printed
    assert "compare with --denoise first" in printed
    alone = "are of denoise step 0 (the first) of 10 alone, as those of the published scripts"
    printed, _ = texts_of(tmp_path / "out", capsys, *words, "--denoise", "first")
    assert alone in printed


def test_layers_numbered_as_recorded_calls_say_which_denoise_step_the_published_ones_are_of(tmp_path, capsys):
    path = write_store(tmp_path / "a.zarr")  # 4 layers
    content = json.loads((path / "zarr.json").read_text())
    content["attributes"]["policy"]["family"] = "pi05"
    (path / "zarr.json").write_text(json.dumps(content))
    for folder in (path / "episodes").glob("task*"):
        reseal(folder)
    words = (str(path), "--layers", "4", "6", "--no-plots")
    printed, _ = texts_of(tmp_path / "out", capsys, *words)
    assert "those of the published scripts are of denoise step 0 alone: compare with --denoise first" in printed
    printed, _ = texts_of(tmp_path / "out", capsys, *words, "--denoise", "first")
    assert "are of denoise step 0 (the first) of 10 alone, as those of the published scripts" in printed
    printed, _ = texts_of(tmp_path / "out", capsys, str(path), "--layers", "0", "2", "--no-plots")
    assert "published scripts are of" not in printed
