from __future__ import annotations

import json

import numpy as np
import polars as pl
import pytest

from tests.kit import made_up_steps
from tests.kit.made_up_steps import (
    CUSTOM_KEYS,
    custom_grouping,
    default_grouping,
    flat,
    make_steps,
    write_results_of_suites,
)
from vla_attention.analyze.published import results_writer
from vla_attention.analyze.published.results_writer import write_results
from vla_attention.analyze.render.files import replacing
from vla_attention.schemas.groupings.grouping import Grouping, Ratio
from vla_attention.schemas.jsonable import from_json
from vla_attention.schemas.results import (
    EpisodeResult,
    FrameProxy,
    results_file_name,
    suite_of_results_file,
)

GROUPING = default_grouping()
DENOISE_STEPS = (0, 9)


def replans_of(steps, grouping=GROUPING):
    return made_up_steps.replans_of(steps, grouping)


def documents_of(replans, grouping) -> list[dict]:
    positions = range(len(replans.measured))
    return list(results_writer.documents_of(replans.measured, positions, grouping, DENOISE_STEPS))


def write(path, documents) -> None:
    with replacing(path) as temporary:
        write_results(temporary, documents)


def episode_results(replans, grouping):
    return from_json(list[EpisodeResult], documents_of(replans, grouping))


def read_results(path):
    return from_json(list[EpisodeResult], json.loads(path.read_text(encoding="utf-8")))


def test_file_has_the_published_structure(tmp_path):
    (path,) = write_results_of_suites(tmp_path, replans_of(make_steps()), GROUPING, DENOISE_STEPS)
    assert path.name == "attention_ratio_results_libero_10.json"
    document = json.loads(path.read_text(encoding="utf-8"))
    assert [(episode["task_id"], episode["episode_idx"]) for episode in document] == [
        (task, episode) for task in range(2) for episode in range(3)
    ]
    episode = document[0]
    assert list(episode) == [
        *("task_id", "episode_idx", "task_description", "success", "num_steps", "num_steps_definition"),
        *("grouping", "grouping_description", "denoise_steps", "summary", "per_step_ratios"),
    ]
    layers = ["layer_18", "layer_25", "layer_35", "layers_avg"]
    assert list(episode["summary"]) == list(episode["per_step_ratios"]) == layers
    summary = episode["summary"]["layer_25"]
    assert set(summary["visual_linguistic_ratio"]) == {"mean", "std", "median", "min", "max", "num_nonfinite"}
    kinds = [f"{side}_{kind}" for side in ("visual", "linguistic", "action") for kind in ("mass", "fraction")]
    assert set(summary) == {"visual_linguistic_ratio", "num_steps", *kinds}
    steps = episode["per_step_ratios"]["layers_avg"]
    assert [step["step"] for step in steps] == [10, 15, 20, 25, 30, 35]
    counts = ("total_mass", "num_visual_tokens", "num_text_tokens")
    assert set(steps[0]) == {"step", "visual_linguistic_ratio", *kinds, *counts}
    told = [episode[name] for name in ("grouping", "grouping_description", "denoise_steps")]
    assert told == ["default", "visual = every valid image key", [0, 9]]


def test_num_steps_is_the_counter_of_the_published_loop():
    """`t` counts the waiting steps, and the loop is left before it counts the action that solves the task."""
    replans = replans_of(make_steps(num_episodes=8))
    cells = replans.cells.unique(["task_id", "episode_index"]).sort("task_id", "episode_index")
    expected = []
    for actions, success in cells.select("num_steps", "success").iter_rows():
        t, executed = 10, 0
        while executed < actions:
            executed += 1
            if success and executed == actions:
                break
            t += 1
        expected.append(t)
    results = episode_results(replans, GROUPING)
    assert {result.success for result in results} == {True, False}
    assert [result.num_steps for result in results] == expected
    assert {result.num_steps_definition for result in results} == {"loop_counter"}


def test_every_step_says_what_its_fractions_are_of_and_how_many_keys_each_side_has():
    replans = replans_of(make_steps())
    table = flat(replans)
    for result in episode_results(replans, GROUPING):
        for layer, steps in result.per_step_ratios.items():
            number = layer.removeprefix("layer_")
            rows = table.filter(task_id=result.task_id, episode_index=result.episode_idx, layer=number)
            total = rows.select(pl.sum_horizontal(f"{name}_mass" for name in GROUPING.names)).to_series()
            assert [step.total_mass for step in steps] == pytest.approx(total.to_list())
            for step in steps:
                assert step.visual_fraction == pytest.approx(step.visual_mass / step.total_mass)
                assert (step.num_visual_tokens, step.num_text_tokens) == (512, 14)
    # Objects that cover parts of patches have fractional numbers of keys.
    parts = custom_grouping(with_ratio=False)
    parts = Grouping("target", parts.groups, Ratio(("target", "wrist"), ("nouns", "verbs")))
    step = episode_results(replans_of(make_steps(parts, CUSTOM_KEYS), parts), parts)[0].per_step_ratios["layers_avg"][0]
    assert (step.num_visual_tokens, step.num_text_tokens) == (263.25, 5)


