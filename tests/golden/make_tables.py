"""Make golden tables, or columns of them: python -m tests.golden.make_tables CASE/TABLE[:COLUMN] ...

What is not named stays as it is: a change that means to alter numbers names them. The stores in
tests/golden/tables/stores were captured once, with one thread:

    cubes, cubes_one_colour: as scripts/make_example_stores.py has them, but with two threads and without effects
    cubes_reruns: capture rerun cubes.zarr --knockout or --keep role:image or role:instruction, some with --random-keys,
        --knockout-queries action --num-episodes 1 --no-frames --no-contributions --precision 7
    vla-attention capture pi --task-suite cubes --task-id 0 1 5 6 10 13 --num-episodes 1 --max-steps 25 --no-frames
        --no-contributions --precision 7 --effects text,cameras --effects-readers all action pictures text
    vla-attention capture pi --checkpoint untrained-tiny --task-suite libero_spatial --task-id 0 1 3 --num-episodes 1
        --max-steps 15 --precision 7 --num-envs 1                        (with LIBERO's reduced assets)
    vla-attention capture cosmos --checkpoint untrained-tiny --task-suite robosuite --task-id 0 1 --num-episodes 2
        --max-steps 32 --precision 7 --num-envs 1 --no-frames
    vla-attention capture replay DATA --checkpoint untrained-tiny --every 3 --camera base_0_rgb=front
        --camera left_wrist_0_rgb=none --no-frames --precision 7   (DATA: `made_up_episodes` of the tests' kit)
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import polars as pl

from tests.kit.golden_tables import CASES, FOLDER, link_stores, published_arguments, tables_of


def write(case: str, tables: dict[str, pl.DataFrame], named: list[str]) -> None:
    """Write the named tables and columns of a case."""
    for name, table in tables.items():
        file = FOLDER / case / f"{name.replace('/', '_')}.parquet"
        columns = [one.partition(":")[2] for one in named if one.partition(":")[0] == f"{case}/{name}"]
        if not columns:
            continue
        if all(columns):
            table = pl.read_parquet(file).with_columns(table[column] for column in columns)
        file.parent.mkdir(parents=True, exist_ok=True)
        table.write_parquet(file, compression="zstd", compression_level=22, statistics=False)
        print(file.relative_to(FOLDER), table.shape)


def main() -> None:
    """Ask the questions of the named tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("named", nargs="+", metavar="CASE/TABLE[:COLUMN]")
    named = parser.parse_args().named
    cases = {one.partition("/")[0] for one in named}
    with tempfile.TemporaryDirectory() as temporary:
        link_stores(Path(temporary))
        for case in CASES:
            if case in cases:
                write(case, tables_of(case, Path(temporary)), named)
    write("published", {"arguments": published_arguments()}, named)


if __name__ == "__main__":
    main()
