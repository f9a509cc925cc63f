from __future__ import annotations

from dataclasses import replace

import numpy as np
import polars as pl
import pytest

from tests.kit import made_up_steps
from tests.kit.made_up_steps import CUSTOM_KEYS, custom_grouping, default_grouping, make_steps
from vla_attention.analyze.core.levels import overall
from vla_attention.analyze.measures.tables import LAYERS_AVG
from vla_attention.schemas.groupings.grouping import Ratio

GROUPING = default_grouping()
STEPS = make_steps(num_tasks=3, num_episodes=4, heads=(0, 3), no_denominator=0.1)


def replans_of(steps, grouping=GROUPING):
    return made_up_steps.replans_of(steps, grouping)


def episodes_of(steps, grouping=GROUPING):
    return made_up_steps.episodes_of(steps, grouping)


def tasks_of(steps, grouping=GROUPING):
    return made_up_steps.tasks_of(steps, grouping)


def one(table, **values):
    rows = table.filter(*(pl.col(name) == value for name, value in values.items()))
    assert rows.height == 1
    return rows.row(0, named=True)


def test_replans_average_masses_first_and_divide_afterwards():
    part = STEPS.filter(task_id=1, episode_index=2, replan=3, layer=25)
    assert part.height == 4  # two denoise steps, two heads
    row = one(replans_of(STEPS).flat, task_id=1, episode_index=2, replan=3, layer="25")
    assert (row["layer_number"], row["block"], row["env_step"]) == (25, 7, 25)
    visual, linguistic = part["visual_mass"].to_numpy().mean(), part["linguistic_mass"].to_numpy().mean()
    assert row["visual_mass"] == pytest.approx(visual)
    assert row["ratio"] == pytest.approx(visual / linguistic)
    assert row["ratio"] != pytest.approx(part["ratio"].mean())
    assert row["log2_ratio"] == pytest.approx(np.log2(visual / linguistic))
    assert row["uniform_ratio"] == 512 / 14
    assert row["ratio_lift"] == pytest.approx(visual / linguistic / (512 / 14))
    total = sum(part[f"{name}_mass"].mean() for name in GROUPING.names)
    assert row["visual_fraction"] == pytest.approx(visual / total)
    assert row["visual_lift"] == pytest.approx(visual / 512 * 600)
    assert row["other_lift"] is None  # no keys


def test_fractions_of_every_row_sum_to_one():
    for tables in (replans_of(STEPS), episodes_of(STEPS)):
        fractions = tables.groups["fraction"].to_numpy().reshape(tables.cells.height, -1)
        assert fractions.sum(axis=1) == pytest.approx(np.ones(tables.cells.height))


def test_infinite_and_undefined_ratios_differ_and_are_counted():
    steps = make_steps(num_tasks=1, num_episodes=1, num_replans=2, layers=(1,), denoise_steps=(0,))
    steps = steps.with_columns(
        linguistic_mass=pl.lit(0.0),
        denominator_mass=pl.lit(0.0),
        visual_mass=pl.when(pl.col("replan") == 0).then(0.0).otherwise(0.5),
        numerator_mass=pl.when(pl.col("replan") == 0).then(0.0).otherwise(0.5),
    )
    replans = replans_of(steps)
    of_layer = replans.cells.filter(layer="1")
    assert of_layer["ratio"].to_list() == [None, np.inf]
    assert of_layer["nonfinite_layers"].to_list() == [1, 1]
    episode = one(episodes_of(steps).cells, layer="1")
    assert episode["num_nonfinite"] == episode["geometric_left_out"] == 2
    assert episode["ratio_mean"] is None
    assert episode["ratio_of_means"] == np.inf


