from __future__ import annotations

import re
import shutil
from dataclasses import replace

import numpy as np
import polars as pl
import pytest
from msgspec import structs
from scipy import stats

import vla_attention as va
from tests.kit.archives import example_store
from tests.kit.planted_effects import planted_effects
from tests.kit.questions import with_attributes
from tests.kit.stores import StoreSpec, rerun_source, small_steps, write_store
from vla_attention.analyze.__main__ import main
from vla_attention.analyze.commands.compare import compare
from vla_attention.analyze.core import runs as runs_module
from vla_attention.analyze.core.runs import (
    MixedPolicies,
    RunsDiffer,
    check_comparable,
    open_runs,
    parse_runs,
)
from vla_attention.analyze.measures.question_settings import AnalysisSettings
from vla_attention.analyze.render.terminal import screen
from vla_attention.schemas.layout import Role

TASKS, EPISODES = (0, 1, 2, 5), 4


def log_ratio(run, task, episode):
    """Planted: scenes differ a lot and alike in all runs; run 1 is 0.25 higher, run 2 is 0.4 lower."""
    scene = np.random.default_rng([task, episode]).normal(0.5 * task, 0.6)
    own = np.random.default_rng([run, task, episode]).normal(0, 0.04)
    return scene + own + (0.0, 0.25, -0.4)[run]


def planting(run):
    def plant(task, episode, tokens, rows):
        visual = tokens.key_role == Role.IMAGE
        read = np.isin(tokens.key_role, [int(Role.INSTRUCTION), int(Role.BOS)])
        share = 1 / (1 + np.exp(-log_ratio(run, task, episode)))
        weight = share * visual / visual.sum(axis=1, keepdims=True) + (1 - share) * read / read.sum(
            axis=1, keepdims=True
        )
        return np.broadcast_to(weight[:, None, None, None, None, :], rows.shape)

    return plant


PLAIN = StoreSpec(
    tasks=TASKS, episodes=EPISODES, replans=2, layers=(0, 1), heads=(0,), denoise_steps=(9,), frames=False,
    coverage=False, mantissa_bits=23,
)  # fmt: skip


