"""Results files of anybody: ours, and those of the published scripts as the test writes them."""

from __future__ import annotations

import json
import os
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.analyze.published.published_results import (
    cosmos_episodes,
    pi_episodes,
    pi_step,
    published_average,
    published_episode,
    write_published,
)
from tests.kit.examples import examples
from tests.kit.made_up_steps import default_grouping, flat, make_steps, replans_of, tasks_of, write_results_of_suites
from vla_attention.analyze.published.results_reader import find_results, read_results_file
from vla_attention.analyze.published.results_tables import (
    NO_FINITE_AS_ZERO,
    ZEROS_COUNTED,
    disagreements,
    results_tables,
    spread,
)
from vla_attention.schemas.results import ResultsError, ResultsNotFound

GROUPING = default_grouping()
DENOISE_STEPS = (0, 9)


def ours(folder, **changes):
    replans = replans_of(make_steps(**changes), GROUPING)
    (path,) = write_results_of_suites(folder, replans, GROUPING, DENOISE_STEPS)
    return path, replans


def test_our_own_files_read_back_as_the_table_they_were_written_from(tmp_path):
    path, replans = ours(tmp_path, no_denominator=0.2)
    file = read_results_file(path)
    assert file.suite == "libero_10"
    assert file.kind.frames is None
    assert file.kind.has_action
    assert file.unused == ()
    assert file.zeros == 0
    back = file.steps.join(file.episodes.select("episode", "task_id", "episode_index"), on="episode").sort(
        "task_id", "episode_index", "replan", "layer_number", nulls_last=True
    )
    expected = flat(replans).sort("task_id", "episode_index", "replan", "layer_number", nulls_last=True)
    for column in ("layer", "env_step", "visual_mass", "linguistic_mass", "action_mass", "visual_fraction"):
        assert back[column].to_list() == pytest.approx(expected[column].to_list()), column
    # Infinities come back, although the file has only null for them.
    assert back["ratio"].to_list() == pytest.approx(expected["ratio_mean"].to_list())
    assert expected["ratio"].is_infinite().any()
    assert disagreements(file).is_empty()


def test_num_steps_is_the_loops_counter_whoever_wrote_the_file(tmp_path):
    path, replans = ours(tmp_path)
    cells = replans.cells.unique(["task_id", "episode_index"]).sort("task_id", "episode_index")
    expected = [10 + row["num_steps"] - row["success"] for row in cells.iter_rows(named=True)]
    assert read_results_file(path).episodes["num_steps"].to_list() == expected
    episodes = pi_episodes()
    theirs = read_results_file(write_published(tmp_path, "theirs", episodes))
    assert theirs.episodes["num_steps"].to_list() == [episode["num_steps"] for episode in episodes]


def test_files_that_say_how_many_keys_each_side_has_get_a_baseline_and_a_lift(tmp_path):
    path, replans = ours(tmp_path, no_denominator=0.2)
    tables = results_tables([read_results_file(path)], ["libero_10"])
    for column in ("uniform_ratio", "ratio_lift"):
        # The average over layers in a file is the published one, a mean of ratios; our lift is of their logarithms.
        own, expected = (
            cells.filter(pl.col("layer") != "layers_avg").sort(
                "task_id", "episode_index", "replan", "layer_number", nulls_last=True
            )[column]
            for cells in (tables.replans, replans.cells)
        )
        np.testing.assert_allclose(own.to_numpy(), expected.to_numpy())
    theirs = results_tables([read_results_file(write_published(tmp_path, "theirs", pi_episodes()))], ["theirs"])
    assert theirs.replans["uniform_ratio"].is_null().all()


def test_files_of_different_groupings_or_denoise_steps_are_of_different_kinds(tmp_path):
    path, _ = ours(tmp_path)
    document = json.loads(path.read_text())
    kinds = {read_results_file(path).kind}
    for change in ({"grouping": "instruction"}, {"denoise_steps": [0]}):
        path.write_text(json.dumps([{**episode, **change} for episode in document]))
        kinds.add(read_results_file(path).kind)
    assert len({str(kind) for kind in kinds}) == len(kinds) == 3


