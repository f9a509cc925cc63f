"""`vla-attention capture doctor` on this machine: what it finds, what it misses, and which policies it accepts."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from vla_attention.capture.__main__ import main as capture
from vla_attention.capture.environments.libero_installation import ASSETS_VARIABLE
from vla_attention.testing.stores import write_store

pytestmark = pytest.mark.simulator


def lines_of(said: str) -> dict[str, tuple[str, str]]:
    """What was looked at -> (status, the rest of the line)."""
    found = re.findall(r"^(ok|note|MISSING) +(\w+) +(.*)$", said, re.MULTILINE)
    return {what: (status, text) for status, what, text in found}


def test_the_run_of_the_policy_that_comes_along(tmp_path, capfd):
    store = tmp_path / "a.zarr"
    options = ["--task-id", "0", "3", "--num-episodes", "4", "--max-steps", "50", "--output", str(store)]
    assert capture(["doctor", *options, "--num-envs", "1"]) == 0
    said = capfd.readouterr().out
    found = lines_of(said)
    assert list(found) == [
        *("processor", "memory", "GPU", "drawing", "robosuite", "LIBERO", "store", "checkpoint", "precision"),
        *("time", "size"),
    ]
    assert "The policy's process took up to" in found["memory"][1]
    assert "pi05_cubes (pi05, openpi_torch, 5.95 MB of weights), trained." in found["checkpoint"][1]
    assert re.match(
        r"At most \d+ (s|min), with one simulator, if every episode runs to its last step", found["time"][1]
    )
    assert re.match(r"At most [\d.]+ MB: 8 episodes, up to 10 replans each, [\d.]+ kB a replan", found["size"][1])
    assert said.endswith("Nothing is missing for the run.\n")
    assert list(tmp_path.iterdir()) == []


def test_a_store_that_the_run_cannot_continue_is_missing(tmp_path, capfd):
    store = write_store(tmp_path / "a.zarr", tasks=(0,), episodes=1)
    options = ["--checkpoint", "untrained-tiny", "--task-id", "0", "--num-episodes", "1", "--max-steps", "4"]
    assert capture(["doctor", *options, "--output", str(store), "--resume"]) == 1
    assert f"Cannot resume {store}: its " in lines_of(capfd.readouterr().out)["trial"][1]
    (tmp_path / "b.zarr").mkdir()
    for mode in ("--resume", "--overwrite"):
        assert capture(["doctor", *options, "--no-trial", "--output", str(tmp_path / "b.zarr"), mode]) == 1
        assert lines_of(capfd.readouterr().out)["store"][0] == "MISSING"


def test_the_run_that_was_made_is_no_fault(tmp_path, capfd):
    store = write_store(tmp_path / "a.zarr", tasks=(0,), episodes=1)
    options = ["--task-id", "0", "--num-episodes", "1", "--max-steps", "4", "--output", str(store)]
    assert capture(["doctor", *options]) == 0
    said = capfd.readouterr().out
    status, text = lines_of(said)["store"]
    assert (status, "holds 1 episode already. A run there needs --resume" in text) == ("note", True)
    assert said.endswith("Nothing is missing for the run.\n")


def test_missing_assets_are_said_before_anything_is_written(tmp_path, capfd, monkeypatch):
    monkeypatch.delenv(ASSETS_VARIABLE, raising=False)
    run = ["pi", "--checkpoint", "untrained-tiny", "--task-suite", "libero_10", "--output", str(tmp_path / "a.zarr")]
    lacking = tmp_path / "assets"
    for _ in range(2):
        assert capture([*run, "--libero-assets", str(lacking)]) == 2
        assert f"The LIBERO asset folder '{lacking}' (--libero-assets) does not exist" in capfd.readouterr().err
        assert list(tmp_path.iterdir()) == []


def test_what_a_run_needs_and_lacks_is_exit_code_1(tmp_path, capfd, monkeypatch):
    monkeypatch.delenv(ASSETS_VARIABLE, raising=False)
    lacking = ["--libero-assets", str(tmp_path), "--output", str(tmp_path / "a.zarr")]
    assert capture(["doctor", "--no-trial", "--task-suite", "libero_10", *lacking]) == 1
    said = capfd.readouterr().out
    found = lines_of(said)
    assert found["assets"][0] == "MISSING"
    assert "lacks scenes" in found["assets"][1]
    assert found["checkpoint"] == (
        "note",
        "pi05_cubes comes with the program. It is not loaded, nor are time and size measured (--no-trial).",
    )
    assert said.endswith("The run cannot be made as described: assets.\n")
    nowhere = ["--checkpoint", str(tmp_path / "nowhere"), "--output", str(tmp_path / "a.zarr")]
    assert capture(["doctor", *nowhere]) == 1
    found = lines_of(capfd.readouterr().out)
    assert found["checkpoint"] == ("MISSING", f"There is no checkpoint folder at '{tmp_path / 'nowhere'}'.")
    assert "size" not in found


def test_a_disk_that_is_too_small_and_a_budget(tmp_path, capfd, monkeypatch):
    from vla_attention.capture.store import disk_estimate

    run = ["doctor", "--num-episodes", "50", "--output", str(tmp_path / "a.zarr")]
    monkeypatch.setattr(disk_estimate, "free_bytes", lambda path: 10**7)
    assert capture(run) == 1
    status, text = lines_of(capfd.readouterr().out)["size"]
    assert "measured on 8 replans of one task." in text
    assert (status, "10 MB are free: give --budget, fewer episodes" in text) == ("MISSING", True)
    monkeypatch.setattr(disk_estimate, "free_bytes", lambda path: 10**9)
    assert capture([*run, "--budget", "400MB"]) == 0
    status, text = lines_of(capfd.readouterr().out)["size"]
    assert (status, "Budget 400 MB: recording " in text) == ("ok", True)
    assert "measured on 24 replans of 3 tasks." in text  # as many tasks as the run tries


def test_a_policy_that_fails_is_not_accepted(tmp_path, capfd):
    options = ["--published-rate", "0.99", "--task-suite", "cubes", "--max-steps", "5", "--num-envs", "1"]
    assert capture(["doctor", "--accept", "untrained-tiny", *options]) == 1
    said = capfd.readouterr().out
    assert "Solved 0 of 10 episodes of cubes: 0% (95 % interval 0.0% to 30.8%)." in said
    assert "Published: 99.0% of 500 episodes (97.7% to 99.7%), --published-rate." in said
    assert "Not solved: task 0 episode 0, task 2 episode 0" in said
    assert "NOT accepted" in said


def test_the_number_of_episodes_can_be_given(tmp_path, capfd):
    options = ["--published-rate", "0.99", "--task-suite", "cubes", "--max-steps", "5", "--num-envs", "1"]
    assert capture(["doctor", "--accept", "untrained-tiny", *options, "--num-episodes", "2"]) == 1
    assert "Solved 0 of 20 episodes of cubes" in capfd.readouterr().out


@pytest.mark.thorough
def test_the_policy_that_comes_along_is_accepted(tmp_path, capfd):
    store = tmp_path / "kept.zarr"
    assert capture(["doctor", "--accept", "pi05_cubes", "--output", str(store), "--layers", "3", "--no-frames"]) == 0
    said = capfd.readouterr().out
    assert re.search(r"^Solved (9|10) of 10 episodes of cubes", said, re.MULTILINE)
    assert "Published: 99.1% of 850 episodes (98.2% to 99.6%), docs/cubes.md." in said
    assert "Accepted: " in said
    assert len([path for path in (store / "episodes").iterdir() if path.is_dir()]) == 10


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--accept", "my/own"], "No success rate of the checkpoint 'my/own' is known; there are rates of pi05_cubes"),
        (["--published-rate", "0.9"], "Cannot use --published-rate without --accept CHECKPOINT."),
        (["--accept", "pi05_cubes", "--task-id", "0"], "Cannot use --task-id, --budget, --resume or --no-trial with"),
        (["--accept", "pi05_cubes", "--keep", "camera:base_0_rgb"], "Cannot use interventions with --accept: the"),
        (["--accept", "pi05_cubes", "--num-episodes", "0"], "Cannot use --num-episodes 0; expected at least 1."),
        (["--task-suite", "cube"], "Unknown task suite 'cube'. Did you mean 'cubes'?"),
    ],
)
def test_mistakes_are_one_sentence(words: list[str], said: str, capfd):
    assert capture(["doctor", *words]) == 2
    printed = capfd.readouterr().err
    assert printed.startswith(f"vla-capture: {said}")
    assert printed.count("\n") == 1


def test_help_has_the_options_of_the_policy_that_is_named(capfd):
    for words, option in (([], "--paligemma-variant"), (["cosmos"], "--t5-tokenizer")):
        with pytest.raises(SystemExit) as end:
            capture(["doctor", *words, "--help-all"])
        assert end.value.code == 0
        said = capfd.readouterr().out
        assert option in said
        assert "--accept CHECKPOINT" in said


def test_a_checkpoint_folder_of_a_published_name(tmp_path: Path, capfd):
    folder = tmp_path / "pi05_libero"
    folder.mkdir()
    assert capture(["doctor", "--accept", str(folder), "--task-suite", "libero_goal"]) == 2
    assert "pi05_libero" in capfd.readouterr().err
