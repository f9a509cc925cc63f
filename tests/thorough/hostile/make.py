"""Writes the hostile stores, results files and groupings: `python -m tests.thorough.hostile.make FOLDER`."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Sequence
from pathlib import Path

from tests.kit.stores import write_store
from tests.thorough.hostile.array_cases import ARRAY_CASES
from tests.thorough.hostile.changes import Case
from tests.thorough.hostile.document_cases import GROUPING_CASES, RESULTS_CASES
from tests.thorough.hostile.episode_cases import EPISODE_CASES
from tests.thorough.hostile.root_cases import ROOT_CASES

#: Cases by what they change: a store, or nothing but a file.
CASES: dict[str, list[Case]] = {
    "roots": ROOT_CASES,
    "episodes": EPISODE_CASES,
    "arrays": ARRAY_CASES,
    "results": RESULTS_CASES,
    "groupings": GROUPING_CASES,
}
#: The program of each kind of cases, where it is not `vla-analyze`.
PROGRAMS = {"results": "parse"}
_FILE_NAMES = {"results": "attention_ratio_results_x.json", "groupings": "grouping.toml"}


def originals(folder: Path) -> dict[str, Path]:
    """Write the store that is changed; it is of one episode."""
    store = write_store(folder / "plain" / "a.zarr", tasks=(0,), episodes=1, replans=2, contributions=True)
    return dict.fromkeys(CASES, store)


def make_case(kind: str, case: Case, original: Path, folder: Path) -> list[str]:
    """Write what one case needs below a folder; returns the words of its command."""
    store, file = folder / "a.zarr", folder / _FILE_NAMES.get(kind, "file")
    if kind in _FILE_NAMES:
        folder.mkdir(parents=True)
        store = original
        case.make(file)
    else:
        shutil.copytree(original, store)
        case.make(store)
    places = {"STORE": store, "FILE": file, "OUT": folder / ("out.txt" if kind == "results" else "out")}
    return [str(places.get(word, word)) for word in case.words]


def main(arguments: Sequence[str]) -> None:
    """Write every case into a folder of its own, and print its command."""
    (folder,) = map(Path, arguments)
    made = originals(folder / "originals")
    for kind, cases in CASES.items():
        for i, case in enumerate(cases):
            words = make_case(kind, case, made[kind], folder / kind / f"{i:02d}")
            print(f"{case.name}: {' '.join(words)}")


if __name__ == "__main__":
    main(sys.argv[1:])
