"""Capture and analysis through their command lines: simulator, policy, store, tables, results files, pictures."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import polars as pl
import pytest
import zarr

import vla_attention as va
from tests.end_to_end.written_tables import written_steps
from tests.kit.raw_rows import probabilities
from vla_attention.analyze.__main__ import main as analyze
from vla_attention.capture.__main__ import main as capture

pytestmark = pytest.mark.simulator


def test_capture_makes_a_complete_store_and_resume_adds_the_missing_episodes(captured_store, capsys):
    assert analyze(["store", "verify", str(captured_store)]) == 0
    assert "4 episodes, all whole" in capsys.readouterr().out
    names = sorted(path.name for path in (captured_store / "episodes").iterdir() if path.is_dir())
    assert names == [f"task{task:03d}_episode{episode:03d}" for task in (0, 1) for episode in (0, 1)]
    assert not captured_store.with_name("robosuite.zarr.partial").exists()


def test_resuming_a_complete_store_changes_nothing(captured_store, run_capture, capsys):
    before = {path: path.read_bytes() for path in captured_store.rglob("*") if path.is_file()}
    run_capture("--task-id", 0, "--num-episodes", 2, "--output", captured_store, "--resume")
    assert "2 of 2 episodes are complete already; 0 to run" in capsys.readouterr().out
    assert {path: path.read_bytes() for path in captured_store.rglob("*") if path.is_file()} == before


@pytest.mark.thorough
def test_two_runs_give_the_same_bytes_whatever_ran_before(captured_store, run_capture, tmp_path):
    again = tmp_path / "again.zarr"
    run_capture("--task-id", 1, "--num-episodes", 2, "--output", again)
    for name in ("task001_episode000", "task001_episode001"):
        first, second = captured_store / "episodes" / name, again / "episodes" / name
        files = sorted(path.relative_to(first) for path in first.rglob("*") if path.is_file())
        assert files == sorted(path.relative_to(second) for path in second.rglob("*") if path.is_file())
        for file in files:
            assert (first / file).read_bytes() == (second / file).read_bytes(), file


def test_episodes_hold_the_inputs_of_the_policy(captured_store):
    episode = zarr.open_group(captured_store / "episodes/task001_episode000", mode="r")
    attributes = dict(episode.attrs)
    assert attributes["instruction"] == "stack the red cube on top of the green cube"
    assert episode.attrs["env_step"] == [10, 14, 18]
    assert len(set(episode.attrs["noise_seed"])) == 3
    frames = episode["frames/base_0_rgb"][:]
    assert frames.shape == (3, 28, 28, 3)
    assert frames.std() > 10
    names = [thing["name"] for thing in attributes["objects"]]
    coverage = episode["objects/base_0_rgb"][:]
    np.testing.assert_allclose(coverage.sum(axis=2), 1.0, atol=1e-6)
    assert coverage[:, :, names.index("cubeA")].sum() > 0
    assert coverage[:, :, names.index("robot")].sum() > 0


def test_results_file_has_the_published_structure(captured_store, tmp_path):
    assert analyze([str(captured_store), "--output", str(tmp_path), "--no-plots", "--layers", "2", "3"]) == 0

    def no_constants(name: str) -> None:
        raise AssertionError(f"{name} is not JSON")

    text = (tmp_path / "attention_ratio_results_robosuite.json").read_text()
    episodes = json.loads(text, parse_constant=no_constants)
    assert [(item["task_id"], item["episode_idx"]) for item in episodes] == [(0, 0), (0, 1), (1, 0), (1, 1)]
    first = episodes[0]
    assert first["task_description"] == "lift the red cube"
    assert first["num_steps"] == 10 + 12  # waiting steps and actions
    assert first["success"] is False
    # 3 is the published scripts' number for block 0 of a model with three blocks.
    assert set(first["summary"]) == set(first["per_step_ratios"]) == {"layer_2", "layer_3", "layers_avg"}
    steps = first["per_step_ratios"]["layer_2"]
    assert [step["step"] for step in steps] == [10, 14, 18]
    for step in steps:
        assert step["visual_linguistic_ratio"] == pytest.approx(step["visual_mass"] / step["linguistic_mass"])
    ratios = [step["visual_linguistic_ratio"] for step in steps]
    summary = first["summary"]["layer_2"]["visual_linguistic_ratio"]
    assert summary["mean"] == pytest.approx(np.mean(ratios))
    assert summary["std"] == pytest.approx(np.std(ratios))
    assert summary["median"] == pytest.approx(np.median(ratios))


@pytest.mark.thorough
def test_a_block_named_both_ways_is_stored_once_and_reported_twice(run_capture, tmp_path):
    """As in the published example, whose layers 8 and 26 are one block of a model with 18."""
    run_capture("--task-id", 0, "--num-episodes", 1, "--layers", 2, 0, 5, "--output-dir", tmp_path)
    rows = probabilities(
        zarr.open_group(tmp_path / "robosuite.zarr/episodes/task000_episode000", mode="r")["joint/rows"]
    )
    assert rows.shape[1] == 2
    (episode,) = json.loads((tmp_path / "attention_ratio_results_robosuite.json").read_text())
    assert set(episode["summary"]) == {"layer_0", "layer_2", "layer_5", "layers_avg"}
    assert episode["summary"]["layer_2"] == episode["summary"]["layer_5"]
    each = [episode["per_step_ratios"][f"layer_{layer}"][0]["visual_mass"] for layer in (0, 2)]
    assert episode["per_step_ratios"]["layers_avg"][0]["visual_mass"] == pytest.approx(np.mean(each))


def test_three_groupings_of_one_store_need_no_model(captured_store, tmp_path, monkeypatch):
    # The analysis must work without torch and without the simulators.
    for module in ("torch", "mujoco", "robosuite", "vla_attention.capture"):
        monkeypatch.setitem(sys.modules, module, None)
    toml = tmp_path / "things.toml"
    toml.write_text(
        'name = "things"\n[groups]\ncube = "object:cubeA & camera:base_0_rgb"\nnouns = ["word:cube"]\n'
        'text = "role:instruction - word:cube"\nrest = "*"\n[ratio]\nnumerator = ["cube"]\ndenominator = ["nouns"]\n'
    )
    tables = {}
    for grouping in ("default", "cameras", str(toml)):
        folder = tmp_path / Path(grouping).stem
        arguments = ["--grouping", grouping, "--task", "1", "--output", str(folder), "--no-plots"]
        assert analyze([str(captured_store), *arguments]) == 0
        tables[folder.name] = written_steps(folder)
    sides = ["base_0_rgb_mass", "left_wrist_0_rgb_mass"]
    both = tables["cameras"].select(pl.sum_horizontal(sides)).to_series()
    np.testing.assert_allclose(both, tables["default"]["visual_mass"], rtol=1e-5)
    things = tables["things"]
    assert (things["cube_keys"] < 4).all()
    total = things.select(pl.sum_horizontal("cube_mass", "nouns_mass", "text_mass", "rest_mass")).to_series()
    np.testing.assert_allclose(total, things["row_sum"], rtol=2**-11 + 1e-5)


def test_masses_equal_a_computation_by_hand_from_the_raw_arrays(captured_store, tmp_path):
    groups = {"left": "patch:base_0_rgb[0:2,0:1]", "cube": "word:cube"}
    va.open(captured_store).analyze(groups=groups, per_head=True).save(tmp_path, pictures=False)
    steps = written_steps(tmp_path).filter(task_id=1, episode_index=1)
    raw = zarr.open_group(captured_store / "episodes/task001_episode001", mode="r")
    rows = probabilities(raw["joint/rows"]).astype(np.float64)[..., 0, :]
    assert len(steps) == np.prod(rows.shape[:-1])
    # 2 x 2 patches, row-major: the left column is keys 0 and 2 of the first camera.
    np.testing.assert_allclose(
        steps["left_mass"].to_numpy().reshape(rows.shape[:-1]), rows[..., [0, 2]].sum(-1), rtol=2**-10
    )
    prompts, index = raw.attrs["prompts"], raw.attrs["prompt_index"]
    by_hand = np.zeros(rows.shape[:-1])
    for replan, which in enumerate(index):
        text = prompts[which]["text"]
        begin, end = prompts[which]["instruction"]
        keys = set()
        for start in range(begin, end):
            if text[start : start + 4] == "cube":
                keys |= {p["key"] for p in prompts[which]["pieces"] if p["start"] < start + 4 and p["stop"] > start}
        by_hand[replan] = rows[replan][..., sorted(keys)].sum(-1)
    assert (by_hand > 0).all()
    np.testing.assert_allclose(steps["cube_mass"].to_numpy().reshape(by_hand.shape), by_hand, rtol=2**-10)


def test_recording_does_not_change_what_the_robot_does(captured_store, run_capture, tmp_path):
    little = tmp_path / "little.zarr"
    run_capture(
        "--task-id",
        0,
        "--num-episodes",
        1,
        "--output",
        little,
        "--layers",
        1,
        "--denoise",
        "last",
        "--heads",
        3,
        "--no-frames",
    )
    for array in ("actions", "state"):
        few, many = (
            zarr.open_group(store / "episodes/task000_episode000", mode="r")[array][:]
            for store in (little, captured_store)
        )
        assert np.array_equal(few, many)
    one = probabilities(zarr.open_group(little / "episodes/task000_episode000", mode="r")["joint/rows"])
    assert one.shape[1:4] == (1, 1, 1)
    full = probabilities(zarr.open_group(captured_store / "episodes/task000_episode000", mode="r")["joint/rows"])
    assert np.array_equal(one[:, 0, 0, 0], full[:, 1, 1, 3])


def test_contributions_of_the_segments_add_up_to_the_update(captured_store):
    episode = zarr.open_group(captured_store / "episodes/task001_episode000", mode="r")
    gram = episode["joint/contribution"][:].astype(np.float64)
    names = [f"{part['span']}:{part['role']}" for part in episode.attrs["segments"]["joint"]]
    assert gram.shape[-2:] == (len(names) + 1, len(names) + 1)
    np.testing.assert_allclose(gram[..., :-1, :-1].sum((-2, -1)), gram[..., -1, -1], rtol=1e-3)
    masked = [i for i, name in enumerate(names) if "masked" in name or "padding" in name]
    assert masked
    assert not gram[..., masked, :].any()
    assert (np.linalg.eigvalsh(gram) > -1e-4 * gram[..., -1:, -1]).all()


@pytest.mark.libero
def test_real_libero_from_capture_to_word_and_object_groups(libero_assets, run_capture, tmp_path):
    store = tmp_path / "libero_10.zarr"
    run_capture(
        "--task-suite",
        "libero_10",
        "--task-id",
        0,
        "--num-episodes",
        1,
        "--libero-assets",
        libero_assets,
        "--output",
        store,
    )
    arguments = ["--group", "soup=object:alphabet_soup_1", "--group", "named=word:soup", "--ratio", "soup/named"]
    assert analyze([str(store), *arguments, "--output", str(tmp_path / "soup"), "--no-plots"]) == 0
    steps = written_steps(tmp_path / "soup")
    assert steps["instruction"][0] == "put both the alphabet soup and the tomato sauce in the basket"
    assert (steps["soup_keys"] > 0).all()
    assert steps["ratio"].is_finite().all()


def test_capture_is_interrupted_cleanly(monkeypatch, tmp_path, capsys):
    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("vla_attention.capture.engine.simulators.LocalSimulator.ask", interrupt)
    code = capture(
        [
            "pi",
            "--checkpoint",
            "untrained-tiny",
            "--replan-steps",
            "4",
            "--task-id",
            "0",
            "--num-envs",
            "1",
            "--output",
            str(tmp_path / "a.zarr"),
        ]
    )
    assert code == 130
    assert "--resume" in capsys.readouterr().err
