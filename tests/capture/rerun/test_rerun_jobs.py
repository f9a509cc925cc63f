"""Reruns are runs like others: processes share a store, `status` counts it, and SIGTERM drops one episode."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from vla_attention.capture.__main__ import main
from vla_attention.capture.jobs.worker_log import read_logs
from vla_attention.schemas.stop_signals import EXIT_TERMINATED, Terminated, Termination

EPISODES = ["task000_episode000", "task000_episode001", "task001_episode000", "task001_episode001"]


def names(store: Path) -> list[str]:
    return sorted(folder.name for folder in (store / "episodes").glob("task*"))


def status(store: Path, capsys: pytest.CaptureFixture[str]) -> dict:
    capsys.readouterr()
    main(["status", str(store), "--json"])
    [found] = json.loads(capsys.readouterr().out)
    return found


def test_sigterm_drops_the_episode_in_progress(pi_store, tmp_path, monkeypatch, capsys):
    store = tmp_path / "again.zarr"

    def check(termination: Termination) -> None:
        if any((store / "episodes").glob("task*")):
            raise Terminated

    monkeypatch.setattr(Termination, "check", check)
    assert main(["rerun", str(pi_store), "--output", str(store), "--check", "0"]) == EXIT_TERMINATED
    said = capsys.readouterr().out
    assert "SIGTERM" in said
    # Calls of the next episodes are made while the first one is written, and one that is being committed is whole.
    committed = names(store)
    assert committed == EPISODES[: len(committed)] != []
    assert f"; {4 - len(committed)} of this process's 4" in said
    assert read_logs(store)[-1].event == "stopped"
    monkeypatch.undo()
    assert main(["rerun", str(pi_store), "--output", str(store), "--check", "0", "--resume"]) == 0
    assert names(store) == EPISODES
