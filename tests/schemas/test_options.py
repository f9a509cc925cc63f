"""Options of both command lines: published names, ranges, tasks by their words."""

from __future__ import annotations

import argparse
import re
import warnings

import pytest

from vla_attention.schemas.errors import BadArgument, Note, UnknownName
from vla_attention.schemas.layers import select_layers
from vla_attention.schemas.options import Numbers, add_capture_output, add_task, number_range, resolve_tasks

INSTRUCTIONS = {0: "lift the red cube", 1: "lift the green cube", 4: "Lift the  red cube"}


def parser() -> argparse.ArgumentParser:
    made = argparse.ArgumentParser()
    add_task(made, "task_id", "tasks")
    made.add_argument("--layers", type=number_range, nargs="+", action=Numbers)
    add_capture_output(made, "PATH", "the store")
    return made


def test_published_names_are_silent_and_no_help_shows_either():
    with warnings.catch_warnings():
        warnings.simplefilter("error", Note)
        given = parser().parse_args(["--task-id", "5", "--output-dir", "results"])
    assert (given.task_id, str(given.output_dir), given.store) == ([5], "results", None)
    shown = parser().format_help()
    assert "--task " in shown
    for name in ("--task-id", "--output-dir"):
        assert name not in shown


def test_an_output_is_a_store_or_a_folder():
    given = parser().parse_args(["--output", "runs/a.zarr", "--output", "results"])
    assert (str(given.store), str(given.output_dir)) == ("runs/a.zarr", "results")


def test_ranges_and_numbers_are_one_list():
    assert parser().parse_args(["--layers", "0-2", "7", "9-9"]).layers == [0, 1, 2, 7, 9]
    assert parser().parse_args(["--layers", "0,5", "7-8,2", "3, 4", "1,"]).layers == [0, 5, 7, 8, 2, 3, 4, 1]
    for wrong in (
        "2-1",
        "1-99999",
        "x",
        "1-",
        "1.5",
        "0;5",
        "0..5",
        "[0]",
        ",",
        "",
        "0,,5",
        "0,x",
        ",".join(["0-9999"] * 2),
    ):
        with pytest.raises(argparse.ArgumentTypeError, match=f"^'{re.escape(wrong)}' is"):
            number_range(wrong)


def test_a_range_of_layers_stays_on_one_side_of_the_published_numbers():
    assert select_layers(range(18), 18, "pi05").blocks == tuple(range(18))
    assert select_layers(range(18, 36), 18, "pi05").blocks == tuple(range(18))
    assert select_layers([0, 8, 17, 25, 26, 27], 18, "pi05").blocks == (0, 8, 17, 7, 8, 9)
    with pytest.raises(BadArgument, match=r"A range stays on one side: 0-17, or 18-35\."):
        select_layers(range(16, 20), 18, "pi05")
    assert select_layers(range(16, 20), 28, "cosmos").blocks == (16, 17, 18, 19)


def test_tasks_are_chosen_by_number_or_by_their_words(capsys):
    given = parser().parse_args(["--task", "1-2", "LIFT the green cube", "0"]).task_id
    assert given == [1, 2, "LIFT the green cube", 0]
    assert resolve_tasks(given, INSTRUCTIONS, "the suite") == (1, 2, 0)
    with pytest.warns(Note, match="Tasks 0, 4 of the suite have the instruction 'lift the red cube': all of them"):
        assert resolve_tasks(["lift the red cube"], INSTRUCTIONS, "the suite") == (0, 4)
    assert parser().parse_args(["--task", "0,5", "1, 2-3"]).task_id == [0, 5, 1, 2, 3]
    assert resolve_tasks(["0,4", 1], INSTRUCTIONS, "the suite") == (0, 4, 1)
    for wrong in ("0;5", "0..5", "[0, 5]", "0:5", "#3", ",", ""):  # no letter, so no instruction
        with pytest.raises(SystemExit):
            parser().parse_args(["--task", wrong])
        assert f"'{wrong}' is" in capsys.readouterr().err
        with pytest.raises(BadArgument, match=f"'{re.escape(wrong)}' is"):
            resolve_tasks([wrong], INSTRUCTIONS, "the suite")
    assert resolve_tasks(["1, 2, 3!"], {7: "1, 2, 3!"}, "the suite") == (7,)
    with pytest.raises(UnknownName, match="Did you mean 'lift the green cube'"):
        resolve_tasks(["lift the gren cube"], INSTRUCTIONS, "the suite")
