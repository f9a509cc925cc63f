"""Write `docs/examples`: what questions print about a store without anything to find, and about a planted one.

    python docs/make_examples.py

The stores are those of `benchmarks/null_stores.py`, with two plants in one: the word "the" and the first object get
more attention than the others. `compare` compares two null runs, and a null run with the planted one.
"""

from __future__ import annotations

import contextlib
import io
import os
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.null_stores import SPEC as NULL_STORE
from benchmarks.null_stores import Rows, normalised, plant_of
from tests.kit.stores import write_store
from vla_attention.analyze.__main__ import main as analyze
from vla_attention.schemas.groupings.vocabulary import EpisodeTokens

FOLDER = Path(__file__).parent / "examples"
COMMANDS = ("analyze", "words", "objects")
SPEC = replace(NULL_STORE, contributions=True)


def plant_all(task: int, episode: int, tokens: EpisodeTokens, rows: Rows) -> Rows:
    """The plants of words and objects, one upon the other."""
    made = plant_of("words", 0, planted=True)(task, episode, tokens, rows)
    plain = plant_of("objects", 0, planted=False)(task, episode, tokens, rows)
    return normalised(made * plant_of("objects", 0, planted=True)(task, episode, tokens, rows) / plain.clip(1e-12))


def printed(*arguments: str) -> str:
    """What one command prints, without the lines that name the written files."""
    output = io.StringIO()
    with contextlib.redirect_stdout(output):
        code = analyze([*arguments, "--no-plots", "--output", "out"])
    if code:
        raise SystemExit(f"vla-attention analyze {' '.join(arguments)} failed")
    return output.getvalue()


def main() -> None:
    """Write one text file per store and command."""
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        write_store(Path("null.zarr"), spec=replace(SPEC, plant_rows=plant_of("words", 2, planted=False)))
        write_store(Path("other.zarr"), spec=replace(SPEC, plant_rows=plant_of("words", 4, planted=False)))
        write_store(Path("planted.zarr"), spec=replace(SPEC, plant_rows=plant_all))
        for name in ("null", "planted"):
            (FOLDER / name).mkdir(parents=True, exist_ok=True)
            for command in COMMANDS:
                (FOLDER / name / f"{command}.txt").write_text(printed(command, f"{name}.zarr"))
        for name, other in (("null", "other"), ("planted", "planted")):
            (FOLDER / name / "compare.txt").write_text(printed("compare", "null.zarr", f"{other}.zarr"))


if __name__ == "__main__":
    main()
