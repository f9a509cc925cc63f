"""`vla-attention export`: files that other programs read, against the raw Zarr arrays."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import polars as pl
import pytest
import xarray as xr
import zarr
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from polars.testing import assert_frame_equal

from tests.kit.examples import examples
from tests.kit.questions import question_about
from vla_attention.analyze.__main__ import main
from vla_attention.analyze.export.labelled_arrays import masses_array, rows_array, write_netcdf
from vla_attention.analyze.ratios.analysis import analyse
from vla_attention.schemas.groupings.resolve import resolve
from vla_attention.schemas.layout import Role
from vla_attention.schemas.precision import mass_error_bound
from vla_attention.testing.stores import small_effects, write_store
from vla_attention.testing.strategies import episode_tokens, groupings
from vla_attention.testing.tokens import small_layout

GROUPS = ("bowl=word:bowl", "wrist=camera:left_wrist_0_rgb", "rest=*")


@pytest.fixture(scope="module")
def store(tmp_path_factory) -> Path:
    return write_store(
        tmp_path_factory.mktemp("export") / "a.zarr", tasks=(0, 2), episodes=2, replans=3, contributions=True
    )


@pytest.fixture(scope="module")
def ragged(tmp_path_factory) -> list[Path]:
    """Two stores whose episodes have different lengths."""
    folder = tmp_path_factory.mktemp("ragged")
    return [
        write_store(folder / f"{suite}.zarr", suite=suite, tasks=(0,), episodes=2, replans=replans)
        for suite, replans in (("short", 2), ("long", 4))
    ]


def raw_rows(path: Path) -> np.ndarray:
    """(sample, layer, denoise, head, key) of a store, mean over queries, in the order of episode names."""
    group = zarr.open_group(path, mode="r")["episodes"]
    return np.concatenate([group[name]["joint/rows"][:].mean(axis=4) for name in sorted(group.group_keys())])


def exported(*words: object) -> int:
    return main(["export", *(str(word) for word in words)])


def test_tables_are_those_of_the_analysis(store, tmp_path, capsys):
    assert exported(store, "--csv", "--parquet", "--output", tmp_path) == 0
    analysis = analyse(question_about(store))
    tables = {}
    for name in ("episodes", "tasks", "steps"):
        level = getattr(analysis, name)
        tables |= {name: level.cells, f"{name}_groups": level.groups}
    assert sorted(file.name for file in tmp_path.iterdir()) == sorted(
        f"{n}.{e}" for n in tables for e in ("csv", "parquet")
    )
    for name, table in tables.items():
        assert_frame_equal(pl.read_parquet(tmp_path / f"{name}.parquet"), table)
        text = pl.read_csv(tmp_path / f"{name}.csv", schema=table.schema)
        assert_frame_equal(text, table)
    assert "12 files in" in capsys.readouterr().out


def test_infinite_ratios_survive_in_csv(store, tmp_path):
    groups = ["--group", "a=role:image", "--group", "b=role:masked_image", "--group", "rest=*", "--ratio", "a/b"]
    exported(store, "--csv", "--table", "steps", *groups, "--output", tmp_path)
    assert pl.read_csv(tmp_path / "steps.csv")["ratio"].is_infinite().all()


def test_netcdf_holds_the_masses_of_the_raw_rows(ragged, tmp_path):
    words = [word for group in GROUPS for word in ("--group", group)]
    exported(*ragged, "--netcdf", *words, "--output", tmp_path)
    rows = np.concatenate([raw_rows(path) for path in ragged])
    with xr.open_dataset(tmp_path / "attention.nc") as data:
        assert data["mass"].dims == ("sample", "layer", "denoise", "head", "group")
        assert dict(data.sizes) == {"sample": 2 * 2 + 2 * 4, "layer": 2, "denoise": 2, "head": 2, "group": 3}
        assert data["group"].values.tolist() == ["bowl", "wrist", "rest"]
        assert data["suite"].values.tolist() == ["short"] * 4 + ["long"] * 8
        assert data["replan"].values.tolist() == [0, 1] * 2 + [0, 1, 2, 3] * 2
        assert data["env_step"].values.tolist() == [10, 15] * 2 + [10, 15, 20, 25] * 2
        assert data["success"].dtype == bool
        assert data["success"].values.tolist() == [False] * 2 + [True] * 2 + [False] * 4 + [True] * 4
        assert set(data["instruction"].values.tolist()) == {"put the bowl on the plate"}
        span = small_layout().span("left_wrist_0_rgb")
        bound = mass_error_bound(10) + 1e-6
        wrist = rows[..., span.start : span.stop].sum(axis=-1)
        np.testing.assert_allclose(data["mass"].sel(group="wrist"), wrist, rtol=bound)
        # The prompt is "put the bowl on the plate" after bos: its third word is the prompt span's fourth key.
        bowl = small_layout().span("prompt").start + 3
        np.testing.assert_allclose(data["mass"].sel(group="bowl"), rows[..., bowl], rtol=bound)
        np.testing.assert_allclose(data["mass"].sum("group"), data["row_sum"], rtol=bound)
        assert data["num_keys"].sel(group="wrist").values.tolist() == [4.0] * 12
        assert "rows" not in data


def test_netcdf_with_rows_holds_the_rows_to_the_bit_and_what_every_key_is(ragged, tmp_path, capsys):
    exported(*ragged, "--netcdf", "--rows", "--output", tmp_path)
    assert (
        "rows: 12 samples x 2 layers x 2 denoise steps x 2 heads x 39 keys, 15 kB in float32" in capsys.readouterr().out
    )
    with xr.open_dataset(tmp_path / "attention.nc") as data:
        np.testing.assert_array_equal(data["rows"].values, np.concatenate([raw_rows(path) for path in ragged]))
        assert data["rows"].dtype == np.float32
        layout = small_layout()
        for span in layout.spans:
            part = data.isel(key=slice(span.start, span.stop))
            assert set(part["key_span"].values.tolist()) == {span.name}
            assert set(part["key_camera"].values.tolist()) == {span.camera or ""}
            if span.grid:
                expected = [(i, j) for i in range(span.grid.rows) for j in range(span.grid.columns)]
                found = zip(part["patch_row"].values.tolist(), part["patch_column"].values.tolist(), strict=True)
                assert list(found) == expected
        group = zarr.open_group(ragged[0], mode="r")["episodes"]
        stored = np.concatenate([group[name]["joint/key_role"][:] for name in sorted(group.group_keys())])
        np.testing.assert_array_equal(data["key_role"].values[:4], stored)
        assert data["key_role"].attrs["flag_meanings"].split()[Role.IMAGE - 1] == "image"
        assert "key_role" in data["rows"].coords
        assert "task_id" in data["rows"].coords


def test_arrays_in_memory_are_those_of_the_file(store, tmp_path):
    question = question_about(store, grouping="cameras")
    exported(store, "--netcdf", "--rows", "--grouping", "cameras", "--output", tmp_path)
    with xr.open_dataset(tmp_path / "attention.nc") as data:
        masses = masses_array(question)
        np.testing.assert_array_equal(masses["mass"].values, data["mass"].values)
        rows = rows_array(question)
        for name in (*rows.coords, "rows"):
            np.testing.assert_array_equal(rows[name].values, data[name].values, err_msg=name)


def test_the_means_over_heads_are_those_of_the_steps_table(store):
    question = question_about(store)
    mean = masses_array(question)["mass"].mean("head")
    mass = analyse(question).steps.of_group("visual")["mass"].to_numpy()
    np.testing.assert_allclose(mean.sel(group="visual").values.ravel(), mass, rtol=1e-5)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "give --csv, --parquet or --netcdf"),
        (["--csv", "--rows"], "--rows goes with --netcdf"),
        (["--netcdf", "--table", "steps"], "--table goes with --csv or --parquet"),
        (["--csv", "--layers", "3"], "were not recorded"),
    ],
)
def test_mistakes_end_with_one_sentence(store, capsys, words, message):
    assert exported(store, *words) == 2
    err = capsys.readouterr().err
    assert message in err
    assert len(err.splitlines()) == 1


@pytest.mark.thorough
@settings(
    max_examples=examples(5),
    phases=[Phase.explicit, Phase.generate],
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow],
)
@given(data=st.data())
def test_files_of_any_layout_and_grouping_hold_the_raw_rows_and_their_sums(data):
    tokens = data.draw(episode_tokens())
    grouping = data.draw(groupings(tokens))
    with tempfile.TemporaryDirectory() as folder:
        path = write_store(Path(folder) / "a.zarr", tokens=tokens, tasks=(0, 3), episodes=1)
        question = question_about(path, grouping)
        with xr.open_dataset(write_netcdf(question, Path(folder) / "a.nc", rows=True)) as found:
            rows = raw_rows(path)
            np.testing.assert_array_equal(found["rows"].values, rows)
            weights = np.broadcast_to(
                resolve(grouping, tokens).weights, (tokens.num_replans, rows.shape[-1], len(grouping.names))
            )
            expected = np.einsum("rldhk,rkg->rldhg", rows.astype(np.float64), np.concatenate([weights] * 2))
            np.testing.assert_allclose(found["mass"].values, expected, rtol=mass_error_bound(10) + 1e-5, atol=1e-9)
            assert found["group"].values.tolist() == list(grouping.names)
            np.testing.assert_array_equal(found["key_role"].values, np.concatenate([tokens.key_role] * 2))


def test_recorded_effects_are_a_table_and_arrays(tmp_path, capsys):
    store = write_store(tmp_path / "effects.zarr", tasks=(0, 1), episodes=2, replans=3, plant_effects=small_effects)
    words = [store, "--csv", "--netcdf", "--table", "effects", "--output", tmp_path / "out"]
    assert exported(*words) == 0
    raw = zarr.open_group(store, mode="r")["episodes"]
    changes = [raw[name]["effects/change"][:] for name in sorted(raw.group_keys())]
    dataset = xr.open_dataset(tmp_path / "out/attention.nc")
    assert np.array_equal(dataset["effect_change"], np.concatenate(changes))
    samples = [3 * number + replan for number, name in enumerate(sorted(raw.group_keys()))
               for replan in raw[name].attrs["effects"]["replan"]]  # fmt: skip
    assert dataset["effect_sample"].values.tolist() == samples
    assert (dataset["effect_units"] == 2.0).all()
    table = pl.read_csv(tmp_path / "out/effects.csv")
    named = [str(name) for name in dataset["effect_condition"].values if name != "unchanged"]
    assert table.height == len(named)
    assert sorted(table["condition"]) == sorted(named)