def test_files_of_the_published_pi_script(tmp_path):
    episodes = pi_episodes(dark=0.3)
    file = read_results_file(write_published(tmp_path, "libero_10", episodes))
    assert file.unused == ("visual_perturbation",)
    assert file.episodes["num_steps"].to_list() == [episode["num_steps"] for episode in episodes]
    for number, episode in enumerate(episodes):
        for name, steps in episode["per_step_ratios"].items():
            layer = name.removeprefix("layer_") if name != "layers_avg" else name
            rows = file.steps.filter(episode=number, layer=layer).sort("replan")
            assert rows["env_step"].to_list() == [step["step"] for step in steps]
            if layer != "layers_avg":
                assert rows["ratio"].to_list() == [step["visual_linguistic_ratio"] for step in steps]
    assert np.isinf(file.steps["ratio"].to_numpy()).any()


def test_a_zero_that_stands_for_no_ratio_is_undefined_and_counted(tmp_path):
    file = read_results_file(write_published(tmp_path, "s", pi_episodes(tasks=1, episodes=1, dark=1.0)))
    assert file.steps.filter(layer="layers_avg")["ratio"].is_null().all()
    assert file.steps.filter(layer="25")["ratio"].is_infinite().all()
    assert file.zeros == 8
    assert set(disagreements(file)["reason"]) == {NO_FINITE_AS_ZERO}
    # A step at which only some layers are infinite has a ratio; zeros among ratios change the file's own means.
    episodes = pi_episodes(tasks=1, episodes=1, layers=(25, 26), steps=4)
    for name in ("layer_25", "layer_26", "layers_avg"):
        step = episodes[0]["per_step_ratios"][name][0]
        step["visual_linguistic_ratio"] = 0.0 if name == "layers_avg" else float("inf")
    steps = episodes[0]["per_step_ratios"]["layers_avg"]
    stated = episodes[0]["summary"]["layers_avg"]["visual_linguistic_ratio"]
    stated["mean"] = float(np.mean([step["visual_linguistic_ratio"] for step in steps]))
    file = read_results_file(write_published(tmp_path, "t", episodes))
    mean = disagreements(file).filter(layer="layers_avg", statistic="mean").row(0, named=True)
    assert mean["reason"] == ZEROS_COUNTED
    assert mean["computed"] == pytest.approx(np.mean([step["visual_linguistic_ratio"] for step in steps[1:]]))


def test_a_true_zero_stays_a_ratio(tmp_path):
    layers = {"layer_3": [pi_step(10, 0.0, 0.5, 0.5), pi_step(15, 0.25, 0.5, 0.25)]}
    file = read_results_file(write_published(tmp_path, "s", [published_episode(0, 0, layers)]))
    assert file.steps["ratio"].to_list() == [0.0, 0.5]
    assert file.zeros == 0


def test_files_of_the_published_cosmos_script(tmp_path):
    file = read_results_file(write_published(tmp_path, "libero_goal", cosmos_episodes()))
    assert file.kind.frames == ("action", "curr_last", "frame0")
    assert not file.kind.has_action
    assert file.steps["layer"].unique().sort().to_list() == ["25", "26"]
    assert (file.steps["visual_mass"] > 1).any()
    tables = results_tables([file], ["libero_goal"])
    assert tables.grouping.names == ("visual", "linguistic")


def test_what_no_named_fraction_holds_is_the_rest(tmp_path):
    path, _ = ours(tmp_path)
    tables = results_tables([read_results_file(path)], ["x"])
    assert tables.grouping.names == ("visual", "linguistic", "action", "rest")
    others = [name for name in GROUPING.names if name not in ("visual", "linguistic", "action")]
    for measure in ("fraction", "mass"):
        found = tables.groups.filter(group="rest", scope="all", layer="layers_avg")[measure][0]
        tasks = tasks_of(make_steps(), GROUPING).groups.filter(scope="all", layer="layers_avg")
        assert found == pytest.approx(sum(tasks.filter(group=name)[measure][0] for name in others), abs=1e-9)


