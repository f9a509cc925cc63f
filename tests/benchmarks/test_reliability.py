"""`benchmarks/reliability.py`: what its cases become in the tables, and that an interrupted run goes on."""

from __future__ import annotations

from benchmarks.measurement import read_rows, write_rows
from benchmarks.reliability import PARTS, fuzz_table, kill_table, race_table, rot_table
from benchmarks.reliability_kill import COUNTS, SERIES
from benchmarks.reliability_state import Results

ENDED = {"compared": 3, "changed": 0, "faulty": False, "completed": False, "unlike": False, "problems": []}


def test_an_interrupted_run_goes_on_where_it_stopped(tmp_path, capsys):
    results = Results(tmp_path / "kill.jsonl")
    assert results.missing("a", range(3)) == [0, 1, 2]
    results.add({"series": "a", "number": 1, "problems": []})
    results.add({"series": "b", "number": 0, "problems": ["it changed"]})
    assert capsys.readouterr().out == "b 0: it changed\n"
    with results.path.open("a") as file:
        file.write('{"series": "a", "num')  # killed while it wrote
    assert results.missing("a", range(3)) == [0, 2]
    assert list(results.series()) == ["a", "b"]


def test_kills_are_counted(tmp_path):
    results = Results(tmp_path / "kill.jsonl")
    for number, completed in enumerate((False, True)):
        results.add({"series": "SIGKILL", "number": number, "code": -9 * number, **ENDED, "completed": completed})
    results.add({"series": "full disk", "number": 0, "code": 0, **ENDED, "problems": ["late"]})
    rows, note = kill_table(results).rows, kill_table(results).note
    assert note.startswith(f"The run was cut short; not tried yet: {COUNTS['SIGKILL, one simulator']} by SIGKILL, one")
    assert [row["times"] for row in rows] == [1, 1]  # one capture ended before the signal
    assert [row["compared"] for row in rows] == [6, 3]
    assert [row["completed"] for row in rows] == [1, 0]
    assert [row["other"] for row in rows] == [0, 1]


def test_damages_are_counted(tmp_path):
    results = Results(tmp_path / "rot.jsonl")
    answers = (["refused", "same"], ["different"], ["ZeroDivisionError: x"])
    for number, found in enumerate(answers):
        case = {"series": "rows", "number": number, "named": number == 0, "answers": found, "problems": []}
        results.add(case)
    table = rot_table(results)
    assert table.rows[0] == {
        "kind": "rows",
        "damages": 3,
        "named": 1,
        "analyses": 4,
        "refused": 1,
        "same": 1,
        "different": 1,
        "errors": 1,
    }
    assert table.rows[1] == {**table.rows[0], "kind": "all"}


def test_races_and_fuzzing_are_counted(tmp_path):
    race, fuzz = Results(tmp_path / "race.jsonl"), Results(tmp_path / "fuzz.jsonl")
    case = {"series": "race", "victim": 1, "committed": 4, "changed": [], "twice": [], "unlike": [], "problems": []}
    race.add({**case, "number": 0, "exit_codes": [0, -9]})
    race.add({**case, "number": 1, "exit_codes": [0, 0], "unlike": ["zarr.json"], "problems": ["unlike"]})
    (row,) = race_table(race).rows
    assert (row["rounds"], row["killed"], row["committed"], row["unlike"], row["other"]) == (2, 1, 8, 1, 1)
    for number in range(2):
        fuzz.add({"series": "roots", "number": number, "inputs": 100, "seconds": 90.0, "problems": ["a"] * number})
    (row,) = fuzz_table(fuzz).rows
    assert row == {"target": "`roots`", "inputs": 200, "minutes": 3.0, "open": 1}


def test_the_tables_can_be_written(tmp_path):
    for name, (_, table) in PARTS.items():
        results = Results(tmp_path / f"{name}.jsonl")
        write_rows("reliability", {name: table(results)}, command="x", folder=tmp_path)
    assert set(read_rows(tmp_path / "reliability.json")) == set(PARTS)


def test_every_series_of_kills_has_a_number_of_cases():
    assert set(COUNTS) == set(SERIES)