def test_layers_avg_is_the_geometric_mean_and_has_the_published_one_by_name():
    steps = make_steps(num_tasks=1, num_episodes=1, num_replans=3, denoise_steps=(0,))
    # One layer of one replan without text: its ratio is infinite and must not enter the mean of ratios.
    hit = (pl.col("replan") == 1) & (pl.col("layer") == 25)
    steps = steps.with_columns(
        pl.when(hit).then(0.0).otherwise(pl.col(name)).alias(name) for name in ("linguistic_mass", "denominator_mass")
    )
    table = replans_of(steps).flat
    average, replans = table.filter(layer=LAYERS_AVG), table.filter(pl.col("layer") != LAYERS_AVG)
    assert average["layer_number"].null_count() == average["block"].null_count() == 3
    for replan in range(3):
        layers = replans.filter(replan=replan)
        row = one(average, replan=replan)
        ratio = layers["ratio"].to_numpy()
        finite = ratio[np.isfinite(ratio)]
        assert row["ratio_mean"] == pytest.approx(finite.mean())
        assert row["ratio"] == pytest.approx(np.exp(np.log(finite).mean()))
        assert row["log2_ratio"] == pytest.approx(np.log2(row["ratio"]))
        assert row["ratio_lift"] == pytest.approx(row["ratio"] / row["uniform_ratio"])
        assert layers["ratio_mean"].to_list() == layers["ratio"].to_list()
        assert row["nonfinite_layers"] == (1 if replan == 1 else 0)
        masses = {name: layers[f"{name}_mass"].to_numpy().mean() for name in GROUPING.names}
        assert row["visual_mass"] == pytest.approx(masses["visual"])
        assert row["visual_fraction"] == pytest.approx(masses["visual"] / sum(masses.values()))


def test_layers_avg_without_a_finite_ratio_is_null_not_zero():
    average = replans_of(make_steps(no_denominator=1.0)).cells.filter(layer=LAYERS_AVG)
    assert average["ratio"].null_count() == average["ratio_mean"].null_count() == average.height
    assert average["nonfinite_layers"].unique().to_list() == [3]


def test_the_average_over_layers_prefers_neither_side():
    """The mean of the layers' ratios is above that of either side alone; the mean of logarithms is not."""
    inverse = replace(GROUPING, ratio=Ratio(GROUPING.ratio.denominator, GROUPING.ratio.numerator))
    tables = [
        tasks_of(make_steps(), grouping).cells.filter(layer=LAYERS_AVG, scope="all") for grouping in (GROUPING, inverse)
    ]
    for column in ("geometric_mean", "ratio_lift", "uniform_ratio"):
        forward, backward = (table[column][0] for table in tables)
        assert forward * backward == pytest.approx(1.0)
    assert tables[0]["ratio_mean"][0] * tables[1]["ratio_mean"][0] > 1.01


def test_ratio_over_uniform_is_the_lift_also_where_a_task_has_no_finite_ratio():
    steps = make_steps()
    steps = steps.with_columns(
        pl.when(pl.col("task_id") == 1).then(0.0).otherwise(pl.col("linguistic_mass")).alias("linguistic_mass"),
        pl.when(pl.col("task_id") == 1).then(60.0).otherwise(pl.col("linguistic_keys")).alias("linguistic_keys"),
    )
    row = tasks_of(steps).cells.row(
        by_predicate=(pl.col("scope") == "all") & (pl.col("layer") == LAYERS_AVG), named=True
    )
    assert row["geometric_mean"] / row["uniform_ratio"] == pytest.approx(row["ratio_lift"])


def test_episode_statistics_are_those_of_numpy():
    replans = replans_of(STEPS).flat
    episodes = episodes_of(STEPS).flat
    assert episodes.height == 3 * 4 * 4
    for layer in ("18", LAYERS_AVG):
        part = replans.filter(task_id=2, episode_index=1, layer=layer)
        row = one(episodes, task_id=2, episode_index=1, layer=layer)
        ratio = part["ratio_mean"].fill_null(np.nan).to_numpy()
        finite = ratio[np.isfinite(ratio)]
        assert row["num_replans"] == 6
        assert row["num_nonfinite"] == 6 - len(finite)
        expected = (finite.mean(), finite.std(), np.median(finite), finite.min(), finite.max())
        names = ("mean", "std", "median", "min", "max")
        assert tuple(row[f"ratio_{name}"] for name in names) == pytest.approx(expected)
        logs = part["log2_ratio"].fill_null(np.nan).to_numpy()
        assert row["geometric_mean"] == pytest.approx(2 ** logs[np.isfinite(logs)].mean())
        of_means = part["visual_mass"].to_numpy().mean() / part["linguistic_mass"].to_numpy().mean()
        assert row["ratio_of_means"] == pytest.approx(of_means)
        assert row["visual_mass_std"] == pytest.approx(part["visual_mass"].to_numpy().std())
        assert row["visual_lift"] == pytest.approx(part["visual_lift"].mean())


