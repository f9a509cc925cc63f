"""Every question gives the numbers that it gave: all tables on fixed stores, and what the published lines pass on."""

from __future__ import annotations

from functools import partial

import polars as pl
import pytest

from tests.kit.golden_stores import differences
from tests.kit.golden_tables import (
    CASES,
    FOLDER,
    OF_DIFFERENCES,
    alike,
    link_stores,
    published_arguments,
    tables_of,
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tables")
    link_stores(folder)
    return folder


def hold(case: str, tables: dict[str, pl.DataFrame]) -> None:
    tables = {name.replace("/", "_"): table for name, table in tables.items()}
    kept = {file.stem: pl.read_parquet(file) for file in sorted((FOLDER / case).glob("*.parquet"))}
    assert kept
    same = partial(alike, absolute=OF_DIFFERENCES) if case.endswith("compare") else alike
    wrong = [f"no table {name}" for name in kept if name not in tables]
    for name in kept.keys() & tables.keys():
        wrong += [f"{name}: {line}" for line in differences(tables[name], kept[name], same)]
    assert not wrong, "\n".join(wrong[:20])


@pytest.mark.parametrize("case", CASES)
def test_a_question_gives_the_kept_tables(folder, case):
    hold(case, tables_of(case, folder))


def test_the_published_lines_and_variables_pass_on_what_they_passed_on():
    kept = pl.read_parquet(FOLDER / "published" / "arguments.parquet")
    assert set(kept.rows()) <= set(published_arguments().rows())
    assert kept["given"].n_unique() == 15
