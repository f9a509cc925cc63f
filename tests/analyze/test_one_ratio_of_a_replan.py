"""One replan has one ratio, whoever prints it: the geometric mean over layers of ratios of the masses' means.

The masses are means over denoise steps, heads and queries. Expected values are made from the rows of the steps' table.
"""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest

import vla_attention as va
from tests.kit.archives import example_store

EPISODE = {"task_id": 0, "episode_index": 0}


@pytest.fixture(scope="module")
def ratios() -> list[float]:
    """Of each replan of the first episode, over all layers."""
    steps = va.open(example_store("cubes")).analyze(per_head=True, tasks=0)["steps_groups"].filter(**EPISODE)
    means = steps.group_by("replan", "layer", "group").agg(pl.col("mass").mean())
    table = means.pivot(on="group", index=["replan", "layer"], values="mass").with_columns(
        (pl.col("visual") / pl.col("linguistic")).alias("ratio")
    )
    logs = table.group_by("replan").agg(pl.col("ratio").log().mean()).sort("replan")["ratio"]
    mean = table.group_by("replan").agg(pl.col("ratio").mean()).sort("replan")["ratio"]
    assert (mean.to_numpy() > 1.2 * np.exp(logs.to_numpy())).all()  # the means can be told apart
    return np.exp(logs.to_numpy()).tolist()


def test_tables_have_it_and_the_published_mean_by_its_name(ratios):
    rows = (
        va.open(example_store("cubes")).analyze(tasks=0)["replans"].filter(layer="layers_avg", **EPISODE).sort("replan")
    )
    assert rows["ratio"].to_list() == pytest.approx(ratios, rel=1e-6)
    assert (rows["uniform_ratio"] * rows["ratio_lift"]).to_list() == pytest.approx(ratios, rel=1e-6)
    assert (2 ** rows["log2_ratio"]).to_list() == pytest.approx(ratios, rel=1e-6)
    assert (rows["ratio_mean"] > 1.2 * rows["ratio"]).all()
    # The mean of an episode's ratios is what it was; its geometric mean is that of the replans' ratios.
    episode = va.open(example_store("cubes")).analyze(tasks=0)["episodes"].filter(layer="layers_avg", **EPISODE)
    assert episode["ratio_mean"][0] == pytest.approx(rows["ratio_mean"].mean())
    assert episode["geometric_mean"][0] == pytest.approx(np.exp(np.log(ratios).mean()), rel=1e-6)


def test_overlay_has_it(ratios):
    table = va.open(example_store("cubes")).overlay(tasks=0, episode=0)["overlay"]
    assert table["ratio"].to_list() == pytest.approx(ratios * 2, rel=1e-6)  # on both cameras
