from __future__ import annotations

from pathlib import Path

import polars as pl
import pytest

from vla_attention.analyze.render.output_files import write_csv, write_parquet, write_text, writing
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.stores.store_format import StoreNotFound


def test_a_file_appears_whole_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / "new" / "a.txt"
    write_text(path, "ratio ± 1\n")
    assert path.read_text(encoding="utf-8") == "ratio ± 1\n"
    with pytest.raises(UnicodeEncodeError):
        write_text(path, "half a \ud800 pair")
    assert path.read_text(encoding="utf-8") == "ratio ± 1\n"
    assert [file.name for file in path.parent.iterdir()] == ["a.txt"]


def test_what_cannot_be_written_is_one_sentence(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    message = f"Cannot write the page to {tmp_path / 'file' / 'a.html'}: File exists; give another path."
    with pytest.raises(BadArgument) as caught, writing("the page", tmp_path / "file" / "a.html", "another path"):
        write_text(tmp_path / "file" / "a.html", "")
    assert str(caught.value) == message
    # A mistake of the user that is an OSError too keeps its own sentence.
    with pytest.raises(StoreNotFound, match="no store"), writing("results", tmp_path):
        raise StoreNotFound("no store")


def test_a_table_in_parts_is_the_table_and_each_part_is_made_when_it_is_written(tmp_path: Path) -> None:
    whole = pl.DataFrame({"n": range(400_000), "name": ["a", None, "b,c", "d"] * 100_000, "x": [0.5, None] * 200_000})
    alive: list[int] = []

    class Part(pl.DataFrame):
        def __del__(self) -> None:
            alive.remove(id(self))

    def parts():
        for start in range(0, 400_000, 10_000):
            part = Part(whole[start : start + 10_000])
            alive.append(id(part))
            most.append(len(alive))
            yield part

    most: list[int] = []
    write_parquet(tmp_path, {"grouping": "g"}, table=parts())
    assert pl.read_parquet(tmp_path / "table.parquet").equals(whole)
    assert pl.read_parquet_metadata(tmp_path / "table.parquet")["grouping"] == "g"
    assert len(most) == 40
    assert max(most) < 30
    write_csv(tmp_path, whole=whole, parts=(whole[start : start + 30_000] for start in range(0, 400_000, 30_000)))
    assert (tmp_path / "parts.csv").read_bytes() == (tmp_path / "whole.csv").read_bytes()