@pytest.fixture(scope="module")
def stores(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    specs = {
        "base": replace(PLAIN, plant_rows=planting(0)),
        "higher": replace(PLAIN, plant_rows=planting(1), policy="tuned"),
        "lower": replace(PLAIN, plant_rows=planting(2), tasks=(1, 2, 5), episodes=5),
        "reseeded": replace(PLAIN, plant_rows=planting(1), seed=8, tasks=(0, 1), episodes=2),
        "goal": replace(PLAIN, plant_rows=planting(1), suite="goal", tasks=(0, 1), episodes=2),
        "goal_base": replace(PLAIN, plant_rows=planting(0), suite="goal", tasks=(0, 1), episodes=2),
        "one_layer": replace(PLAIN, plant_rows=planting(1), layers=(1,), tasks=(0, 1), episodes=2),
    }
    return {name: write_store(folder / f"{name}.zarr", spec=spec) for name, spec in specs.items()}


def opened(stores, *names, allowed=(), **settings):
    return open_runs(parse_runs([str(stores[name]) for name in names]), AnalysisSettings(**settings), allowed)


def one(table, **values):
    rows = table.filter(*(pl.col(name) == value for name, value in values.items()))
    assert rows.height == 1
    return rows.row(0, named=True)


def test_paired_differences_are_those_of_the_planted_pairs(stores):
    found = compare(opened(stores, "base", "higher"))
    expected = {
        (task, episode): (log_ratio(1, task, episode) - log_ratio(0, task, episode)) / np.log(2)
        for task in TASKS
        for episode in range(EPISODES)
    }
    row = one(found["differences"], scope="all", layer="layers_avg", quantity="log2_ratio")
    values = np.array(list(expected.values()))
    assert row["difference"] == pytest.approx(values.mean(), rel=1e-4)
    assert (row["paired"], row["num_first"], row["num_tasks"]) == (True, 16, 4)
    assert row["difference_low"] < 0.25 / np.log(2) < row["difference_high"]
    assert row["difference_low"] > 0.2
    for task in TASKS:
        own = np.array([value for (of, _), value in expected.items() if of == task])
        row = one(found["differences"], scope="task", task_id=task, layer="1", quantity="log2_ratio")
        assert row["difference"] == pytest.approx(own.mean(), rel=1e-3)
        ends = stats.t.interval(0.95, 3, own.mean(), stats.sem(own))
        assert (row["difference_low"], row["difference_high"]) == pytest.approx(ends, rel=1e-2)
    pair = one(found["pairs"], task_id=5, episode_first=3, layer="layers_avg", quantity="log2_ratio")
    assert pair["difference"] == pytest.approx(expected[5, 3], rel=1e-3)
    assert found["unpaired"].is_empty()


def test_with_another_seed_allowed_the_initial_state_alone_makes_a_pair(stores):
    found = compare(opened(stores, "base", "reseeded", allowed=("seed",)), ("seed",))
    row = one(found["differences"], scope="all", layer="layers_avg", quantity="log2_ratio")
    assert (row["paired"], row["num_first"]) == (True, 4)
    assert found["pairs"].height == 4 * 3 * found["pairs"]["quantity"].n_unique()
    assert [note for note in found.notes if "seed" in note]


def test_episodes_without_a_partner_are_counted_and_named(stores):
    runs = opened(stores, "base", "lower")
    found = compare(runs)
    alone = found["unpaired"].group_by("run").len().sort("run").rows()
    assert alone == [("base", 4), ("lower", 3)]
    assert one(found["differences"], scope="all", layer="layers_avg", quantity="log2_ratio")["num_first"] == 12
    text = screen(found)
    assert "task 0 episode 0" in text
    assert "task 1 episode 4" in text


def test_nothing_that_pairs_is_compared_unpaired_and_said(stores):
    runs = opened(stores, "base", "goal", allowed=("suite",))
    found = compare(runs, ("suite",))
    row = one(found["differences"], scope="all", layer="layers_avg", quantity="log2_ratio")
    first = [log_ratio(0, task, episode) / np.log(2) for task in TASKS for episode in range(EPISODES)]
    other = [log_ratio(1, task, episode) / np.log(2) for task in (0, 1) for episode in range(2)]
    assert row["paired"] is False
    assert row["difference"] == pytest.approx(np.mean(other) - np.mean(first), rel=1e-4)
    assert (row["mean_first"], row["mean_other"]) == pytest.approx((np.mean(first), np.mean(other)), rel=1e-4)
    assert row["difference_low"] < row["difference"] < row["difference_high"]
    assert row["difference_high"] - row["difference_low"] > 1.0  # scenes are in it
    assert found["unpaired"].height == 20


def test_a_run_of_several_stores_is_compared_suite_by_suite(stores):
    words = [f"old={stores['base']},{stores['goal_base']}", f"new={stores['higher']},{stores['goal']}"]
    found = compare(open_runs(parse_runs(words), AnalysisSettings()))
    of_ratio = found["differences"].filter(layer="layers_avg", quantity="log2_ratio")
    assert of_ratio["scope"].to_list() == ["task"] * 6 + ["suite"] * 2 + ["all"]
    assert of_ratio.filter(scope="all")["num_first"].to_list() == [20]
    assert of_ratio.filter(scope="all")["num_tasks"].to_list() == [6]


def test_what_libero_pro_changed_is_told_apart_and_paired_where_states_are_shared(tmp_path):
    goal, lan, one_task = "libero_goal", "libero_pro_goal_lan", {"tasks": (0,), "episodes": 1}
    small, seen = replace(PLAIN, tasks=(0, 1, 2), episodes=2), {"coverage": True, "plant_steps": small_steps}
    specs = {
        "base": replace(small, suite=goal, **seen), "lan": replace(small, suite=lan, **seen),
        "tuned": replace(small, suite=lan, policy="tuned"),
        "few": replace(PLAIN, suite=goal, **one_task), "few_object": replace(PLAIN, suite=f"{goal}_object", **one_task),
    }  # fmt: skip
    stores = {name: write_store(tmp_path / f"{name}.zarr", spec=spec) for name, spec in specs.items()}
    words = [f"old={stores['base']},{stores['lan']}", f"new={stores['tuned']}"]
    found = compare(open_runs(parse_runs(words), AnalysisSettings()), ("suite",))
    rows = found["perturbations"].select("kind", "run", "num_episodes", "pairs", "solved").rows()
    solved = [item.episode.attributes.success for item in opened(stores, "base", "tuned")[0].question.selected]
    share = sum(solved) / len(solved)
    assert rows == [
        ("nothing", "old", 6, None, share), ("the sentence", "old", 6, None, share),
        ("the sentence", "new", 6, 6, share),
    ]  # fmt: skip
    assert not found.findings[0].limit
    found = compare(opened(stores, "base", "lan", allowed=("suite",)), ("suite",))
    assert found["perturbations"]["pairs"].to_list() == [None, 0]
    assert found.findings[0].limit
    # The same for one run, from `language`; a made-up episode reaches the told goal if it is solved.
    told = va.open([stores["base"], stores["lan"]]).language()["perturbations"]
    kept = ["kind", "suite", "num_episodes", "solved", "did"]
    assert told.select(kept).equals(found["perturbations"].select(kept))
    assert told["did"].to_list() == told["solved"].to_list() == [share, share]
    # All of these tasks name the same things, so nothing shows what naming does.
    assert told["named"].null_count() == found["perturbations"]["named"].null_count() == told.height
    # Without an interval anywhere, and without LIBERO-PRO.
    found = compare(opened(stores, "few", "few_object", allowed=("suite",)), ("suite",))
    assert "perturbations" not in [table.name for table in found.tables]


def test_layers_named_in_two_ways_are_one_block(tmp_path):
    small = replace(PLAIN, tasks=(0,), episodes=2, num_layers=18)
    path = write_store(tmp_path / "labelled.zarr", spec=replace(small, plant_rows=planting(1), layer_labels=(18, 19)))
    plain = write_store(tmp_path / "plain.zarr", spec=replace(small, plant_rows=planting(0)))
    found = compare(open_runs(parse_runs([str(plain), str(path)]), AnalysisSettings()))
    assert found["differences"]["layer"].unique().sort().to_list() == ["0", "1", "layers_avg"]
    assert found["differences"]["paired"].all()


CHANGES = {
    "suite": lambda root: structs.replace(root, protocol=structs.replace(root.protocol, suite="other")),
    "seed": lambda root: structs.replace(root, protocol=structs.replace(root.protocol, seed=9)),
    "protocol": lambda root: structs.replace(root, protocol=structs.replace(root.protocol, name="lerobot")),
    "image_size": lambda root: structs.replace(root, protocol=structs.replace(root.protocol, image_size=360)),
    "wait_steps": lambda root: structs.replace(root, protocol=structs.replace(root.protocol, wait_steps=11)),
    "replan_steps": lambda root: structs.replace(root, protocol=structs.replace(root.protocol, replan_steps=4)),
    "max_steps": lambda root: structs.replace(root, protocol=structs.replace(root.protocol, max_steps=77)),
    "family": lambda root: structs.replace(root, policy=structs.replace(root.policy, family="another")),
    "depth": lambda root: structs.replace(root, policy=structs.replace(root.policy, num_heads=5)),
    "queries": lambda root: structs.replace(root, recording=structs.replace(root.recording, num_action_queries=4)),
    "processing": lambda root: structs.replace(
        root, policy=structs.replace(root.policy, config={"normalisation": "other"})
    ),
    "cameras": lambda root: structs.replace(root, policy=structs.replace(root.policy, cameras=root.policy.cameras[:1])),
    "simulator": lambda root: structs.replace(root, provenance={"mujoco": "1.2"}),
}


@pytest.fixture
def changed(stores, monkeypatch):
    """Two runs, the attributes of the second one changed."""

    def change_second(change, allowed=()):
        plain = runs_module.open_store

        def changed_store(path):
            store = plain(path)
            if path != stores["higher"]:
                return store
            root = change(store.attributes)
            if root.provenance != store.attributes.provenance:  # as episodes of another job have it
                episodes = [with_attributes(episode, provenance=root.provenance) for episode in store.episodes]
                store = replace(store, episodes=tuple(episodes))
            return replace(store, attributes=root)

        with monkeypatch.context() as patch:
            patch.setattr(runs_module, "open_store", changed_store)
            return opened(stores, "base", "higher", allowed=allowed)

    return change_second


@pytest.mark.parametrize("field", CHANGES)
def test_every_field_that_must_agree_is_named_and_can_be_allowed(changed, field):
    with pytest.raises((RunsDiffer, MixedPolicies), match=rf"--allow-mismatch {field}\b") as caught:
        check_comparable(changed(CHANGES[field]), ())
    assert str(caught.value).count("\n") == 0
    notes = check_comparable(changed(CHANGES[field], (field,)), (field,))
    assert len(notes) == 1
    assert field in notes[0]


def test_layers_that_only_one_run_recorded_are_refused_until_chosen(stores):
    with pytest.raises(RunsDiffer, match=r"0, 1 .* 1.*--layers"):
        compare(opened(stores, "base", "one_layer"))
    found = compare(opened(stores, "base", "one_layer", layers=(1,)))
    assert one(found["differences"], scope="all", layer="1", quantity="log2_ratio")["num_first"] == 4


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["{base}"], "two"),
        (["{base}", "{base}"], "{base}"),
        (["a={base},{goal}", "b={goal}"], "{goal}"),
        (["a={base}", "a={goal}"], "'a'"),
        (["{base},{goal}", "{higher}"], "NAME="),
        (["={base}", "{goal}"], "={base}"),
        (["a=", "{goal}"], "a="),
        (["{base}", "{goal}"], "suite: made_up .*goal"),
        (["{base}", "{goal}", "--allow-mismatch", "sute"], "'suite'"),
        (["{base}", "{reseeded}"], "seed: 0 .*8"),
        (["{base}", "nowhere.zarr"], "nowhere.zarr"),
    ],
)
def test_mistakes_are_named_in_one_line(stores, words, named, capsys):
    filled = [word.format(**stores) for word in words]
    assert main(["compare", *filled]) == 2
    error = capsys.readouterr().err
    assert re.search(named.format(**stores), error)
    assert len(error.strip().splitlines()) == 1


