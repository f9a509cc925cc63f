"""Outcomes that are told after the recording: which are taken, who sees them, and that copies keep them."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import vla_attention as va
from tests.kit.stores import StoreSpec, write_store
from vla_attention.analyze.__main__ import main as analyze
from vla_attention.analyze.store.copying import copy_store, open_source
from vla_attention.analyze.store.outcomes import tell_outcomes
from vla_attention.capture.jobs.status import store_status
from vla_attention.schemas.stores.outcomes import OUTCOMES_FILE
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.store_format import RunMismatch, StoreError
from vla_attention.schemas.stores.verify import verify_store

SPEC = StoreSpec(
    tasks=(0, 1), episodes=2, replans=2, layers=(0,), heads=(0,), contributions=False,
    plant_success=lambda task, episode: True if (task, episode) == (1, 1) else None,
)  # fmt: skip
HEAD = "task_id,episode_index,success\n"
TOLD = HEAD + "0,0,1\n0,1,false\n"
#: By task and episode: as recorded, and with `TOLD`.
RECORDED, LATER = [None, None, None, True], [True, False, None, True]


def other_actions(task, episode, replans):
    return np.full((replans, 5, 7), 0.5)


@pytest.fixture
def path(tmp_path) -> Path:
    return write_store(tmp_path / "a.zarr", spec=SPEC)


def table(folder: Path, text: str) -> Path:
    (folder / "told.csv").write_text(text)
    return folder / "told.csv"


def outcomes(place: Path) -> list[bool | None]:
    return [episode.attributes.success for episode in open_store(place).episodes]


def analyzed(place: Path) -> list[bool | None]:
    return va.open(place).analyze()["episodes"].filter(layer="layers_avg")["success"].to_list()


def test_what_was_told_is_used_by_readers_and_can_be_taken_back(path, tmp_path, capsys):
    assert analyzed(path) == RECORDED  # and remembers what it measured
    sealed = {file: file.read_bytes() for file in path.rglob("*") if file.is_file()}
    assert analyze(["store", "outcomes", str(path), str(table(tmp_path, TOLD))]) == 0
    assert outcomes(path) == LATER
    assert analyzed(path) == LATER
    assert {file: file.read_bytes() for file in sealed} == sealed
    assert verify_store(open_store(path)) == []
    status = store_status(path)
    assert [(task.success, task.unknown) for task in status.tasks] == [(1, 0), (1, 1)]
    assert status.told_later == 2
    # Told again with one more: what is known to be so is no contradiction.
    assert tell_outcomes(path, table(tmp_path, TOLD + "1,0,0\n1,1,1\n")).added == 1
    assert outcomes(path) == [True, False, False, True]
    assert analyze(["store", "outcomes", str(path), "--remove"]) == 0
    assert outcomes(path) == RECORDED
    assert analyze(["store", "outcomes", str(path), "--remove"]) == 2


@pytest.mark.parametrize(
    "text",
    [
        HEAD + "0,0,1\n7,0,1\n",  # no such episode
        HEAD + "0,0,1\n0,0,1\n",  # twice
        HEAD + "1,1,0\n",  # recorded as solved
        HEAD + "0,0,maybe\n",
        HEAD + "0,-1,1\n",
        HEAD + "0,0\n",
        HEAD + "0,0,1,1\n",
        HEAD + "0" * 5000 + "1,0,1\n",
        "task_id,episode_index,success,success\n0,0,1,0\n",
        HEAD,
        "task,episode,success\n0,0,1\n",
        "",
    ],
)
def test_a_file_of_which_one_row_cannot_be_taken_changes_nothing(path, tmp_path, text, capsys):
    assert analyze(["store", "outcomes", str(path), str(table(tmp_path, text))]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert outcomes(path) == RECORDED
    assert not (path / OUTCOMES_FILE).exists()


def test_what_was_told_first_is_not_contradicted_by_a_second_file(path, tmp_path):
    tell_outcomes(path, table(tmp_path, TOLD))
    with pytest.raises(va.UserError, match="task000_episode001"):
        tell_outcomes(path, table(tmp_path, HEAD + "0,1,1\n"))
    assert outcomes(path) == LATER


def test_copies_tar_files_and_merged_stores_keep_what_was_told(path, tmp_path):
    tell_outcomes(path, table(tmp_path, TOLD))
    slim, tars, back, both = (tmp_path / f"{name}.zarr" for name in ("slim", "tars", "back", "both"))
    copy_store(open_store(path), slim, ["frames"])
    copy_store(open_store(path), tars, [], tar=True)
    copy_store(open_source(tars), back, [])
    assert [outcomes(place) for place in (slim, back)] == [LATER] * 2
    other = write_store(tmp_path / "b.zarr", spec=replace(SPEC, tasks=(2,)))
    tell_outcomes(other, table(tmp_path, HEAD + "2,1,1\n"))
    assert analyze(["store", "copy", str(path), str(other), "--output", str(both)]) == 0
    assert outcomes(both) == [*LATER, None, True]
    analyze(["store", "outcomes", str(path), "--remove"])
    copy_store(open_store(path), slim, ["frames"])  # what a copy was told stays with it
    assert outcomes(slim) == LATER
    tell_outcomes(path, table(tmp_path, HEAD + "0,1,1\n"))
    with pytest.raises(RunMismatch, match="task000_episode001"):
        copy_store(open_store(path), slim, ["frames"])


def test_an_episode_that_is_recorded_again_has_not_the_outcome_of_the_first(path, tmp_path):
    tell_outcomes(path, table(tmp_path, TOLD))
    again = write_store(tmp_path / "again.zarr", spec=replace(SPEC, plant_actions=other_actions))
    episode = path / "episodes" / "task000_episode000"
    shutil.rmtree(episode)
    shutil.copytree(again / "episodes" / "task000_episode000", episode)
    with pytest.warns(match="task000_episode000"):
        assert outcomes(path) == [None, False, None, True]


def test_a_damaged_file_of_outcomes_is_refused(path, tmp_path, capsys):
    tell_outcomes(path, table(tmp_path, TOLD))
    document = json.loads((path / OUTCOMES_FILE).read_text())
    document["outcomes"]["task000_episode001"]["success"] = True
    for content in (json.dumps(document), "", "[]"):
        (path / OUTCOMES_FILE).write_text(content)
        with pytest.raises(StoreError, match=OUTCOMES_FILE):
            open_store(path)
        # The episodes are whole, and what closes the store can be taken away.
        assert analyze(["store", "verify", str(path), "--quick"]) == 1
        assert OUTCOMES_FILE in capsys.readouterr().out
        assert [fault.where for fault in verify_store(open_store(path, as_recorded=True))] == [OUTCOMES_FILE]
    assert analyze(["store", "outcomes", str(path), "--remove"]) == 0
    assert analyze(["store", "verify", str(path), "--quick"]) == 0
