"""Every question gives the numbers that it gave: all tables on fixed stores, and what the published lines pass on."""

from __future__ import annotations

import polars as pl
import pytest

from tests.kit.golden_stores import differences
from tests.kit.golden_tables import CASES, FOLDER, alike, form_of, link_stores, published_arguments, tables_of


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tables")
    link_stores(folder)
    return folder


def hold(case: str, tables: dict[str, pl.DataFrame]) -> None:
    kept = {file.stem: pl.read_parquet(file) for file in sorted((FOLDER / case).glob("*.parquet"))}
    assert kept
    wrong = []
    for name, table in kept.items():
        form = form_of(case, name)
        if form is None and name not in tables:
            wrong.append(f"no table {name}")
            continue
        lines = differences(tables[name], table, alike) if form is None else form.differences(tables, table)
        wrong += [f"{name}: {line}" for line in lines]
    assert not wrong, "\n".join(wrong[:20])


@pytest.mark.parametrize("case", CASES)
def test_a_question_gives_the_kept_tables(folder, case):
    hold(case, tables_of(case, folder))


def test_the_published_lines_and_variables_pass_on_what_they_passed_on():
    kept = pl.read_parquet(FOLDER / "published" / "arguments.parquet")
    assert set(kept.rows()) <= set(published_arguments().rows())
    assert kept["given"].n_unique() == 15