def test_tables_are_those_of_numpy(tmp_path):
    episodes = pi_episodes(dark=0.2, seed=4)
    tables = results_tables([read_results_file(write_published(tmp_path, "s", episodes))], ["s"])
    means = {}
    for episode in episodes:
        for name, steps in episode["per_step_ratios"].items():
            ratios = np.array([step["visual_linguistic_ratio"] for step in steps])
            finite = ratios[np.isfinite(ratios)]
            if name == "layers_avg":
                finite = finite[finite > 0]
            key = (episode["task_id"], episode["episode_idx"], name.removeprefix("layer_"))
            means[key] = finite.mean() if finite.size else None
    for row in tables.episodes.iter_rows(named=True):
        assert row["ratio_mean"] == pytest.approx(means[row["task_id"], row["episode_index"], row["layer"]])
    for row in tables.tasks.filter(scope="task").iter_rows(named=True):
        own = [v for (task, _, layer), v in means.items() if (task, layer) == (row["task_id"], row["layer"]) and v]
        assert row["ratio_mean"] == pytest.approx(np.mean(own))
        assert row["num_episodes"] == 4


def test_layers_that_an_episode_lacks_and_episodes_without_steps_are_kept(tmp_path):
    episodes = pi_episodes(tasks=2, episodes=1)
    episodes[1]["per_step_ratios"], episodes[1]["summary"] = {}, {}
    file = read_results_file(write_published(tmp_path, "s", episodes))
    assert file.episodes["num_replans"].to_list() == [8, 0]


def test_files_folders_and_patterns_are_found_once(tmp_path):
    goal = write_published(tmp_path / "run_a", "goal", cosmos_episodes())
    ten = write_published(tmp_path / "run_b", "ten", cosmos_episodes())
    (tmp_path / "run_a" / "config.json").write_text("{}")
    plain = tmp_path / "plain"
    plain.mkdir()
    (plain / "renamed.json").write_text(json.dumps(cosmos_episodes()))
    assert find_results([str(tmp_path / "run_a")]) == [goal]
    assert find_results([str(tmp_path / "run_*/attention_ratio_results_*.json"), str(goal)]) == [goal, ten]
    assert find_results([str(tmp_path / "run_*")]) == [goal, ten]
    assert find_results([str(plain)]) == [plain / "renamed.json"]
    with pytest.raises(ResultsNotFound, match=r"run_x.*run_a/attention_ratio_results_goal"):
        find_results([str(tmp_path / "run_x*/a.json")])
    (tmp_path / "empty").mkdir()
    with pytest.raises(FileNotFoundError, match="empty"):
        find_results([str(tmp_path / "empty")])


def one_episode(**changes: Any) -> dict[str, Any]:
    return {**pi_episodes(tasks=1, episodes=1)[0], **changes}


def with_step(**changes: Any) -> list[dict[str, Any]]:
    episode = one_episode()
    episode["per_step_ratios"]["layer_26"][3].update(changes)
    return [one_episode(episode_idx=7), episode]


