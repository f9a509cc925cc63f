"""From a captured store over a series of reruns to their effects, by the real command lines."""

from __future__ import annotations

from pathlib import Path

import polars as pl
import pytest

from vla_attention.analyze.__main__ import main as analyze
from vla_attention.capture.__main__ import main as capture
from vla_attention.testing import assert_whole

pytestmark = pytest.mark.simulator


@pytest.fixture(scope="module")
def series(captured_store: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("series")
    assert capture(["rerun", str(captured_store), "--series", "default", "--output-dir", str(folder)]) == 0
    return folder


def test_a_series_is_whole_and_its_effects_are_measured(captured_store, series, tmp_path, capsys):
    names = {path.stem for path in series.glob("*.zarr")}
    assert {"noise", "without_visual", "only_visual", "random_visual", "without_linguistic"} <= names
    assert_whole(series / "without_visual.zarr")
    assert analyze(["effects", str(captured_store), str(series), "--output", str(tmp_path)]) == 0
    printed = capsys.readouterr().out
    assert len(printed.splitlines()) <= 40
    assert "Without visual the action changes by" in " ".join(printed.split())
    summary = pl.read_parquet(tmp_path / "effects_summary.parquet").filter(scope="all", phase="all")
    assert set(summary["condition"]) == names
    rows = {row["condition"]: row for row in summary.to_dicts()}
    assert rows["noise"]["effect"] > rows["without_visual"]["effect"] > 0  # random weights: noise is all there is
    assert rows["without_visual"]["random"] == pytest.approx(rows["random_visual"]["effect"])
    assert rows["without_visual"]["mass"] == pytest.approx(rows["only_visual"]["mass"])


def test_a_rerun_is_compared_at_every_replan(captured_store, series, tmp_path, capsys):
    given = ["compare", str(captured_store), str(series / "without_visual.zarr"), "--output", str(tmp_path)]
    assert analyze([*given, "--no-plots"]) == 0
    assert "replan by replan" in (tmp_path / "summary.txt").read_text(encoding="utf-8")
    rows = pl.read_parquet(tmp_path / "comparison.parquet").filter(scope="all", layer="layers_avg")
    assert rows.filter(quantity="visual_fraction")["mean_other"].item() == 0.0


def test_the_report_has_the_effects(captured_store, series, tmp_path):
    page = tmp_path / "page.html"
    given = ["report", str(captured_store), "--effects", str(series), "--quick", "--episodes", "0", "--output"]
    assert analyze([*given, str(page)]) == 0
    assert "Without visual the action changes by" in page.read_text(encoding="utf-8")