OUTCOMES = {
    "six lost": ([True] * 8, [False] * 6 + [True] * 2, 0.03125),
    "five lost": ([True] * 8, [False] * 5 + [True] * 3, 0.0625),
    "as many won": ([True] * 4 + [False] * 4, [False] * 4 + [True] * 4, 1.0),
}


@pytest.mark.parametrize("case", OUTCOMES)
def test_success_is_that_of_pairs_and_says_what_they_could_have_shown(stores, monkeypatch, case):
    first, other, p = OUTCOMES[case]
    runs = opened(stores, "base", "higher")
    for run, outcomes in zip(runs, (first, other), strict=True):
        episodes = run.question.selected[:8]
        for item, solved in zip(episodes, outcomes, strict=True):
            monkeypatch.setitem(
                item.episode.__dict__, "attributes", structs.replace(item.episode.attributes, success=solved)
            )
        for item in run.question.selected[8:]:
            monkeypatch.setitem(
                item.episode.__dict__, "attributes", structs.replace(item.episode.attributes, success=None)
            )
    found = compare(runs)
    (finding,) = (finding for finding in found.findings if "better" in finding.asks)
    assert finding.numbers["p"] == pytest.approx(p)
    assert (finding.numbers["n"], finding.numbers["lost"]) == (8, sum(a > b for a, b in zip(first, other, strict=True)))
    assert ("6 pairs" in finding.limit) == (p > 0.05)


