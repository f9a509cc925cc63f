"""Heads and sinks of random and planted stores against independent arithmetic on raw Zarr arrays."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import polars as pl
import pytest
import zarr
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from polars.testing import assert_frame_equal

from tests.kit.examples import examples
from tests.kit.made_up_steps import flat
from tests.kit.questions import question_about
from vla_attention.analyze.heads.head_measures import ranked_heads
from vla_attention.analyze.heads.head_study import study_heads
from vla_attention.analyze.heads.row_metrics import RowOptions
from vla_attention.analyze.heads.text import heads_sections
from vla_attention.analyze.measures.sinks import SinkRule, search_sinks, without_sinks
from vla_attention.analyze.ratios.analysis import analyse
from vla_attention.analyze.show.answer import text_of
from vla_attention.schemas.groupings.resolve import resolve
from vla_attention.schemas.precision import mass_error_bound
from vla_attention.testing.stores import StoreSpec, write_store
from vla_attention.testing.strategies import episode_tokens
from vla_attention.testing.tokens import valid_keys

QUICK = settings(
    max_examples=examples(4),
    phases=[Phase.explicit, Phase.generate],
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow],
)
BOUND = mass_error_bound(10) + 1e-4


def raw_rows(path: Path, episode: str) -> np.ndarray:
    """Rows (replan, layer, denoise, head, key), mean over the stored queries."""
    return zarr.open_group(path / "episodes" / episode, mode="r")["joint/rows"][:].astype(np.float64).mean(axis=4)


@QUICK
@given(data=st.data())
def test_heads_equal_sums_over_raw_rows(data):
    tokens = data.draw(episode_tokens())
    with_rows = data.draw(st.booleans())
    wanted = data.draw(st.sampled_from([{}, {"grouping": "objects"}]))
    with tempfile.TemporaryDirectory() as folder:
        path = write_store(Path(folder) / "a.zarr", tokens=tokens, tasks=(0,), episodes=2)
        question = question_about(path, **wanted)
        study = study_heads(question, RowOptions() if with_rows else None)
        rows = [raw_rows(path, f"task000_episode{i:03d}") for i in range(2)]
    grouping, names = question.grouping, question.grouping.names
    resolved = resolve(grouping, tokens)
    weights = np.broadcast_to(resolved.weights, (len(rows[0]), rows[0].shape[-1], len(names))).astype(np.float64)
    assert grouping.ratio is not None
    top = [names.index(name) for name in grouping.ratio.numerator]
    bottom = [names.index(name) for name in grouping.ratio.denominator]
    masses = [
        np.einsum("rldhk,rkg->rldhg", part, weights).mean(axis=2) for part in rows
    ]  # (replan, layer, head, group)
    for row in flat(study.heads).iter_rows(named=True):
        layer, head = question.selection.blocks.index(row["block"]), row["head"]
        own = [mass[:, layer, head] for mass in masses]
        for i, name in enumerate(names):
            expected = np.mean([(mass[:, i] / mass.sum(axis=1)).mean() for mass in own])
            assert row[f"{name}_fraction"] == pytest.approx(expected, rel=2 * BOUND, abs=1e-9)
        logs = [np.log2(mass[:, top].sum(axis=1) / mass[:, bottom].sum(axis=1)).mean() for mass in own]
        assert row["log2_ratio"] == pytest.approx(np.mean(logs), abs=5 * BOUND)
        quotient = np.mean([mass[:, top].sum(axis=1).mean() for mass in own])
        quotient /= np.mean([mass[:, bottom].sum(axis=1).mean() for mass in own])
        assert row["ratio_of_means"] == pytest.approx(quotient, rel=4 * BOUND)
        uniform = np.log2(weights[:, :, top].sum(axis=(1, 2)) / weights[:, :, bottom].sum(axis=(1, 2)))
        lifts = [(np.log2(mass[:, top].sum(axis=1) / mass[:, bottom].sum(axis=1)) - uniform).mean() for mass in own]
        assert row["log2_lift"] == pytest.approx(np.mean(lifts), abs=5 * BOUND)
    for row in study.dispersion.iter_rows(named=True):
        layer = question.selection.blocks.index(row["block"])
        shares = [(mass[:, layer][..., top].sum(axis=-1) / mass[:, layer].sum(axis=-1)).mean(axis=0) for mass in masses]
        assert row["fraction_std"] == pytest.approx(np.mean([np.std(share) for share in shares]), abs=5 * BOUND)
    for row in study.depth.filter(of="mass").iter_rows(named=True):
        i = names.index(row["group"])
        centres = [np.average(question.selection.blocks, weights=mass[..., i].mean(axis=(0, 2))) for mass in masses]
        assert row["centre"] == pytest.approx(np.mean(centres), abs=10 * BOUND)


def test_a_head_of_the_grid_equals_an_analysis_of_that_head_alone(tmp_path):
    path = write_store(tmp_path / "a.zarr", tasks=(0, 1), episodes=3)
    study = study_heads(question_about(path))
    alone = analyse(question_about(path, heads=(1,), layers=(2,)))
    expected = flat(alone.tasks).filter(scope="all", layer="2").row(0, named=True)
    row = flat(study.heads).filter(block=2, head=1).row(0, named=True)
    assert 2 ** row["log2_ratio"] == pytest.approx(expected["geometric_mean"])
    assert 2 ** row["log2_ratio_low"] == pytest.approx(expected["geometric_mean_low"])
    assert row["visual_fraction_high"] == pytest.approx(expected["visual_fraction_high"])
    assert row["ratio_of_means"] == pytest.approx(expected["ratio_of_means"])
    of_step = flat(analyse(question_about(path, denoise=("9",))).tasks)
    step = of_step.filter(scope="all", layer="layers_avg").row(0, named=True)
    found = flat(study.denoise).filter(denoise_step=9).row(0, named=True)
    assert found["denoise_time"] == pytest.approx(0.1)
    for name in ("ratio_mean", "ratio_mean_low", "visual_fraction", "uniform_ratio"):
        assert found[name] == pytest.approx(step[name])


# --- planted truths ---------------------------------------------------------------------------------------------------


def plant_specialists(task, episode, tokens, rows):
    """Layer 2, head 1 attends to images; layer 0, head 0 to text; all others are alike."""
    valid = np.broadcast_to(tokens.valid, tokens.key_role.shape)
    planted = np.broadcast_to(valid[:, None, None, None, None, :], rows.shape).astype(np.float64).copy()
    planted[:, 1, :, 1, :, :16] *= 30.0
    span = tokens.layout.span("prompt")
    planted[:, 0, :, 0, :, span.start : span.stop] *= 30.0
    noise = np.random.default_rng([task, episode]).normal(0, 0.1, planted.shape)
    planted *= np.exp(noise)
    return planted / planted.sum(axis=-1, keepdims=True)


def test_planted_specialist_heads_are_found_and_named(tmp_path):
    path = write_store(tmp_path / "a.zarr", spec=StoreSpec(plant_rows=plant_specialists, tasks=(0, 1, 2), episodes=3))
    study = study_heads(question_about(path), RowOptions())
    ranked = ranked_heads(study.heads, study.question.grouping)
    first, last = ranked.row(0, named=True), ranked.row(-1, named=True)
    assert (first["block"], first["head"]) == (2, 1)
    assert (last["block"], last["head"]) == (0, 0)
    assert first["log2_lift_low"] > 0 > last["log2_lift_high"]
    text = text_of(heads_sections(study, top=1))
    lines = text.splitlines()
    assert ranked.height == 4
    looking = lines.index("HEADS IN ORDER OF lift of the ratio: the first 1 of 4")
    reading = lines.index("and the last 1")
    assert lines[looking + 4].split()[:2] == ["2", "1"]
    assert lines[reading + 4].split()[:2] == ["0", "0"]
    assert max(map(len, lines)) <= 100


def plant_sinks(task, episode, tokens, rows):
    """Key 5 takes half of every row of task 1 and the bos key a third of three quarters of the rows of all tasks."""
    planted = rows.astype(np.float64).copy()
    if task == 1:
        planted *= 0.5 / (planted.sum(axis=-1, keepdims=True) - planted[..., 5:6])
        planted[..., 5] = 0.5
    bos = tokens.layout.span("prompt").start
    listed = planted.reshape(-1, planted.shape[-1])
    for i, row in enumerate(listed):
        if i % 4:
            row *= (2 / 3) / (row.sum() - row[bos])
            row[bos] = 1 / 3
    return listed.reshape(planted.shape) / listed.reshape(planted.shape).sum(axis=-1, keepdims=True)


@pytest.fixture(scope="module")
def sunken(tmp_path_factory) -> Path:
    return write_store(
        tmp_path_factory.mktemp("sinks") / "a.zarr", spec=StoreSpec(plant_rows=plant_sinks, tasks=(0, 1), episodes=2)
    )


RULE = SinkRule(factor=5.0, share=0.7)


def test_planted_sinks_are_found_and_named_per_task(sunken):
    question = question_about(sunken)
    sinks = search_sinks(question, RULE).sinks
    bos = question.selected[0].tokens.layout.span("prompt").start
    assert sinks.select("task_id", "key").rows() == [(0, bos), (1, 5), (1, bos)]
    patch = sinks.filter(key=5).row(0, named=True)
    assert (patch["span"], patch["role"], patch["patch_row"], patch["patch_column"]) == ("base_0_rgb", "image", 1, 1)
    assert "patch (1, 1)" in patch["description"]
    assert sinks.filter(key=bos)["role"].unique().to_list() == ["bos"]
    of_study = study_heads(question, RowOptions(rule=RULE)).search
    assert of_study is not None
    assert_frame_equal(of_study.sinks, sinks, rel_tol=1e-5)
    # The numbers, by hand.
    for row in sinks.iter_rows(named=True):
        above, held = [], []
        for episode in range(2):
            rows = raw_rows(sunken, f"task{row['task_id']:03d}_episode{episode:03d}")
            item = question.selected[2 * row["task_id"] + episode]
            valid = np.broadcast_to(valid_keys(item.tokens.key_role), (len(rows), rows.shape[-1]))[:, None, None, None]
            share = rows * valid / (rows * valid).sum(axis=-1, keepdims=True)
            above.append((share > 5.0 / valid.sum(axis=-1, keepdims=True))[..., row["key"]].mean())
            held.append(share[..., row["key"]].mean())
        assert row["share_of_rows"] == pytest.approx(np.mean(above))
        assert row["mean_mass"] == pytest.approx(np.mean(held), rel=1e-3)


def test_masses_without_sinks_are_those_of_the_remaining_keys(sunken):
    question = question_about(sunken)
    sinks = search_sinks(question, RULE).sinks
    corrected = without_sinks(question, sinks, RULE)
    assert corrected.grouping.name == "default-without-sinks"
    analysis = analyse(corrected)
    steps, replans = flat(analysis.steps), flat(analysis.replans)
    bos = question.selected[0].tokens.layout.span("prompt").start
    for index, item in enumerate(question.selected):
        task, episode = divmod(index, 2)
        out = [bos, 5] if task == 1 else [bos]
        rows = raw_rows(sunken, f"task{task:03d}_episode{episode:03d}").mean(axis=3)  # (replan, layer, denoise, key)
        resolved = resolve(question.grouping, item.tokens)
        weights = np.broadcast_to(resolved.weights, (len(rows), rows.shape[-1], len(resolved.names))).copy()
        weights[:, out] = 0.0
        valid = np.broadcast_to(valid_keys(item.tokens.key_role), (len(rows), rows.shape[-1])).copy()
        valid[:, out] = False
        mass = np.einsum("rldk,rkg->rldg", rows, weights)
        part = steps.filter(task_id=task, episode_index=episode)
        visual, linguistic = (resolved.names.index(name) for name in ("visual", "linguistic"))
        given = part["visual_mass"].to_numpy().reshape(mass.shape[:3])
        np.testing.assert_allclose(given, mass[..., visual], rtol=BOUND)
        np.testing.assert_allclose(
            part["ratio"].to_numpy().reshape(mass.shape[:3]), mass[..., visual] / mass[..., linguistic], rtol=2 * BOUND
        )
        np.testing.assert_allclose(
            part["visual_fraction"].to_numpy().reshape(mass.shape[:3]),
            mass[..., visual] / mass.sum(axis=-1),
            rtol=2 * BOUND,
        )
        held = np.einsum("rldk,rk->rld", rows, valid)
        lift = (mass[..., visual] / weights[:, :, visual].sum(axis=1)[:, None, None]) / (
            held / valid.sum(axis=1)[:, None, None]
        )
        np.testing.assert_allclose(part["visual_lift"].to_numpy().reshape(lift.shape), lift, rtol=3 * BOUND)
        uniform = weights[:, :, visual].sum(axis=1) / weights[:, :, linguistic].sum(axis=1)
        np.testing.assert_allclose(part["uniform_ratio"].to_numpy().reshape(lift.shape)[:, 0, 0], uniform, rtol=1e-6)
        # The same over all denoise steps: the baseline is that of the remaining keys, too.
        whole = replans.filter(task_id=task, episode_index=episode, layer="2").sort("replan")
        averaged = mass[:, 1, :, visual].mean(axis=1) / weights[:, :, visual].sum(axis=1)
        baseline = held[:, 1].mean(axis=1) / valid.sum(axis=1)
        np.testing.assert_allclose(whole["visual_lift"].to_numpy(), averaged / baseline, rtol=3 * BOUND)


# --- the command ------------------------------------------------------------------------------------------------------


@pytest.mark.drawn
def test_the_command_writes_tables_and_pictures_and_names_the_nearest_key(tmp_path, capsys):
    from vla_attention.analyze.__main__ import main

    path = write_store(tmp_path / "a.zarr")
    assert (
        main(["heads", str(path), "--output", str(tmp_path / "out"), "--sink-factor", "1000", "--top", "2", "--pdf"])
        == 0
    )
    assert "SINKS" in capsys.readouterr().out
    said = (tmp_path / "out" / "summary.txt").read_text()
    assert "The key that comes nearest, key " in " ".join(said.split())
    pairs, single = ("heads", "denoise", "row_metrics"), ("dispersion", "depth", "sinks", "sink_heads")
    pictures_of_groups = ("head_grid", "layer_profile", "denoise_profile")
    pictures = (*pictures_of_groups, "layer_time")
    written = {file.name for file in (tmp_path / "out").iterdir()}
    assert written == (
        {f"{name}.parquet" for name in (*pairs, *single)}
        | {f"{name}_groups.parquet" for name in pairs}
        | {f"{name}.{kind}" for name in pictures for kind in ("png", "pdf", "csv")}
        | {f"{name}_groups.csv" for name in pictures_of_groups}
        | {"summary.txt"}
    )
    rows, groups = (pl.read_parquet(tmp_path / "out" / f"row_metrics{end}.parquet") for end in ("", "_groups"))
    assert rows.height == 4 * 3 * 2 * 2 * 2
    assert groups.height == rows.height * groups["group"].n_unique()
    assert groups["row"].unique().sort().to_list() == rows["row"].to_list()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--top", "0"], "expected at least 1"),
        (["--top-k", "0"], "whole numbers from 1"),
        (["--sink-share", "2"], "no share of rows"),
        (["--heads", "7"], "was not recorded"),
    ],
)
def test_bad_arguments_end_in_one_sentence(arguments, said, tmp_path, capsys):
    from vla_attention.analyze.__main__ import main

    path = write_store(tmp_path / "a.zarr", tasks=(0,), episodes=1)
    assert main(["heads", str(path), *arguments]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1
