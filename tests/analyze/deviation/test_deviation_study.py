"""The deviation from a data set's actions, against loops over the raw arrays."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl
import pytest
import zarr

from tests.kit.questions import question_about
from tests.kit.site_stores import write_site_store
from vla_attention.analyze.__main__ import main as analyze
from vla_attention.analyze.deviation.deviation_study import study_deviation


@pytest.fixture(scope="module")
def store(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("stores")
    return write_site_store(folder / "a.zarr", protocol="dataset", dataset_actions=0.5, replans=6)


def raw(store: Path) -> dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Episode -> (actions, the data set's, how many of these there are)."""
    group = zarr.open_group(store, mode="r")["episodes"]
    return {
        name: (episode["actions"][:], episode["dataset_actions"][:], np.array(episode.attrs["dataset_action_count"]))
        for name, episode in group.groups()
    }


def spread_of(episodes: dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]) -> np.ndarray:
    steps = [chunk[:n] for _, data, counts in episodes.values() for chunk, n in zip(data, counts, strict=True)]
    return np.concatenate(steps).std(axis=0)


def test_replans_dimensions_and_phases_are_those_of_the_raw_arrays(store):
    study = study_deviation(question_about(store))
    episodes = raw(store)
    unit = spread_of(episodes)
    np.testing.assert_allclose(study.spread.spread, unit)
    first, of_dimension = [], []
    for name, (actions, data, counts) in episodes.items():
        rows = study.replans.filter(task_id=int(name[4:7]), episode_index=int(name[-3:]))
        for replan, row in enumerate(rows.iter_rows(named=True)):
            n = counts[replan]
            scaled = (actions[replan, :n] - data[replan, :n]) / unit
            assert row["steps"] == n
            assert row["first"] == pytest.approx(np.sqrt((scaled[0] ** 2).mean()))
            assert row["chunk"] == pytest.approx(np.sqrt((scaled**2).mean()))
        first.append(rows["first"].mean())
        of_dimension.append(np.sqrt((((actions[:, 0] - data[:, 0]) / unit) ** 2).mean(axis=0)))
    assert study.overall["first"] == pytest.approx(np.mean(first))
    assert study.overall["num_episodes"] == 6
    np.testing.assert_allclose(study.dimensions["first"].to_numpy(), np.mean(of_dimension, axis=0))
    thirds = study.phases.filter(pl.col("scope") == "all", pl.col("phase") != "all")
    # Six replans of five steps, the last as long as the others: two in each third.
    replans = study.replans.with_columns((pl.col("replan") // 2).alias("third"))
    expected = replans.group_by("third", maintain_order=True).agg(pl.col("chunk").mean())
    np.testing.assert_allclose(thirds["chunk"].to_numpy(), expected["chunk"].to_numpy())


@pytest.mark.thorough
def test_a_policy_of_the_mean_action_is_one_spread_away(tmp_path):
    path = write_site_store(tmp_path / "a.zarr", dataset_actions=1.0, episodes=8)
    study = study_deviation(question_about(path))
    # The data set's actions are the policy's and as much noise: the deviation is 1 of the noise, of a spread of sqrt 2.
    assert study.overall["chunk"] == pytest.approx(1 / np.sqrt(2), rel=0.1)


@pytest.mark.thorough
@pytest.mark.drawn
def test_the_command_and_the_section_of_the_report(store, tmp_path, capsys):
    assert analyze(["deviation", str(store), "--out", str(tmp_path)]) == 0
    printed = capsys.readouterr().out
    assert "standard deviations of the data set's actions away" in " ".join(printed.split())
    assert (tmp_path / "deviation.png").is_file()
    assert pl.read_parquet(tmp_path / "deviation_dimensions.parquet").height == 3
    assert analyze(["report", str(store), "--quick", "--out", str(tmp_path / "page")]) == 0
    assert "Against the data set" in (tmp_path / "page" / "report.html").read_text()
