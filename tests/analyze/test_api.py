"""The Python API: its examples, and that its tables are those of the commands."""

from __future__ import annotations

import doctest
from dataclasses import fields
from pathlib import Path
from types import ModuleType

import numpy as np
import polars as pl
import pytest
import zarr
from polars.testing import assert_frame_equal

import vla_attention as va
import vla_attention.analyze.api
import vla_attention.analyze.measures.question_settings
from vla_attention.analyze.__main__ import main
from vla_attention.analyze.api import OpenStores
from vla_attention.analyze.measures.question_settings import AnalysisSettings, SettingKeywords, settings_from_keywords
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.interventions import Interventions, KeyKnockout
from vla_attention.schemas.precision import mass_error_bound
from vla_attention.schemas.stores.store_format import StoreError, StoreNotFound
from vla_attention.testing.site_stores import write_site_store
from vla_attention.testing.stores import StoreSpec, rerun_source, write_store
from vla_attention.testing.tokens import small_layout

MODULES = (va, vla_attention.analyze.api, vla_attention.analyze.measures.question_settings)


@pytest.fixture(scope="module")
def store(tmp_path_factory) -> Path:
    return write_store(tmp_path_factory.mktemp("api") / "a.zarr", contributions=True)


@pytest.fixture(scope="module")
def other(tmp_path_factory) -> Path:
    return write_store(tmp_path_factory.mktemp("other") / "b.zarr", contributions=True)


@pytest.fixture(scope="module")
def rerun(tmp_path_factory, store) -> Path:
    knockout = Interventions("without_visual", keys=(KeyKnockout("role:image"),))
    spec = StoreSpec(interventions=knockout, rerun_of=rerun_source(store), plant_actions=lambda *_: np.ones((3, 5, 7)))
    return write_store(tmp_path_factory.mktemp("rerun") / "r.zarr", spec=spec)


@pytest.fixture(scope="module")
def replayed(tmp_path_factory) -> Path:
    return write_site_store(tmp_path_factory.mktemp("replayed") / "d.zarr", protocol="dataset", dataset_actions=0.5)


@pytest.fixture(scope="module")
def run(store) -> OpenStores:
    return va.open(store)


def examples(module: ModuleType) -> list[doctest.DocTest]:
    return [test for test in doctest.DocTestFinder().find(module) if test.examples]


@pytest.mark.parametrize(
    "test",
    [test for module in MODULES for test in examples(module)],
    ids=lambda test: test.name,
)
def test_examples(test, store, other, rerun, replayed, tmp_path):
    test.globs.update(store=store, other=other, rerun=rerun, replayed=replayed, folder=tmp_path, va=va, pl=pl)
    result = doctest.DocTestRunner(verbose=False).run(test)
    assert result.failed == 0
    assert result.attempted > 0


def test_every_method_has_an_example():
    named = {test.name.rpartition(".")[2] for module in MODULES for test in examples(module)}
    methods = {name for name in dir(OpenStores) if not name.startswith("_")} - {"attributes", "analysis"}
    assert methods <= named


@pytest.mark.parametrize("level", ["tasks", "episodes", "steps"])
def test_ratios_are_those_of_the_command(run, store, tmp_path, level):
    assert (
        main(
            [
                "ratios",
                str(store),
                "--no-plots",
                "--output",
                str(tmp_path),
                "--layers",
                "2",
                "--intervals",
                "these-tasks",
            ]
        )
        == 0
    )
    assert_frame_equal(
        run.ratios(level, layers=[2], intervals="these-tasks"), pl.read_parquet(tmp_path / f"{level}.parquet")
    )


def test_masses_in_long_form_are_sums_over_the_raw_rows(run, store):
    masses = run.masses(grouping="cameras", per_head=True, tasks=1)
    span = small_layout().span("base_0_rgb")
    names = [f"task001_episode00{i}" for i in range(2)]
    group = zarr.open_group(store, mode="r")["episodes"]
    rows = np.concatenate([group[name]["joint/rows"][:].mean(axis=4) for name in names])
    expected = rows[..., span.start : span.stop].sum(axis=-1).ravel()
    found = masses.filter(group="base_0_rgb")
    np.testing.assert_allclose(found["mass"].to_numpy(), expected, rtol=mass_error_bound(10) + 1e-6)
    assert found["keys"].unique().to_list() == [12.0]
    total = masses.group_by("episode_index", "replan", "layer", "denoise_step", "head").agg(pl.col("fraction").sum())
    np.testing.assert_allclose(total["fraction"].to_numpy(), 1, rtol=1e-9)


