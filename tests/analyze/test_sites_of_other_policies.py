"""Stores of other policies: sites in some of the blocks, keys that come and go, unknown outcomes, no pictures."""

from __future__ import annotations

from itertools import product
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from tests.kit.questions import question_about
from tests.kit.site_stores import write_site_store
from tests.kit.thorough import thorough_except
from vla_attention.analyze.__main__ import main as analyze
from vla_attention.analyze.commands.analyze import analyze as ask_analyze
from vla_attention.analyze.core.contributions import side_norms
from vla_attention.analyze.core.levels import levels_of
from vla_attention.schemas.errors import BadArgument

KINDS = ("alternating", "split", "growing")


@pytest.fixture(scope="module")
def stores(tmp_path_factory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("stores")
    made = {
        kind: write_site_store(folder / f"{kind}.zarr", kind=kind, outcome="some", dataset_actions=0.5)
        for kind in KINDS
    }
    bare = {"actions": False, "state": False, "frames": False, "contributions": False, "outcome": "unknown"}
    made["bare"] = write_site_store(folder / "bare.zarr", kind="growing", **bare)
    return made


@pytest.mark.parametrize(("queries", "grouping"), [("mean", "default"), ("all", "instruction")])
def test_uniform_attention_has_the_lift_one(tmp_path, queries, grouping):
    replans = 1 if queries == "all" else 4  # with all queries, every replan has as many
    path = write_site_store(tmp_path / "a.zarr", kind="growing", spread=0, queries=queries, replans=replans)
    question = question_about(path, grouping)
    levels = levels_of(question)
    groups, cells = levels.steps_groups().filter(pl.col("mass") > 0).collect(), levels.steps().collect()
    np.testing.assert_allclose(groups["lift"].to_numpy(), 1.0, rtol=2e-3)
    assert {"action", "linguistic"} <= set(groups["group"])
    np.testing.assert_allclose(cells["ratio"].to_numpy(), cells["uniform_ratio"].to_numpy(), rtol=2e-3)
    assert (groups["keys"] % 1 == 0).all(), "keys are counted, whoever sees them"
    generated = groups.filter(group="action")["keys"].to_numpy()
    assert set(generated) == ({6.0} if queries == "all" else {4.0, 5.0, 6.0}), "absent keys count for nothing"


def test_absent_keys_are_never_called_padding(stores, capsys):
    groups = levels_of(question_about(stores["growing"])).steps_groups().collect()
    assert (groups.filter(group="padding")["keys"] == 0).all()
    analyze(["analyze", str(stores["growing"]), "--no-plots", "--output", str(stores["growing"].parent / "out")])
    assert "padding" not in capsys.readouterr().out


def test_layers_that_a_site_lacks(stores):
    with pytest.raises(BadArgument, match=r"Layers 0 .*'cross'; .* 1, 3"):
        question_about(stores["alternating"], site="cross", layers=(0, 1))
    with pytest.raises(BadArgument, match=r"Head 2 .*'cross'; .* 0, 1\."):
        question_about(stores["alternating"], site="cross", heads=(2,))
    question = question_about(stores["alternating"], site="cross", layers=(3,))
    assert (question.selection.layers, question.selection.blocks) == ((1,), (3,))
    assert "site 'cross'" not in "".join(question.notes)


def test_masses_of_a_site_are_those_of_its_own_rows(stores):
    question = question_about(stores["alternating"], site="cross", layers=(3,))
    for measured in levels_of(question).measured:
        rows = measured.item.episode.read("cross/rows")[:, 1]  # block 3 is the second of the site
        image = rows[..., :16].sum(axis=-1, dtype=np.float64).mean(axis=(2, 3))  # (replan, denoise)
        np.testing.assert_allclose(measured.mass[:, 0, :, 0, 0], image, rtol=1e-3)


def test_contributions_of_sites_in_different_blocks(stores):
    question = question_about(stores["split"])
    norms = side_norms(question)
    assert norms is not None
    table = norms.cells().collect()
    assert table["block"].unique().sort().to_list() == [0, 1, 2, 3]
    assert table["contribution_ratio"].is_null().all()
    of_image = table.filter(pl.col("block").is_in([1, 3]))
    assert of_image["linguistic_norm"].is_null().all()
    assert of_image["visual_norm"].is_not_null().all()
    gram = question.selected[0].episode.read("image/contribution")[0, 1, 1].astype(np.float64)  # block 3, step 1
    first = of_image.filter(task_id=0, episode_index=0, replan=0, block=3, denoise_step=1)
    assert first["visual_norm"].item() == pytest.approx(np.sqrt(gram[:-1, :-1].sum()), rel=1e-5)
    result = ask_analyze(question)
    row = result["contributions"].filter(layer="layers_avg").row(0, named=True)
    steps = table.group_by("task_id", "episode_index", "replan", "denoise_step").agg(
        pl.col("visual_norm", "linguistic_norm").mean()
    )
    logs = steps.with_columns((pl.col("visual_norm") / pl.col("linguistic_norm")).log().alias("log"))
    per_episode = logs.group_by("task_id", "episode_index").agg(pl.col("log").mean())
    assert row["geometric_mean"] == pytest.approx(np.exp(per_episode["log"].mean()), rel=1e-9)
    assert row["uniform_ratio"] > 0
    assert row["ratio_lift"] > 0
    assert any("visual to linguistic" in note for note in result.notes)
    assert side_norms(question_about(stores["split"], layers=(0, 2))) is None


COMMANDS = (
    "analyze",
    "analyze --list",
    "analyze --by layer,head",
    "analyze --by time",
    "words",
    "overlay",
    "store verify",
    "report",
)
#: Every command once, and every store with the default question.
FAST = [(command, "growing") for command in COMMANDS if command != "report"]
FAST += [("analyze", name) for name in (*KINDS, "bare")]


@pytest.mark.parametrize(("command", "name"), thorough_except(FAST, product(COMMANDS, (*KINDS, "bare")), several=True))
def test_commands(stores, tmp_path, command, name):
    words = command.split()
    at = 1 + (words[0] == "store")
    given = [*words[:at], str(stores[name]), *words[at:]]
    if command != "store verify":
        given += ["--output", str(tmp_path / "out")]
    assert analyze(given) == 0


def test_runs_are_compared_episode_by_episode_where_the_first_state_is_not_known(stores, tmp_path, capsys):
    other = write_site_store(tmp_path / "other.zarr", kind="growing", outcome="some", spread=0.5)
    assert analyze(["compare", str(stores["growing"]), str(other), "--output", str(tmp_path), "--no-plots"]) == 0
    pairs = pl.read_parquet(tmp_path / "pairs.parquet")
    assert (pairs["episode_first"] == pairs["episode_other"]).all()
    assert pairs["episode_first"].n_unique() == 3
