"""The Python API: its examples, and that its tables are those of the commands."""

from __future__ import annotations

import doctest
import re
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
from tests.kit.planted_effects import planted_effects
from tests.kit.raw_rows import probabilities
from tests.kit.site_stores import write_site_store
from tests.kit.stores import StoreSpec, write_store
from tests.kit.tokens import small_layout
from vla_attention.analyze.__main__ import main
from vla_attention.analyze.api import OpenStores
from vla_attention.analyze.measures.question_settings import AnalysisSettings, settings_from_keywords
from vla_attention.schemas.errors import BadArgument, UnknownName
from vla_attention.schemas.precision import mass_error_bound
from vla_attention.schemas.stores.store_format import StoreError, StoreNotFound

MODULES = (va, vla_attention.analyze.api, vla_attention.analyze.measures.question_settings)


@pytest.fixture(scope="module")
def store(tmp_path_factory) -> Path:
    return write_store(tmp_path_factory.mktemp("api") / "a.zarr", contributions=True)


@pytest.fixture(scope="module")
def other(tmp_path_factory) -> Path:
    return write_store(tmp_path_factory.mktemp("other") / "b.zarr", contributions=True)


@pytest.fixture(scope="module")
def with_effects(tmp_path_factory) -> Path:
    return write_store(tmp_path_factory.mktemp("effects") / "e.zarr", spec=StoreSpec(plant_effects=planted_effects()))


@pytest.fixture(scope="module")
def replayed(tmp_path_factory) -> Path:
    return write_site_store(tmp_path_factory.mktemp("replayed") / "d.zarr", protocol="dataset", dataset_actions=0.5)


@pytest.fixture(scope="module")
def run(store) -> OpenStores:
    return va.open(store)


def test_one_name_is_no_list_of_letters(with_effects, store):
    run = va.open(with_effects)
    assert_frame_equal(run.effects(by="task")["effects_items"], run.effects(by=["task"])["effects_items"])
    one = f"c=patch:{run.stores[0].attributes.policy.cameras[0].name}[0:1,0:2]"
    run = va.open(store)
    drawn = [run.overlay(tasks=0, replans=0, outline=given).figures for given in (one, [one])]
    assert [figure.options["outlines"] for figure in drawn[0]] == [figure.options["outlines"] for figure in drawn[1]]
    assert drawn[0][0].options["outlines"] == ["c"]


def examples(module: ModuleType) -> list[doctest.DocTest]:
    return [test for test in doctest.DocTestFinder().find(module) if test.examples]


@pytest.mark.parametrize(
    "test",
    [test for module in MODULES for test in examples(module)],
    ids=lambda test: test.name,
)
def test_examples(test, store, other, with_effects, replayed, tmp_path):
    given = {"store": store, "other": other, "with_effects": with_effects, "replayed": replayed}
    test.globs.update(**given, folder=tmp_path, va=va, pl=pl)
    result = doctest.DocTestRunner(verbose=False).run(test)
    assert result.failed == 0
    assert result.attempted > 0


def test_tables_are_those_of_the_command(run, store, tmp_path):
    words = [str(store), "--no-plots", "--output", str(tmp_path), "--layers", "2", "--intervals", "these-tasks"]
    assert main(words) == 0
    answer = run.analyze(layers=[2], intervals="these-tasks")
    written = {file.stem: pl.read_parquet(file) for file in tmp_path.glob("*.parquet")}
    assert set(written) == {table.name for table in answer.tables if table.file and not table.of}
    for name, table in written.items():
        assert_frame_equal(answer[name], table)


def test_an_answer_shows_saves_and_draws_itself(run, tmp_path):
    answer = run.words()
    assert str(answer).splitlines()[0] == answer.about[0]
    assert "<table" in answer._repr_html_()
    assert answer.plot().get_axes()
    assert answer.plot()._repr_png_().startswith(b"\x89PNG")
    assert {"result.json", "words.csv", "word_bars.png"} <= {file.name for file in answer.save(tmp_path, csv=True)}
    with pytest.raises(va.UserError, match="word_bars"):
        answer.plot("word_bar")


def test_masses_in_long_form_are_sums_over_the_raw_rows(run, store):
    masses = run.analyze(grouping="cameras", per_head=True, tasks=1)["steps_groups"]
    span = small_layout().span("base_0_rgb")
    names = [f"task001_episode00{i}" for i in range(2)]
    group = zarr.open_group(store, mode="r")["episodes"]
    rows = np.concatenate([probabilities(group[name]["joint/rows"]).mean(axis=4) for name in names])
    expected = rows[..., span.start : span.stop].sum(axis=-1).ravel()
    found = masses.filter(group="base_0_rgb")
    np.testing.assert_allclose(found["mass"].to_numpy(), expected, rtol=mass_error_bound(10) + 1e-6)
    assert found["keys"].unique().to_list() == [12.0]
    total = masses.group_by("episode_index", "replan", "layer", "denoise_step", "head").agg(pl.col("fraction").sum())
    np.testing.assert_allclose(total["fraction"].to_numpy(), 1, rtol=1e-9)


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


@pytest.mark.parametrize(
    ("call", "named"),
    [
        (lambda run: run.analyze(layer=3)["tasks"], "'layer'.*'layers'"),
        (lambda run: run.analyze(by=["heads"]), "--by 'heads'.*'head'"),
        (lambda run: run.analyze(layers="two")["tasks"], "'two'"),
        (lambda run: run.analyze(ratio=("a", "b", "c"))["tasks"], "'A,B/C'"),
        (lambda run: run.analyze(layers=1)["tasks"], r"\b1\b"),
        (lambda run: va.open([]), "store"),
    ],
)
def test_mistakes_say_what_exists(run, call, named):
    with pytest.raises((BadArgument, UnknownName), match=named):
        call(run)


def test_stores_are_opened_by_path_text_or_several(store, other, tmp_path):
    assert va.open(str(store)).episodes.height == 4
    second = write_store(tmp_path / "second.zarr", suite="second", contributions=True)
    both = va.open([store, second])
    assert both.episodes["suite"].unique().sort().to_list() == ["made_up", "second"]
    assert both.analyze()["tasks"]["scope"].unique().sort().to_list() == ["all", "combined", "task"]
    with pytest.raises(StoreNotFound):
        va.open(tmp_path / "absent.zarr")
    with pytest.raises(StoreError, match="both"):
        va.open([store, other])


def test_an_empty_store_can_be_opened_and_says_that_it_is_empty(tmp_path):
    run = va.open(write_store(tmp_path / "a.zarr", tasks=()))
    assert run.episodes.height == 0
    assert "0 episodes" in repr(run)
    with pytest.raises(StoreError, match="episode"):
        run.analyze()["tasks"]


def test_a_group_inside_of_a_store_leads_to_the_store(store, capsys):
    for inside in (store / "episodes", store / "episodes" / "task000_episode000"):
        assert main(["store", "verify", str(inside)]) == 2
        assert re.search(rf"{inside} .*{store}\.", capsys.readouterr().err)


def test_the_guides_examples(tmp_path, monkeypatch):
    guide = Path(__file__).parents[2] / "docs" / "python.md"
    (tmp_path / "runs").mkdir()
    write_store(tmp_path / "runs" / "libero_10.zarr", suite="libero_10")
    monkeypatch.chdir(tmp_path)
    result = doctest.testfile(str(guide), module_relative=False, verbose=False)
    assert result.failed == 0
    assert result.attempted > 6
