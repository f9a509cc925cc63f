"""One replan has one ratio, whoever prints it: the geometric mean over layers of ratios of the masses' means.

The masses are means over denoise steps, heads and queries. Expected values are made from the rows of the steps' table.
"""

from __future__ import annotations

import re

import numpy as np
import polars as pl
import pytest

import vla_attention as va
from tests.analyze.view.page_answers import PageQuestion, needs_node, page_answers
from tests.kit.http_ranges import serve
from vla_attention.analyze.__main__ import main
from vla_attention.analyze.show.numbers import format_number
from vla_attention.example_stores import CUBES

EPISODE = {"task_id": 0, "episode_index": 0}


@pytest.fixture(scope="module")
def ratios() -> list[float]:
    """Of each replan of the first episode, over all layers."""
    steps = va.open(CUBES).masses("steps", per_head=True, tasks=0).filter(**EPISODE)
    means = steps.group_by("replan", "layer", "group").agg(pl.col("mass").mean())
    table = means.pivot(on="group", index=["replan", "layer"], values="mass").with_columns(
        (pl.col("visual") / pl.col("linguistic")).alias("ratio")
    )
    logs = table.group_by("replan").agg(pl.col("ratio").log().mean()).sort("replan")["ratio"]
    mean = table.group_by("replan").agg(pl.col("ratio").mean()).sort("replan")["ratio"]
    assert (mean.to_numpy() > 1.2 * np.exp(logs.to_numpy())).all()  # the means can be told apart
    return np.exp(logs.to_numpy()).tolist()


def test_tables_have_it_and_the_published_mean_by_its_name(ratios):
    rows = va.open(CUBES).ratios("replans", tasks=0).filter(layer="layers_avg", **EPISODE).sort("replan")
    assert rows["ratio"].to_list() == pytest.approx(ratios, rel=1e-6)
    assert (rows["uniform_ratio"] * rows["ratio_lift"]).to_list() == pytest.approx(ratios, rel=1e-6)
    assert (2 ** rows["log2_ratio"]).to_list() == pytest.approx(ratios, rel=1e-6)
    assert (rows["ratio_mean"] > 1.2 * rows["ratio"]).all()
    # The mean of an episode's ratios is what it was; its geometric mean is that of the replans' ratios.
    episode = va.open(CUBES).ratios("episodes", tasks=0).filter(layer="layers_avg", **EPISODE)
    assert episode["ratio_mean"][0] == pytest.approx(rows["ratio_mean"].mean())
    assert episode["geometric_mean"][0] == pytest.approx(np.exp(np.log(ratios).mean()), rel=1e-6)


def test_overlay_prints_and_writes_it(ratios, tmp_path, capsys):
    words = ["overlay", str(CUBES), "--task", "0", "--episode", "0", "--output", str(tmp_path)]
    assert main(words) == 0
    printed = capsys.readouterr().out
    assert "ratio: geometric mean of the layers." in printed
    for replan, ratio in enumerate(ratios):
        assert re.search(rf"^ *{replan} +\d+ +{re.escape(format_number(ratio))} ", printed, re.MULTILINE), printed
    (table,) = tmp_path.glob("*.csv")
    written = pl.read_csv(table).select("replan", "ratio").unique().sort("replan")
    assert written["ratio"].to_list() == pytest.approx(ratios, rel=1e-6)
    # Of one layer there is nothing to say.
    assert main([*words, "--layers", "2", "--no-plots"]) == 0
    assert "geometric mean of the layers" not in capsys.readouterr().out


def test_the_report_shows_it_below_its_slider(ratios, tmp_path):
    page = tmp_path / "report.html"
    assert main(["report", str(CUBES), "--quick", "--episodes", "1", "--task", "0", "--output", str(page)]) == 0
    shown = re.findall(r"replan (\d+)\b[^\"<]*?, ratio ([0-9.]+)", page.read_text(encoding="utf-8"))
    found = {int(replan): ratio for replan, ratio in shown}
    assert found == {replan: format_number(ratio) for replan, ratio in enumerate(ratios)}


def test_plots_draw_it(ratios, tmp_path):
    assert main([str(CUBES), "--task", "0", "--save-viz", "--output", str(tmp_path)]) == 0
    found = 0
    for path in tmp_path.rglob("*.csv"):
        table = pl.read_csv(path)
        if not {"ratio", "replan", "layer"} <= set(table.columns):
            continue
        rows = table.filter(pl.col("layer").cast(pl.String) == "layers_avg", **EPISODE).sort("replan")
        found += not rows.is_empty()
        assert rows.is_empty() or rows["ratio"].to_list() == pytest.approx(ratios, rel=1e-6), path
    assert found >= 2  # the distribution over replans, and the evolution in time


@needs_node
def test_the_page_of_the_viewer_shows_it(ratios, tmp_path):
    with serve(CUBES.parent) as served:
        (answer,) = page_answers(tmp_path, [PageQuestion(f"{served.url}/", f"{CUBES.name}/", packed=True)])
    shown = [float(replan["ratio"][0]) for replan in answer["replans"]]
    assert shown == pytest.approx(ratios, rel=2e-6)