def test_a_deaf_policy_is_said_first(example_pair):
    found = compare(open_runs(parse_runs(example_pair), AnalysisSettings()))
    finding = found.findings[0]
    assert "cubes_one_colour" in finding.sentence
    assert (finding.numbers["right_first"], finding.numbers["right_other"]) == (6, 2)
    (needs,) = (finding for finding in found.findings if "depend" in finding.asks)
    assert "any word exchanged" in needs.sentence
    row = one(found["effects"], scope="all", label="any word exchanged")
    assert row["mean_first"] > 1
    assert row["mean_other"] < 1e-4  # to the deaf policy all colours are one word


def test_of_two_effects_that_are_rounding_none_is_said_to_be_more(tmp_path):
    """One of nothing to the bit, and one that float32 leaves."""
    sizes = {"a": 3e-5, "b": 0.0}
    for name, size in sizes.items():
        # Every task weighs another, so that there is a spread.
        plant = planted_effects(lambda _, task, *__, size=size: size * (1 + 0.01 * task))
        write_store(tmp_path / f"{name}.zarr", spec=StoreSpec(tasks=(0, 1, 2, 3), plant_effects=plant))
    found = compare(open_runs(parse_runs([str(tmp_path / f"{name}.zarr") for name in sizes]), AnalysisSettings()))
    (needs,) = (finding for finding in found.findings if "depend" in finding.asks)
    assert needs.numbers["items"] > 0
    assert needs.numbers["shown"] == 0
    assert 0 < found["effects"].filter(scope="all")["mean_first"].max() < 1e-3


@pytest.fixture
def example_pair():
    return [str(example_store(name)) for name in ("cubes", "cubes_one_colour")]


@pytest.mark.drawn
def test_the_command_writes_tables_and_pictures(stores, tmp_path, capsys):
    out = tmp_path / "out"
    assert (
        main(
            [
                "compare",
                str(stores["base"]),
                f"new={stores['higher']}",
                str(stores["lower"]),
                "--pdf",
                "--output",
                str(out),
            ]
        )
        == 0
    )
    assert "new" in capsys.readouterr().out
    assert pl.read_parquet(out / "differences.parquet")["run"].unique().sort().to_list() == ["lower", "new"]
    pairs = pl.read_parquet(out / "pairs.parquet")
    assert pairs.filter(quantity="log2_ratio").height == (16 + 12) * 3
    for stem in ("layers_new", "words_lower"):
        for kind in ("png", "pdf"):
            assert (out / f"{stem}.{kind}").stat().st_size > 0


