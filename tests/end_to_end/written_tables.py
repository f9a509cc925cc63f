"""Tables that an analysis wrote, in the wide form, which tests compare column by column."""

from __future__ import annotations

from pathlib import Path

import polars as pl

from tests.kit.made_up_steps import Made


def written_steps(folder: Path) -> pl.DataFrame:
    """Steps from `steps.parquet` and `steps_groups.parquet`, with a column `{group}_{measure}` for each."""
    return Made(*(pl.read_parquet(folder / f"{name}.parquet") for name in ("steps", "steps_groups"))).flat