def test_numbers_are_those_of_the_table():
    replans = replans_of(make_steps(no_denominator=0.2))
    results = episode_results(replans, GROUPING)
    part = flat(replans).filter(task_id=1, episode_index=2, layer="25")
    result = next(item for item in results if (item.task_id, item.episode_idx) == (1, 2))
    steps = result.per_step_ratios["layer_25"]
    ratio = part["ratio"].to_numpy()
    ratios = [np.inf if (found := step.visual_linguistic_ratio) is None else found for step in steps]
    assert ratios == pytest.approx(ratio.tolist())
    assert [step.visual_mass for step in steps] == pytest.approx(part["visual_mass"].to_list())
    assert [step.action_fraction for step in steps] == pytest.approx(part["action_fraction"].to_list())
    summary = result.summary["layer_25"]
    finite = ratio[np.isfinite(ratio)]
    assert summary.visual_linguistic_ratio.mean == pytest.approx(finite.mean())
    assert summary.visual_linguistic_ratio.std == pytest.approx(finite.std())
    assert summary.visual_linguistic_ratio.num_nonfinite == len(ratio) - len(finite)
    assert summary.visual_mass.std == pytest.approx(part["visual_mass"].to_numpy().std())
    assert summary.num_steps == 6


def test_infinite_ratios_are_null_in_strict_json(tmp_path):
    (path,) = write_results_of_suites(tmp_path, replans_of(make_steps(no_denominator=1.0)), GROUPING, DENOISE_STEPS)

    def refuse(constant):
        raise AssertionError(constant)

    document = json.loads(path.read_text(encoding="utf-8"), parse_constant=refuse)
    summary = document[0]["summary"]["layer_18"]["visual_linguistic_ratio"]
    assert summary == {"mean": None, "std": None, "median": None, "min": None, "max": None, "num_nonfinite": 6}
    assert document[0]["per_step_ratios"]["layer_18"][0]["visual_linguistic_ratio"] is None
    assert document[0]["per_step_ratios"]["layer_18"][0]["visual_mass"] > 0


@pytest.mark.parametrize("with_action", [True, False])
def test_reading_gives_back_what_was_written(tmp_path, with_action):
    grouping, keys = (GROUPING, None) if with_action else (custom_grouping(), CUSTOM_KEYS)
    replans = replans_of(make_steps(grouping, keys, no_denominator=0.3), grouping)
    results = episode_results(replans, grouping)
    path = tmp_path / "results" / results_file_name("libero_10")
    write(path, documents_of(replans, grouping))
    assert read_results(path) == results
    assert ("action_mass" in path.read_text(encoding="utf-8")) == with_action
    assert [file.name for file in path.parent.iterdir()] == [path.name]  # nothing temporary stays


def test_sides_of_another_grouping_are_the_sums_of_the_ratios_groups():
    grouping = custom_grouping()
    replans = replans_of(make_steps(grouping, CUSTOM_KEYS), grouping)
    step = episode_results(replans, grouping)[0].per_step_ratios["layer_18"][0]
    row = flat(replans).filter(task_id=0, episode_index=0, replan=0, layer="18").row(0, named=True)
    assert step.visual_mass == pytest.approx(row["base_mass"] + row["wrist_mass"])
    assert step.linguistic_mass == pytest.approx(row["nouns_mass"])
    assert step.visual_fraction == pytest.approx(row["base_fraction"] + row["wrist_fraction"])
    assert step.visual_linguistic_ratio == pytest.approx(step.visual_mass / step.linguistic_mass)
    assert step.action_mass is None


def test_a_ratio_of_latent_frames_has_the_published_fields_and_sums_over_queries(tmp_path):
    """Masses x number of queries, fractions of the two frames only, the frames' names beside every step."""
    proxy = FrameProxy(1764, "action", "curr_last", "frame0", num_queries=196)
    replans = replans_of(make_steps())
    (path,) = write_results_of_suites(tmp_path, replans, GROUPING, DENOISE_STEPS, proxy)
    episode = json.loads(path.read_text(encoding="utf-8"))[1]
    rows = flat(replans).filter(task_id=0, episode_index=1, layer="25").sort("replan")
    for step, row in zip(episode["per_step_ratios"]["layer_25"], rows.iter_rows(named=True), strict=True):
        assert step["visual_mass"] == pytest.approx(196 * row["visual_mass"])
        assert step["linguistic_mass"] == pytest.approx(196 * row["linguistic_mass"])
        assert step["visual_linguistic_ratio"] == pytest.approx(row["visual_mass"] / row["linguistic_mass"])
        both = row["visual_mass"] + row["linguistic_mass"]
        assert step["visual_fraction"] == pytest.approx(row["visual_mass"] / both)
        assert step["linguistic_fraction"] == pytest.approx(row["linguistic_mass"] / both)
        assert step["total_mass"] == pytest.approx(196 * both)
        names = ("selected_call_S", "query_frame", "visual_frame", "text_frame")
        assert [step[name] for name in names] == [1764, "action", "curr_last", "frame0"]
        assert "action_mass" not in step
    assert "action_mass" not in episode["summary"]["layer_25"]
    assert read_results(path)[0].per_step_ratios["layers_avg"][0].text_frame == "frame0"


def test_every_suite_has_its_own_file(tmp_path):
    steps = pl.concat([make_steps(), make_steps(suite="libero_goal", num_tasks=1)])
    paths = write_results_of_suites(tmp_path, replans_of(steps), GROUPING, DENOISE_STEPS)
    assert [suite_of_results_file(path) for path in paths] == ["libero_10", "libero_goal"]
    assert [len(read_results(path)) for path in paths] == [6, 3]


def test_a_failed_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "results.json"
    documents = documents_of(replans_of(make_steps()), GROUPING)
    write(path, documents)
    results = read_results(path)

    def broken():
        yield documents[0]
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write(path, broken())
    assert read_results(path) == results
    assert list(tmp_path.iterdir()) == [path]
