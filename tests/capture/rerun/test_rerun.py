"""Stored policy calls, made again without a simulator: bit-equal, into a store like any other, and what is refused."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace

import numpy as np
import pytest
from msgspec import structs

from tests.kit.spoiled_policy import spoil_actions
from vla_attention.capture.__main__ import main
from vla_attention.capture.engine.call import Caller
from vla_attention.capture.policies.pi.embedded import dummy_policy
from vla_attention.capture.rerun.fidelity import InputsDiffer, check_fidelity
from vla_attention.capture.rerun.stored_calls import read_calls
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.verify import verify_store


def refused(capsys: pytest.CaptureFixture[str], *words: object) -> str:
    """The sentence with which a command ends; exit code 2."""
    try:
        code = main([str(word) for word in words])
    except SystemExit as end:
        code = end.code
    said = capsys.readouterr().err
    assert code == 2, said
    assert said.count("\n") == 1, said
    return said


@pytest.mark.parametrize("family", ["pi", "cosmos"])
def test_a_store_is_made_again_to_the_bit(family, request, tmp_path, capsys):
    """All arrays have the same values; the new store names its base, and a second run finds it complete."""
    base_path, again_path = request.getfixturevalue(f"{family}_store"), tmp_path / "again.zarr"
    assert main(["rerun", str(base_path), "--output", str(again_path)]) == 0
    assert re.search("bit-equal, .*10 bits", capsys.readouterr().out)
    base, again = open_store(base_path), open_store(again_path)
    assert verify_store(again) == []
    assert again.attributes.rerun_of.run == base.run
    assert again.attributes.rerun_of.name == base_path.name
    assert again.attributes.interventions.is_none
    assert again.attributes.policy == base.attributes.policy
    assert again.attributes.recording == base.attributes.recording
    assert [episode.name for episode in again.episodes] == [episode.name for episode in base.episodes]
    for old, new in zip(base.episodes, again.episodes, strict=True):
        assert new.attributes.arrays == old.attributes.arrays  # shapes and digests of all values
        mine, its = (structs.replace(one.attributes, provenance={}, plumbing=None) for one in (new, old))
        assert mine == its
        assert new.attributes.steps is not None
        assert new.attributes.steps.touched == ("cube",)
        np.testing.assert_array_equal(new.read("steps/actions")[:4], old.read("actions")[0, :4].astype(np.float32))
    assert [episode.attributes.task_family for episode in again.episodes] == 2 * ["lift A"] + 2 * ["stack A on B"]
    assert main(["rerun", str(base_path), "--output", str(again_path), "--resume", "--check", "0"]) == 0
    assert re.search("4 of 4 .* 0 to run", capsys.readouterr().out)


def test_more_of_the_same_calls_can_be_recorded(pi_store, tmp_path):
    """Rows of all queries and denoise steps; their means are those of the store. A half-finished rerun goes on."""
    target = tmp_path / "more.zarr"
    arguments = ["rerun", str(pi_store), "--output", str(target), "--check", "1", "--layers", "2", "--queries", "all"]
    arguments += ["--denoise", "all", "--no-contributions", "--precision", "exact", "--task-id", "1"]
    assert main([*arguments, "--num-episodes", "1"]) == 0
    assert main([*arguments, "--resume"]) == 0
    base, more = open_store(pi_store), open_store(target)
    assert [episode.name for episode in more.episodes] == ["task001_episode000", "task001_episode001"]
    stored = base.episodes[2].read("joint/rows")[:, 2, 0]
    again = more.episodes[0].read("joint/rows")
    assert again.shape[1:3] == (1, 3)
    np.testing.assert_allclose(again[:, 0, 0].mean(axis=2, keepdims=True), stored, rtol=2**-10, atol=1e-9)
    np.testing.assert_array_equal(more.episodes[0].read("actions"), base.episodes[2].read("actions"))


def test_another_result_is_measured_and_the_machines_are_compared(pi_store):
    base = open_store(pi_store)
    calls, policy = read_calls(base.episodes[0]), dummy_policy()
    recording = base.attributes.recording
    machine = {**base.episodes[0].attributes.provenance, "torch": "0.1", "device": "an abacus"}
    caller = Caller(policy, recording)
    same = check_fidelity(caller, recording, calls, 2, machine)
    assert same.bit_equal
    moved = replace(calls, actions=calls.actions + np.array([0, 0.5, 0, 0, 0, 0, 0]))
    result = check_fidelity(caller, recording, moved, 2, machine)
    assert not result.bit_equal
    assert result.actions == pytest.approx(0.5)
    assert result.actions_relative == pytest.approx(0.5 / calls.actions[..., 1].std())
    assert result.rows == 0
    assert re.search(r"NOT bit-equal.* 0\.5 ", result.describe())


def test_another_state_than_the_prompts_is_an_error(pi_store):
    """The tiny policy writes its state into the prompt."""
    base = open_store(pi_store)
    calls = read_calls(base.episodes[0])
    moved = replace(calls, state=calls.state + 0.5)
    with pytest.raises(InputsDiffer, match=r"Replan 0 of task000_episode000 .*'Task: lift the red cube"):
        check_fidelity(Caller(dummy_policy(), base.attributes.recording), base.attributes.recording, moved, 1, {})


def test_wrong_stores_and_settings_are_named_in_one_line(pi_store, tmp_path, capsys):
    assert "nothing.zarr" in refused(capsys, "rerun", tmp_path / "nothing.zarr", "--checkpoint", "untrained-tiny")
    assert "itself" in refused(capsys, "rerun", pi_store, "--output", pi_store, "--overwrite")
    assert re.search("task 7; .* 0, 1", refused(capsys, "rerun", pi_store, "--task-id", "7"))
    assert "digest" in refused(capsys, "rerun", pi_store, "--checkpoint", "untrained")


def test_a_damaged_episode_is_refused(pi_store, tmp_path, capsys):
    damaged = tmp_path / "damaged.zarr"
    shutil.copytree(pi_store, damaged)
    (damaged / "episodes/task001_episode000/state/zarr.json").unlink()
    said = refused(capsys, "rerun", damaged)
    assert "task001_episode000" in said
    assert "vla-attention capture verify --repair" in said
    # Bytes that were changed are found when they are read.
    frame = next((damaged / "episodes/task000_episode000/frames").rglob("c.*"))
    while frame.is_dir():
        frame = next(frame.iterdir())
    content = bytearray(frame.read_bytes())
    content[len(content) // 2] ^= 1
    frame.write_bytes(bytes(content))
    said = refused(capsys, "rerun", damaged, "--task-id", "0")
    assert "frames" in said
    assert "task000_episode000" in said


@pytest.mark.parametrize(("times", "missing"), [(1, []), (100, ["task000_episode001"])])
def test_a_call_that_turns_nan_costs_its_episode(pi_store, tmp_path, capsys, monkeypatch, times, missing):
    left, target = spoil_actions(monkeypatch, 7, 0, 1, times=times), tmp_path / "again.zarr"
    words = ["rerun", str(pi_store), "--output", str(target), "--check", "0"]
    assert main(words) == (2 if missing else 0)
    assert left[0] < times
    said = capsys.readouterr()
    assert re.search("task000_episode001: .* replan 1", said.out)
    assert ("begins again" in said.out) is (times == 1)
    if missing:
        assert re.search(rf"\b1 of .*: task000_episode001 of {target}\. ", said.err)
        assert said.err.count("\n") == 1
    assert len(open_store(target).episodes) == 4 - len(missing)
    monkeypatch.undo()
    assert main([*words, "--resume"]) == 0
    assert len(open_store(target).episodes) == 4
    assert verify_store(open_store(target)) == []


def test_an_existing_store_is_not_overwritten_by_chance(pi_store, tmp_path, capsys):
    target = tmp_path / "again.zarr"
    arguments = ("rerun", pi_store, "--output", target, "--check", "0", "--num-episodes", "1")
    assert main([str(word) for word in arguments]) == 0
    assert "--resume" in refused(capsys, *arguments)
    assert "recording.layers" in refused(capsys, *arguments, "--resume", "--layers", "1")
    assert main([str(word) for word in (*arguments, "--overwrite", "--layers", "1")]) == 0
    assert json.loads((target / "zarr.json").read_text())["attributes"]["recording"]["layers"] == [1]