@pytest.mark.parametrize(
    ("document", "named"),
    [
        ({"a": 1}, "object"),
        ("text", "text"),
        ([], ""),
        ([{"a": 1}], "episode 0 .*'task_id'"),
        ([3], r"episode 0 .*\b3\b"),
        ([one_episode(success="yes")], "episode 0, success"),
        ([one_episode(task_id=-1)], "episode 0, task_id .*-1"),
        ([one_episode(num_steps_definition="x")], "num_steps_definition .*'x'; .*'loop_counter'"),
        ([one_episode(), one_episode()], "episodes 0 and 1 .*task 0, episode 0"),
        ([one_episode(per_step_ratios={}, summary={})], " 1 episodes"),
        ([one_episode(per_step_ratios={"level_3": []})], "'level_3'; .*layer_N or layers_avg"),
        (
            [one_episode(summary={"layer_25": {"visual_mass": {"mean": "x"}}})],
            r"summary\.layer_25\.visual_mass\.mean",
        ),
        (with_step(visual_mass=-0.1), r"episode 1 \(task 0, episode 0\), layer_26\[3\]\.visual_mass .*-0\.1"),
        (with_step(visual_mass=float("nan")), r"layer_26\[3\]\.visual_mass .*nan"),
        (
            with_step(linguistic_fraction=1.5),
            r"layer_26\[3\]\.linguistic_fraction .*1\.5; .*0 to 1",
        ),
        (with_step(visual_linguistic_ratio=float("-inf")), "visual_linguistic_ratio .*-inf"),
        (with_step(visual_linguistic_ratio="high"), "visual_linguistic_ratio"),
        (with_step(step=10), r"layer_26\[3\]\.step .*10, .*20"),
        (with_step(step=True), r"layer_26\[3\]\.step .*true"),
        (with_step(query_frame="action"), r"layer_26\[3\] .*'visual_frame', 'text_frame'"),
        (
            with_step(query_frame="action", visual_frame="curr_last", text_frame="frame0"),
            r"layer_26\[3\] .*episode 0",
        ),
    ],
)
def test_what_does_not_fit_is_said_with_file_episode_and_field(tmp_path, document, named):
    path = tmp_path / "broken.json"
    path.write_text(json.dumps(document))
    with pytest.raises(ResultsError, match=rf"broken\.json: .*{named}") as caught:
        read_results_file(path)
    assert "\n" not in str(caught.value)


MASSES = st.tuples(*[st.one_of(st.just(0.0), st.just(1e-9), st.floats(1e-6, 1.0))] * 3)


@settings(max_examples=examples(30), deadline=None)
@given(data=st.data())
def test_any_masses_give_the_numbers_of_numpy(data):
    layers, replans = data.draw(st.integers(2, 3)), data.draw(st.integers(1, 5))
    by_layer = {
        f"layer_{layer}": [pi_step(10 + 5 * i, *data.draw(MASSES)) for i in range(replans)] for layer in range(layers)
    }
    by_layer["layers_avg"] = [published_average(list(at)) for at in zip(*by_layer.values(), strict=True)]
    with tempfile.TemporaryDirectory() as folder:
        file = read_results_file(write_published(Path(folder), "s", [published_episode(0, 0, by_layer)]))
    averages = np.zeros((layers, replans))
    for layer in range(layers):
        steps = by_layer[f"layer_{layer}"]
        # Nothing on either side is no ratio; the published scripts write 0 for it.
        nothing = [step["visual_mass"] <= 1e-8 and step["linguistic_mass"] <= 1e-8 for step in steps]
        ratios = np.where(nothing, np.nan, [step["visual_linguistic_ratio"] for step in steps])
        averages[layer] = ratios
        found = file.steps.filter(layer=str(layer)).select(spread()).row(0, named=True)
        finite = ratios[np.isfinite(ratios)]
        assert found["replans"] - found["infinite"] - found["undefined"] == finite.size
        assert found["infinite"] == np.isinf(ratios).sum()
        assert found["mean"] == (pytest.approx(finite.mean()) if finite.size else None)
    overall = file.steps.filter(layer="layers_avg").sort("replan")["ratio"]
    for column, ratio in zip(averages.T, overall, strict=True):
        finite = column[np.isfinite(column)]
        if not finite.size:
            assert ratio is None
        elif not np.isnan(column).any():
            assert ratio == pytest.approx(finite.mean())
    # What differs from the file's summaries always has a known reason.
    assert disagreements(file).filter(reason="").is_empty()


def test_a_pipe_in_place_of_a_results_file_ends_at_once(tmp_path):
    os.mkfifo(tmp_path / "attention_ratio_results_goal.json")
    with pytest.raises(ResultsNotFound, match="attention_ratio_results_goal"):
        read_results_file(tmp_path / "attention_ratio_results_goal.json")
