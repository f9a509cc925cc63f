"""`parse-attention-ratio-results`, as it is called; its numbers against numpy."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from tests.analyze.published.published_results import cosmos_episodes, pi_episodes, write_published
from tests.analyze.published.test_results_reader import ours
from vla_attention.analyze.published.parse_results import main
from vla_attention.analyze.render.numbers import format_number


def run(capsys: pytest.CaptureFixture[str], *words: object) -> tuple[int, str, str]:
    code = main([str(word) for word in words])
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def published_numbers(episodes: list[dict]) -> dict[str, float]:
    """What the published parser computes, over the steps of "layers_avg" or else the first layer."""
    ratios, visual = [], []
    for episode in episodes:
        layers = episode["per_step_ratios"]
        steps = layers["layers_avg"] if "layers_avg" in layers else next(iter(layers.values()))
        ratios += [step["visual_linguistic_ratio"] for step in steps if np.isfinite(step["visual_linguistic_ratio"])]
        visual += [step["visual_fraction"] for step in steps]
    low, high = np.percentile(ratios, [25, 75])
    known = {"mean": np.mean(ratios), "std": np.std(ratios), "median": np.median(ratios), "low": low, "high": high}
    return {**known, "min": min(ratios), "max": max(ratios), "visual": np.mean(visual), "visual_std": np.std(visual)}


def printed_block(numbers: dict[str, float]) -> list[str]:
    return [
        f"  Mean:   {numbers['mean']:.3f} ± {numbers['std']:.3f}",
        f"  Median: {numbers['median']:.3f}",
        f"  Range:  [{numbers['min']:.3f}, {numbers['max']:.3f}]",
        f"  IQR:    [{numbers['low']:.3f}, {numbers['high']:.3f}]",
        f"  Visual:     {numbers['visual']:.1%} ± {numbers['visual_std']:.1%}",
    ]


@pytest.mark.parametrize("episodes", [pi_episodes(dark=0.1), pi_episodes(layers=(25,)), cosmos_episodes()])
def test_the_published_parsers_numbers_are_printed(tmp_path, monkeypatch, capsys, episodes):
    path = write_published(tmp_path, "libero_10", episodes)
    monkeypatch.chdir(tmp_path)  # paths are printed in full: the width of lines is tested with a short one
    code, out, err = run(capsys, "--results", path.name)
    assert (code, err) == (0, "")
    for line in printed_block(published_numbers(episodes)):
        assert line in out
    assert f"  Episodes: {len(episodes)}\n" in out
    assert re.search(r"  Success Rate: 50\.0% ", out)
    assert max(map(len, out.splitlines())) <= 110
    assert list(tmp_path.iterdir()) == [path]  # without a flag nothing is written


def test_the_published_verdict_stands_beside_what_uniform_attention_gives(tmp_path, capsys):
    path, replans = ours(tmp_path)
    _, out, _ = run(capsys, "--results", path)
    cells = replans.cells.filter(layer="layers_avg")
    lift = np.mean(cells["ratio_mean"].to_numpy() / (512 / 14))
    first, *more = out.split("→ Model is VISUAL-dominant (prefers visual features)\n")[1].splitlines()
    said = " ".join([first, *more[:2]])
    assert re.search(r"\b36\.57 \(512 .* 14 keys\)", " ".join(said.split()))
    assert format_number(lift) in said
    # A file of the published scripts has no numbers of keys.
    _, out, _ = run(capsys, "--results", write_published(tmp_path, "theirs", pi_episodes()))
    assert "36.57" not in out


def test_layers_and_tasks_have_their_own_means(tmp_path, capsys):
    episodes = pi_episodes()
    _, out, _ = run(capsys, "--results", write_published(tmp_path, "libero_10", episodes))
    for task in range(3):
        steps = [s for e in episodes if e["task_id"] == task for s in e["per_step_ratios"]["layers_avg"]]
        ratios = [step["visual_linguistic_ratio"] for step in steps]
        assert f"{np.mean(ratios):.3f} ± {np.std(ratios):.3f}" in next(
            x for x in out.splitlines() if x.startswith(f"{task} ")
        )
    for layer in (25, 26, 27):
        steps = [s for e in episodes for s in e["per_step_ratios"][f"layer_{layer}"]]
        mean = np.mean([step["visual_linguistic_ratio"] for step in steps])
        assert f"{mean:.3f} ±" in next(x for x in out.splitlines() if x.startswith(f"{layer} "))


def test_several_suites_are_summarised_one_by_one_and_combined(tmp_path, capsys):
    first, second = pi_episodes(seed=1), pi_episodes(seed=2, tasks=2)
    write_published(tmp_path, "libero_goal", first)
    write_published(tmp_path, "libero_10", second)
    summary = tmp_path / "out" / "summary.txt"
    code, out, _ = run(capsys, "--results", tmp_path, "--output", summary)
    assert code == 0
    titles = re.findall(r"ATTENTION RATIO ANALYSIS: (.*)", out)
    assert titles == ["libero_10", "libero_goal", "COMBINED"]
    combined = out.split("ATTENTION RATIO ANALYSIS: COMBINED")[1]
    for line in printed_block(published_numbers(second + first)):
        assert line in combined
    assert "  Tasks: 5\n" in combined
    assert summary.read_text() in out


@pytest.mark.thorough
@pytest.mark.drawn
def test_every_picture_has_its_vector_version_and_its_numbers(tmp_path, capsys):
    path = write_published(tmp_path, "libero_10", pi_episodes(dark=0.1))
    folder = tmp_path / "pictures"
    run(capsys, "--results", path, "--plot-all", "--output-dir", folder)
    stems = ("ratio_distribution", "ratio_per_task", "attention_fractions")
    assert sorted(file.name for file in folder.iterdir()) == sorted(
        f"{stem}.{end}" for stem in stems for end in ("png", "pdf", "csv")
    )
    for flag, stem in zip(("--plot-distribution", "--plot-per-task", "--plot-fractions"), stems, strict=True):
        alone = tmp_path / stem
        run(capsys, "--results", path, flag, "--output-dir", alone)
        assert sorted(file.suffix for file in alone.iterdir()) == [".csv", ".pdf", ".png"]
        assert (alone / f"{stem}.png").read_bytes() == (folder / f"{stem}.png").read_bytes()


@pytest.mark.parametrize("unknown", [1, 2, 0])
@pytest.mark.parametrize("episodes", [pi_episodes, cosmos_episodes])
def test_outcomes_that_are_not_known_are_no_failures(tmp_path, capsys, episodes, unknown):
    given = episodes()
    for episode in given[: unknown or None]:
        episode["success"] = None
    known = [episode["success"] for episode in given if episode["success"] is not None]
    path = write_published(tmp_path, "libero_10", given)
    other = write_published(tmp_path, "libero_90", given)
    code, out, err = run(
        capsys, "--results", path, other, "--plot-all", "--plot-comparison", "--output-dir", tmp_path / "plots"
    )
    assert (code, err) == (0, "")
    rate = f"{np.mean(known):.1%} ({sum(known)} of {len(known)}); of {unknown} episodes" if known else "not known"
    assert f"  Success Rate: {rate}" in out


def test_our_files_and_published_ones_are_compared_side_by_side(tmp_path, capsys):
    mine, _ = ours(tmp_path / "mine")
    theirs = write_published(tmp_path / "theirs", "libero_10", pi_episodes())
    cosmos = write_published(tmp_path / "cosmos", "libero_goal", cosmos_episodes())
    folder = tmp_path / "out"
    code, out, err = run(capsys, "--results", mine, theirs, cosmos, "--plot-comparison", "--output-dir", folder)
    assert (code, err) == (0, "")
    assert "COMBINED" not in re.findall(r"ANALYSIS: (.*)", out)
    data = pl.read_csv(folder / "results_comparison.csv")
    assert data["file"].to_list() == ["mine/libero_10", "theirs/libero_10", "libero_goal"]
    assert data["layer"].to_list() == ["layers_avg", "layers_avg", "25"]
    episodes = json.loads(theirs.read_text())
    means = [
        np.mean([np.log(step["visual_linguistic_ratio"]) for step in episode["per_step_ratios"]["layers_avg"]])
        for episode in episodes
    ]
    row = data.row(1, named=True)
    assert row["geometric_mean"] == pytest.approx(np.exp(np.mean(means)))
    assert row["num_episodes"] == 12
    assert row["geometric_mean_low"] < row["geometric_mean"] < row["geometric_mean_high"]
    # Without the comparison, masses of different kinds are refused.
    code, out, err = run(capsys, "--results", theirs, cosmos)
    assert code == 2
    assert out == ""
    assert re.search(r"theirs/.*cosmos/.*--plot-comparison", err)
    assert len(err.splitlines()) == 1


def test_ratios_that_are_all_infinite_are_reported_and_pictures_are_drawn(tmp_path, capsys):
    path = write_published(tmp_path, "libero_10", pi_episodes(dark=1.0))
    folder = tmp_path / "pictures"
    code, out, _ = run(capsys, "--results", path, path.parent, "--plot-all", "--output-dir", folder)
    assert code == 0
    assert re.search(r"\b96 .* 96 undefined", out)
    assert "dominant" not in out
    assert len(list(folder.iterdir())) == 9
    mine, _ = ours(tmp_path / "mine", no_denominator=1.0)
    code, out, _ = run(capsys, "--results", mine, path, "--plot-comparison", "--output-dir", tmp_path / "compared")
    assert code == 0
    assert len(list((tmp_path / "compared").iterdir())) == 6


def test_episodes_without_steps_count_and_are_named(tmp_path, capsys):
    episodes = pi_episodes(tasks=2, episodes=2)
    episodes[3].update(per_step_ratios={}, summary={})
    _, out, _ = run(capsys, "--results", write_published(tmp_path, "s", episodes))
    assert "  Episodes: 4\n" in out
    assert ": task 1 episode 1\n" in out
    del episodes[0]["per_step_ratios"]["layers_avg"]
    _, out, _ = run(capsys, "--results", write_published(tmp_path, "t", episodes))
    assert re.search("1 episode .*layers_avg", " ".join(out.split()))


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["--results", "nothing*.json"], "--results nothing*.json"),
        (["--results", "one.json", "--plot-comparison"], "--plot-comparison"),
        (["--results", "one.json", "--output", "one.json/x.txt"], "one.json/x.txt"),
        (["--results", "one.json", "--plot-all", "--output-dir", "one.json"], "one.json"),
    ],
)
def test_mistakes_end_with_one_line(tmp_path, capsys, monkeypatch, words, named):
    monkeypatch.chdir(tmp_path)
    Path("one.json").write_text(json.dumps(pi_episodes(tasks=1, episodes=1)))
    code, _, err = run(capsys, *words)
    assert code == 2
    assert named in err
    assert len(err.splitlines()) == 1


def test_a_file_written_from_a_table_and_its_table_say_the_same(tmp_path, capsys):
    path, replans = ours(tmp_path)
    _, out, _ = run(capsys, "--results", path)
    ratios = replans.cells.filter(layer="layers_avg")["ratio_mean"].to_numpy()
    assert f"  Mean:   {ratios.mean():.3f} ± {ratios.std():.3f}" in out
