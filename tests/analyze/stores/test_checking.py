"""Checking by workers finds what checking here finds."""

from __future__ import annotations

import pytest

from tests.kit.stores import write_store
from vla_attention.analyze.__main__ import main
from vla_attention.analyze.stores.parallel import episode_reports, workers
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.verify import verify_store


@pytest.fixture
def damaged(tmp_path):
    path = write_store(tmp_path / "a.zarr")
    (path / "episodes/task001_episode000/actions/zarr.json").write_text("{}", encoding="utf-8")
    return path


def test_workers_find_the_faults_that_verify_store_finds(damaged, capsys):
    store = open_store(damaged)
    expected = verify_store(store)
    assert {fault.where for fault in expected} == {"task001_episode000"}
    pairs = [(store, episode) for episode in store.episodes]
    assert [fault for report in episode_reports(pairs, "values") for fault in report.faults] == expected
    with workers(2):
        assert [fault for report in episode_reports(pairs, "values") for fault in report.faults] == expected


def test_what_was_read_of_an_episode_is_not_kept(damaged):
    store = open_store(damaged)
    assert len(list(episode_reports(((store, episode) for episode in store.episodes), "values"))) == 4
    assert all("seal" not in vars(episode) for episode in store.episodes)


@pytest.mark.thorough
def test_damaged_episodes_are_left_out_by_workers_too(damaged, tmp_path, capsys):
    printed = []
    for options in ([], ["--workers", "2"]):
        assert main(["store", "verify", str(damaged), *options]) == 1
        assert main([str(damaged), "--skip-corrupt", "--no-plots", "--output", str(tmp_path / "out"), *options]) == 0
        printed.append(capsys.readouterr().out)
    assert "1 fault" in printed[0] or "faults" in printed[0]
    assert printed[0] == printed[1]
