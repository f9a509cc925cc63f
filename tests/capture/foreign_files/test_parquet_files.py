"""What a Parquet file says of itself, against what polars reads; tests/thorough has files that lie."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest

from tests.thorough.hostile_data_sets.parquet_writer import constant, write_parquet
from vla_attention.capture.foreign_files.parquet_files import ParquetFile, ParquetRefused


def frame(rows: int) -> pl.DataFrame:
    generator = np.random.default_rng(1)
    return pl.DataFrame(
        {
            "action": pl.Series(generator.normal(size=(rows, 6)).astype("f4"), dtype=pl.Array(pl.Float32, 6)),
            "pairs": pl.Series([[[1.0, 2.0]] * 3] * rows, dtype=pl.List(pl.List(pl.Float64))),
            "camera": pl.Series(
                [{"bytes": generator.bytes(200), "path": f"{i}.png"} for i in range(rows)],
                dtype=pl.Struct({"bytes": pl.Binary, "path": pl.String}),
            ),
            "episode_index": np.repeat(np.arange(-(-rows // 10)), 10)[:rows],
            "success": [True] * rows,
            "task": ["open it"] * rows,
        }
    )


@pytest.mark.parametrize("compression", ["snappy", "zstd"])
@pytest.mark.parametrize("row_group_size", [7, None])
def test_rows_columns_and_groups_are_those_of_the_file(tmp_path, compression, row_group_size):
    rows = frame(95)
    rows.write_parquet(tmp_path / "a.parquet", compression=compression, row_group_size=row_group_size)
    file = ParquetFile(tmp_path / "a.parquet")
    assert (file.rows, file.columns) == (95, tuple(rows.columns))
    assert sum(file.groups) == 95
    assert len(file.groups) == (14 if row_group_size else 1)
    file.check(file.columns)
    file.check(["action"], 40, 3)
    assert file.rows_and_values("action", 0, 95) == (95, 95 * 6)
    assert file.rows_and_values("pairs", 0, 95) == (95, 95 * 6)
    assert file.rows_and_values("episode_index", 20, 2)[0] == (14 if row_group_size else 95)  # groups 14-20 and 21-27
    assert file.bytes_per_row(["camera"], 0, 95) == pytest.approx(220, rel=0.2)
    assert [name for name in file.columns if file.is_numeric(name)] == ["action", "pairs", "episode_index", "success"]
    assert [name for name in file.columns if file.is_text(name)] == ["task"]


def test_memory_is_compared_with_what_is_stored(tmp_path):
    """8 MB of repeated numbers may be in a few bytes; 80 MB may not, unless as much is stored beside them."""
    write_parquet(tmp_path / "few.parquet", [constant("a", 1_000_000)], 1_000_000)
    ParquetFile(tmp_path / "few.parquet").check(["a"])
    many = [constant("a", 10_000_000), constant("b", 10_000_000)]
    write_parquet(tmp_path / "many.parquet", many, 10_000_000)
    with pytest.raises(ParquetRefused, match=r"take 80,000,0\d\d bytes .* column 'a', from \d\d stored ones; expected"):
        ParquetFile(tmp_path / "many.parquet").check(["a"])
    numbers = np.random.default_rng(1).normal(size=10_000_000)
    pl.DataFrame({"a": [0] * len(numbers), "b": numbers}).write_parquet(tmp_path / "real.parquet")
    ParquetFile(tmp_path / "real.parquet").check(["b", "a"])