def test_tasks_are_means_over_episodes_with_intervals_around_them():
    of_tasks = tasks_of(STEPS)
    episodes, tasks = episodes_of(STEPS).flat, of_tasks.flat
    assert tasks.height == (3 + 1) * 4
    for layer in ("18", LAYERS_AVG):
        part = episodes.filter(task_id=1, layer=layer)
        row = one(tasks, task_id=1, layer=layer)
        assert row["num_episodes"] == 4
        assert row["success_rate"] == pytest.approx(part["success"].mean())
        assert row["ratio_mean"] == pytest.approx(part["ratio_mean"].mean())
        assert row["ratio_std"] == pytest.approx(part["ratio_mean"].std(ddof=0))
        assert row["geometric_mean"] == pytest.approx(np.exp(part["log_ratio_mean"].mean()))
        of_means = part["numerator_mass"].mean() / part["denominator_mass"].mean()
        assert row["ratio_of_means"] == pytest.approx(of_means)
        assert row["num_nonfinite"] == part["num_nonfinite"].sum()
        for name in ("ratio_mean", "ratio_of_means", "geometric_mean", "ratio_lift", "visual_fraction"):
            assert row[f"{name}_low"] <= row[name] <= row[f"{name}_high"]
    whole = one(overall(of_tasks.cells), layer=LAYERS_AVG)
    assert (whole["task_id"], whole["num_tasks"], whole["num_episodes"]) == (None, 3, 12)
    assert whole["ratio_mean"] == pytest.approx(episodes.filter(layer=LAYERS_AVG)["ratio_mean"].mean())


def test_results_do_not_depend_on_the_order_of_the_rows():
    shuffled = STEPS.sample(fraction=1.0, shuffle=True, seed=1)
    first, second = (tasks_of(steps).flat for steps in (STEPS, shuffled))
    for name, kind in first.schema.items():
        if kind == pl.Float64:
            plain, other = (table[name].fill_null(-1.0).to_numpy() for table in (first, second))
            assert plain == pytest.approx(other, rel=1e-9), name
        else:
            assert first[name].to_list() == second[name].to_list()


def test_groupings_without_a_ratio_give_masses_fractions_and_lifts_only():
    grouping = custom_grouping(with_ratio=False)
    steps = make_steps(grouping, CUSTOM_KEYS)
    replans, episodes, tasks = (of(steps, grouping) for of in (replans_of, episodes_of, tasks_of))
    for tables in (replans, episodes, tasks):
        assert {"group", "mass", "fraction", "lift"} <= set(tables.groups.columns)
        assert not [name for name in tables.cells.columns if "ratio" in name or "geometric" in name]
    assert tasks.groups.filter(group="base")["fraction_low"].null_count() == 0


def test_same_task_ids_of_two_suites_stay_two_tasks():
    steps = pl.concat([make_steps(), make_steps(suite="libero_goal", seed=5)])
    tasks = tasks_of(steps)
    average = tasks.cells.filter(layer=LAYERS_AVG)
    assert average["scope"].to_list() == [*["task"] * 4, "all", "all", "combined"]
    assert one(average, scope="combined")["num_tasks"] == 4
    assert overall(tasks.cells)["num_episodes"].unique().to_list() == [12]
    assert one(average, scope="combined")["suite"] is None


def test_layers_are_in_the_order_of_their_numbers():
    layers = replans_of(make_steps(layers=(9, 10, 2))).cells["layer"].unique(maintain_order=True)
    assert layers.to_list() == ["2", "9", "10", LAYERS_AVG]


def test_a_ratio_of_some_episodes_says_of_how_many_it_is():
    steps = make_steps(num_tasks=3)
    none = pl.col("task_id") > 0
    steps = steps.with_columns(pl.when(none).then(0.0).otherwise("linguistic_mass").alias("linguistic_mass"))
    row = one(tasks_of(steps).cells.filter(layer=LAYERS_AVG), scope="all")
    assert (row["num_episodes"], row["episodes_with_ratio"], row["tasks_with_ratio"]) == (9, 3, 1)