def test_the_last_four_analyses_are_kept(store, monkeypatch):
    run = va.open(store)
    asked = []
    real = vla_attention.analyze.api.analyse
    monkeypatch.setattr(
        vla_attention.analyze.api, "analyse", lambda question: (asked.append(question), real(question))[1]
    )
    run.ratios("tasks")
    run.ratios("episodes")
    run.summary()
    assert len(asked) == 1
    for layer in (0, 2):
        for head in (0, 1):
            run.ratios(layers=layer, heads=head)
    run.ratios("steps")
    assert len(asked) == 6


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({"layers": 25}, AnalysisSettings(layers=(25,))),
        ({"layers": range(2), "heads": np.array([1, 3])}, AnalysisSettings(layers=(0, 1), heads=(1, 3))),
        ({"denoise": "last"}, AnalysisSettings(denoise=("last",))),
        ({"denoise": [0, "last"]}, AnalysisSettings(denoise=("0", "last"))),
        (
            {"groups": {"a": "word:x", "b": ["word:y", "word:z"]}},
            AnalysisSettings(groups=("a=word:x", "b=(word:y) | (word:z)")),
        ),
        ({"groups": ["a=word:x"]}, AnalysisSettings(groups=("a=word:x",))),
        ({"ratio": ("a", ["b", "c"])}, AnalysisSettings(ratio="a/b,c")),
        ({"grouping": Path("g.toml"), "layers": None}, AnalysisSettings(grouping="g.toml")),
    ],
)
def test_keywords_become_settings(given, expected):
    assert settings_from_keywords(**given) == expected
    assert hash(settings_from_keywords(**given)) == hash(expected)


def test_keywords_have_the_names_of_the_settings():
    assert set(SettingKeywords.__annotations__) == {field.name for field in fields(AnalysisSettings)}


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda run: run.ratios(layer=3), r"Unknown setting 'layer'\. Did you mean 'layers'"),
        (lambda run: run.ratios("task"), r"Unknown level 'task'\. Did you mean 'tasks'"),
        (lambda run: run.heads(table="head"), r"Unknown table 'head'\. Did you mean 'heads'"),
        (lambda run: run.ratios(layers="two"), r"Cannot use 'two' as numbers"),
        (lambda run: run.ratios(ratio=("a", "b", "c")), r"expected 'A,B/C' or a pair"),
        (lambda run: run.ratios(layers=1), r"were not recorded"),
        (lambda run: run.to_xarray(rows=True, most_gigabytes=1e-6), r"more than the 1 kB"),
        (lambda run: va.open([]), r"No store was given"),
    ],
)
def test_mistakes_say_what_exists(run, call, message):
    with pytest.raises(BadArgument, match=message):
        call(run)


def test_stores_are_opened_by_path_text_or_several(store, other, tmp_path):
    assert va.open(str(store)).episodes.height == 4
    second = write_store(tmp_path / "second.zarr", suite="second", contributions=True)
    both = va.open([store, second])
    assert both.episodes["suite"].unique().sort().to_list() == ["made_up", "second"]
    assert both.ratios()["scope"].unique().sort().to_list() == ["all", "combined", "task"]
    with pytest.raises(StoreNotFound):
        va.open(tmp_path / "absent.zarr")
    with pytest.raises(StoreError, match="both hold"):
        va.open([store, other])


def test_repr_names_stores_policy_and_axes(run, store):
    text = repr(run)
    assert text.splitlines()[0] == "OpenStores of 1 store: 4 episodes of 2 tasks (2 solved), 12 replans, suite made_up"
    for part in (str(store), "UNTRAINED", "layers   0, 2", "joint (39 keys)", ".ratios()"):
        assert part in text


