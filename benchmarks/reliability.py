"""How reliable stores are: captures that are killed, files that rot, processes that race.

Usage: python benchmarks/reliability.py PART [--folder FOLDER] [--share 0.1]
       python benchmarks/reliability.py rows [--folder FOLDER]
PART: kill, rot, race

Every part writes each case into FOLDER as it ends, and goes on where an earlier run stopped. `rows` makes the tables of
benchmarks/rows/reliability.json from what is there. A case that shows a problem is printed, and its files stay in
FOLDER/PART. `--share` tries a part of the cases: 0.1 a tenth. Whole runs take an hour (kill), 20 minutes (rot) and ten
minutes (race) on two cores. Kill needs root for the full disk.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parent))

from measurement import ROOT, Table, fix_threads, write_rows
from reliability_state import Results

#: Damages of every kind of file, and rounds of races.
DAMAGES, ROUNDS = 200, 20
PROCESSES = 8

Rows = list[dict[str, Any]]
#: Beginnings of the names of series in which a capture may end before its signal comes.
_SIGNALS = ("SIG", "Ctrl-C")


def kill(folder: Path, results: Results, share: float) -> None:
    """Captures that end in every way."""
    from reliability_kill import COUNTS, run

    run(folder, results, {name: max(1, round(count * share)) for name, count in COUNTS.items()})


def race(folder: Path, results: Results, share: float) -> None:
    """Processes with overlapping lists, of which one is killed."""
    from dataclasses import asdict

    from tests.kit.races import rounds

    for number in results.missing("race", range(max(1, round(ROUNDS * share)))):
        (found,) = rounds(folder, [number], PROCESSES)
        results.add({"series": "race", "number": number, **asdict(found), "problems": found.problems})


def rot(folder: Path, results: Results, share: float) -> None:
    """Damaged files of every kind, each followed by `verify` and by analyses that read the file."""
    from tests.kit.damages import KINDS, draw, make_subjects, tried

    with tempfile.TemporaryDirectory(dir=folder) as temporary:
        subjects = make_subjects(Path(temporary))
        for kind in KINDS:
            having = [subject for subject in subjects.values() if kind.name in subject.files()]
            for number in results.missing(kind.name, range(max(1, round(DAMAGES * share)))):
                subject = having[number % len(having)]
                damage = draw(subject, kind.name, number)
                noticed = tried(subject, damage)
                case = {"series": kind.name, "number": number, "what": damage.what, "path": damage.path}
                answers = list(noticed.analyses.values())
                results.add({**case, "named": noticed.named, "answers": answers, "problems": noticed.problems})


def kill_table(results: Results) -> Table:
    """A row for each way to end a capture."""
    rows: Rows = [
        {
            "what": name,
            "times": sum(case["code"] != 0 for case in cases) if name.startswith(_SIGNALS) else len(cases),
            "compared": sum(case["compared"] for case in cases),
            "changed": sum(case["changed"] for case in cases),
            "faulty": sum(case["faulty"] for case in cases),
            "completed": sum(case["completed"] for case in cases),
            "unlike": sum(case["unlike"] for case in cases),
            "other": sum(bool(case["problems"]) for case in cases),
        }
        for name, cases in results.series().items()
    ]
    columns = {
        "what": "the capture ends by",
        "times": "times",
        "compared": "committed episodes compared",
        "changed": "changed",
        "faulty": "stores with a fault",
        "completed": "stores completed by resuming",
        "unlike": "unlike an undisturbed one",
        "other": "cases with any problem",
    }
    return Table(columns, rows, _cut_short({name: len(cases) for name, cases in results.series().items()}))


def _cut_short(tried: dict[str, int]) -> str:
    """A sentence that says which kills of a whole run were not tried; empty if all were."""
    from reliability_kill import COUNTS

    left = {name: count - tried.get(name, 0) for name, count in COUNTS.items() if name.startswith(_SIGNALS)}
    missing = [f"{count} by {name}" for name, count in left.items() if count > 0]
    return f"The run was cut short; not tried yet: {', '.join(missing)}." if missing else ""


def rot_table(results: Results) -> Table:
    """A row for each kind of file."""
    rows: Rows = []
    for name, cases in results.series().items():
        answers = [answer for case in cases for answer in case["answers"]]
        rows.append(
            {
                "kind": name,
                "damages": len(cases),
                "named": sum(case["named"] for case in cases),
                "analyses": len(answers),
                "refused": answers.count("refused"),
                "same": answers.count("same"),
                "different": answers.count("different"),
                "errors": len(answers) - sum(answers.count(one) for one in ("refused", "same", "different")),
            }
        )
    total = {key: sum(row[key] for row in rows) for key in (rows[0] if rows else {}) if key != "kind"}
    columns = {
        "kind": "damaged file",
        "damages": "damages",
        "named": "found and named by `verify`",
        "analyses": "analyses",
        "refused": "refused",
        "same": "the same numbers",
        "different": "other numbers",
        "errors": "tracebacks",
    }
    return Table(columns, [*rows, {"kind": "all", **total}])


def race_table(results: Results) -> Table:
    """One row: all rounds."""
    cases = results.cases()
    killed = sum(case["exit_codes"][case["victim"]] == -9 for case in cases)
    row = {
        "rounds": len(cases),
        "processes": PROCESSES,
        "killed": killed,
        "committed": sum(case["committed"] for case in cases),
        "changed": sum(len(case["changed"]) for case in cases),
        "twice": sum(len(case["twice"]) for case in cases),
        "unlike": sum(bool(case["unlike"]) for case in cases),
        "other": sum(bool(case["problems"]) for case in cases),
    }
    columns = {
        "rounds": "rounds",
        "processes": "processes in each",
        "killed": "processes killed before their end",
        "committed": "episodes committed when it was killed",
        "changed": "files of these changed",
        "twice": "episodes recorded twice",
        "unlike": "stores unlike one process's",
        "other": "rounds with any problem",
    }
    return Table(columns, [row])


Part = tuple[Callable[[Path, Results, float], None], Callable[[Results], Table]]
PARTS: dict[str, Part] = {
    "kill": (kill, kill_table),
    "rot": (rot, rot_table),
    "race": (race, race_table),
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run a part, or write the rows; exit code 1 if a case shows a problem."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=(*PARTS, "rows"))
    parser.add_argument("--folder", type=Path, default=ROOT / "results" / "reliability")
    parser.add_argument("--share", type=float, default=1.0, help="part of the cases")
    arguments = parser.parse_args(argv)
    every = {name: Results(arguments.folder / f"{name}.jsonl") for name in PARTS}
    if arguments.part == "rows":
        for name, results in every.items():
            if results.cases():
                command = f"python benchmarks/reliability.py {name}"
                write_rows("reliability", {name: PARTS[name][1](results)}, command=command)
        return 0
    fix_threads(1)
    os.environ["VLA_CACHE"] = "off"  # what is tried is read
    os.environ.setdefault("MUJOCO_GL", "egl")
    folder = (arguments.folder / arguments.part).resolve()
    folder.mkdir(parents=True, exist_ok=True)
    PARTS[arguments.part][0](folder, every[arguments.part], arguments.share)
    return int(any(case["problems"] for case in every[arguments.part].cases()))


if __name__ == "__main__":
    sys.exit(main())