def test_a_rerun_pairs_at_every_replan(stores, tmp_path):
    """The rerun has no ratio in the first replan of episodes of odd number, and lacks an episode."""

    def plant(task, episode, tokens, rows):
        rows = planting(1)(task, episode, tokens, rows).copy()
        if episode % 2:
            visual = tokens.key_role[0] == Role.IMAGE
            rows[0] = np.where(visual, 0.0, rows[0])
            rows[0] /= rows[0].sum(axis=-1, keepdims=True)
        return rows

    spec = replace(PLAIN, plant_rows=plant, rerun_of=rerun_source(stores["base"]), tasks=(1, 2, 5))
    known = {**stores, "rerun": write_store(tmp_path / "rerun.zarr", spec=spec)}
    found = compare(opened(known, "base", "rerun"))
    pairs = found["pairs"].filter(quantity="log2_ratio", layer="0")
    assert pairs.height == 12
    for row in pairs.iter_rows(named=True):
        task, episode = row["task_id"], row["episode_first"]
        assert row["episode_other"] == episode
        wanted = (log_ratio(1, task, episode) - log_ratio(0, task, episode)) / np.log(2)
        assert row["difference"] == pytest.approx(wanted, rel=1e-3)
    assert found["unpaired"].height == 4
    assert "success" not in found["differences"]["quantity"].to_list()
    assert found["runs"].filter(run="rerun")["success_rate"].null_count() == found["runs"].filter(run="rerun").height


@pytest.mark.parametrize("damaged", ["base", "rerun"])
def test_a_damaged_episode_of_either_side_is_left_out_if_asked(tmp_path, damaged):
    paths = {name: tmp_path / f"{name}.zarr" for name in ("base", "rerun")}
    for path, kept in zip(paths.values(), ("cubes", "cubes_noise"), strict=True):
        shutil.copytree(va.example(kept), path)
    whole = va.open(paths["base"]).compare(paths["rerun"])["moved"]
    (file,) = (paths[damaged] / "episodes" / "task002_episode000" / "actions").glob("c*")
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 0xFF
    file.write_bytes(content)
    with pytest.raises(va.UserError, match="task002_episode000"):
        va.open(paths["base"]).compare(paths["rerun"])
    rest = va.open(paths["base"]).compare(paths["rerun"], skip_corrupt=True)["moved"]
    assert rest["num_episodes"].item() == whole["num_episodes"].item() - 1


def test_a_rerun_with_other_replans_is_refused(stores, tmp_path):
    spec = replace(PLAIN, plant_rows=planting(1), rerun_of=rerun_source(stores["base"]), replans=1, tasks=(0,))
    known = {**stores, "rerun": write_store(tmp_path / "rerun.zarr", spec=spec)}
    with pytest.raises(RunsDiffer, match=r"task000_episode000.* rerun"):
        compare(opened(known, "base", "rerun", allowed=("max_steps",)), ("max_steps",))


def test_differences_over_tasks_are_by_families(tmp_path):
    """Seven tasks of four families: the error is theirs, in the difference, in its effect size and in the text."""
    families = dict(enumerate("aaabbcd"))
    spec = replace(PLAIN, tasks=tuple(families), task_families=families, episodes=2)
    for name, run in (("first", 0), ("other", 1)):
        write_store(tmp_path / f"{name}.zarr", spec=replace(spec, plant_rows=planting(run)))
    stores = {name: tmp_path / f"{name}.zarr" for name in ("first", "other")}
    found = compare(opened(stores, "first", "other"))
    row = one(found["differences"], scope="all", layer="layers_avg", quantity="log2_ratio")
    assert (row["num_tasks"], row["num_families"], row["intervals"]) == (7, 4, "tasks-like-these")
    pairs = found["pairs"].filter(layer="layers_avg", quantity="log2_ratio")
    means = pairs.group_by("task_id").agg(pl.col("difference").mean()).sort("task_id")["difference"].to_numpy()
    labels = np.array([0, 0, 0, 1, 1, 2, 3])
    sums, size = np.bincount(labels, means - means.mean()), np.bincount(labels)
    shares = size**2 / (7 * (7 - size))
    degrees = 1 / ((size**2).sum() / 49 + shares.sum() ** 2 - (shares**2).sum())
    reach = stats.t.ppf(0.975, degrees) * np.sqrt((sums**2 / (7 * (7 - size))).sum())
    assert row["difference"] == pytest.approx(means.mean())
    assert (row["difference_low"], row["difference_high"]) == pytest.approx(
        (means.mean() - reach, means.mean() + reach)
    )