def test_an_empty_store_can_be_opened_and_says_that_it_is_empty(tmp_path):
    run = va.open(write_store(tmp_path / "a.zarr", tasks=()))
    assert run.episodes.height == 0
    assert "0 episodes" in repr(run)
    with pytest.raises(StoreError, match="no complete episode"):
        run.ratios()


def test_the_guide_names_every_column(run, other, rerun, replayed, tmp_path):
    guide = (Path(__file__).parents[2] / "docs" / "python.md").read_text(encoding="utf-8")
    levels = ("steps", "replans", "episodes", "tasks")
    tables = [ask(level) for level in levels for ask in (run.ratios, run.masses)]
    names = ("heads", "heads_groups", "dispersion", "depth", "denoise", "denoise_groups")
    tables += [*(run.heads(name) for name in names), run.row_metrics(), run.row_metrics("groups")]
    run_with_norms = va.open(write_store(tmp_path / "a.zarr", contributions=True))
    tables += [run_with_norms.contributions(), run.sinks(), run.sinks("heads")]
    tables += [run.objects(name) for name in ("objects", "summary", "times", "pointing", "iou")]
    tables += [run.words(name) for name in ("summary", "episodes")]
    tables += [run.time(name) for name in ("course", "closing", "change", "outcomes", "autocorrelation")]
    tables += [run.compare(other, name) for name in ("differences", "estimates", "pairs", "unpaired")]
    tables += [run.groups(name) for name in ("groups", "words", "overlaps")]
    tables += [run.effects(rerun, name) for name in ("episodes", "summary", "rollouts", "rollout_episodes")]
    tables += [va.open(replayed).deviation(name) for name in ("summary", "dimensions", "attention", "replans")]
    norms = run.analysis().group_contributions
    assert norms is not None
    tables += [norms.cells, norms.groups, run.overlay()]
    ends = ("_low", "_high", "_episodes")
    missing = {
        name for table in tables for name in table.columns if f"`{name}`" not in guide and not name.endswith(ends)
    }
    assert missing == set()


def test_the_guide_names_every_table_file(store, other, rerun, tmp_path, monkeypatch):
    guide = (Path(__file__).parents[2] / "docs" / "python.md").read_text(encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    for command in ("ratios", "heads", "words", "objects", "time"):
        assert main([command, str(store), "--no-plots"]) == 0
    assert main(["groups", str(store), "--no-plots"]) == 0
    assert main(["compare", f"a={store}", f"b={other}", "--no-plots"]) == 0
    assert main(["effects", str(store), str(rerun), "--no-plots"]) == 0
    names = {path.stem for path in tmp_path.rglob("*.parquet")}
    assert len(names) > 20
    levels = {name.removesuffix("_groups") for name in names} & {"steps", "replans", "episodes", "tasks"}
    own = {name for name in names if name.removesuffix("_groups") not in levels}
    missing = {name for name in own if f"`{name}`" not in guide and f"`{name}.parquet`" not in guide}
    assert missing == set()


def test_a_group_inside_of_a_store_leads_to_the_store(store, capsys):
    for inside in (store / "episodes", store / "episodes" / "task000_episode000"):
        assert main(["verify", str(inside)]) == 2
        assert f"is a group inside of a store; give the folder above, {store}." in capsys.readouterr().err


def test_what_was_a_seed_of_intervals_can_be_left_out(store, capsys):
    assert main([str(store), "--seed", "3"]) == 2
    assert capsys.readouterr().err == "vla-analyze: Intervals have no random draws any more: leave --seed out.\n"


def test_the_description_is_a_page_wide(run):
    lines = [line for line in run.describe().splitlines() if not line.startswith("Store ")]
    assert max(map(len, lines)) <= 100


def test_the_guides_examples(tmp_path, monkeypatch):
    guide = Path(__file__).parents[2] / "docs" / "python.md"
    (tmp_path / "runs").mkdir()
    write_store(tmp_path / "runs" / "libero_10.zarr", suite="libero_10")
    monkeypatch.chdir(tmp_path)
    result = doctest.testfile(str(guide), module_relative=False, verbose=False)
    assert result.failed == 0
    assert result.attempted > 6
