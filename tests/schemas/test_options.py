"""Options from settings: names, types, defaults, least numbers; ranges; tasks by their words."""

from __future__ import annotations

import argparse
import re
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import pytest

from vla_attention.schemas.errors import BadArgument, Note, UnknownName
from vla_attention.schemas.layers import select_layers
from vla_attention.schemas.options import add_options, number_range, option, read_options, resolve_tasks, task_option

INSTRUCTIONS = {0: "lift the red cube", 1: "lift the green cube", 4: "Lift the  red cube"}


@dataclass(frozen=True)
class Settings:
    """A field of each kind."""

    place: str = option("where it goes")  # follows from others where it is not given
    tasks: tuple[int | str, ...] | None = task_option("tasks")
    layers: tuple[int, ...] | None = option("layers (default: all)", None, group="what")
    words: tuple[str, ...] = option("words", ("first", "last"), name="denoise")
    images: tuple[str, ...] = option("pictures", (), action="append")
    number: int = option("a number (default: %(default)s)", 5, least=1)
    seed: int | None = option("a seed (default: 7)", None, least=0)
    weight: float = option("a share", 0.5)
    kind: Literal["mean", "all"] | None = option("which", None)
    folder: Path | None = option("a folder", None, group="where", also="output-dir", dest="output_dir")
    kept: bool = option("keep it", True)
    resume: bool = option("go on", False, either="existing")
    overwrite: bool = option("begin again", False, either="existing")
    found: int = 3


def parser(**more: Any) -> argparse.ArgumentParser:
    made = argparse.ArgumentParser()
    add_options(made, Settings, **more)
    return made


def read(*words: str) -> Settings:
    return read_options(Settings, parser().parse_args(words), **({} if "--place" in words else {"place": "here"}))


def test_without_options_settings_are_their_defaults():
    assert read() == Settings("here")


def test_what_is_given_has_the_type_of_its_field():
    given = read(
        *("--place", "there", "--layers", "0-2", "7", "--denoise", "all", "--images", "a", "--images", "b"),
        *("--number", "1", "--seed", "0", "--weight", "0.25", "--kind", "all", "--no-kept", "--overwrite"),
    )
    assert given == Settings(
        "there", None, (0, 1, 2, 7), ("all",), ("a", "b"), 1, 0, 0.25, "all", kept=False, overwrite=True
    )
    assert read_options(Settings, argparse.Namespace(found=4), place="", number=9) == Settings("", number=9, found=4)


@pytest.mark.parametrize(
    ("words", "named"),
    [(["--number", "0"], "--number 0; .* 1"), (["--seed", "-1"], "--seed -1; .* 0")],
)
def test_a_number_below_the_least_is_refused(words, named):
    with pytest.raises(BadArgument, match=named):
        read(*words)


@pytest.mark.parametrize("words", [["--kind", "none"], ["--resume", "--overwrite"], ["--number", "x"]])
def test_what_cannot_be_ends_with_2(words, capsys):
    with pytest.raises(SystemExit) as ended:
        read(*words)
    assert (ended.value.code, words[0] in capsys.readouterr().err) == (2, True)


def test_a_help_names_each_option_once_and_no_published_name():
    shown = parser().format_help().partition("\n\n")[2]
    for one in ("place", "task", "layers", "denoise", "number", "folder", "kept", "resume"):
        assert shown.count(f"--{one} ") + shown.count(f"--{one},") == 1, one
    assert not {"--task-id", "--output-dir"} & set(shown.split())


def test_a_command_says_and_leaves_out_what_is_its_own():
    shown = parser(defaults="as in the store", number="of another kind", seed=None).format_help()
    assert "what (default: as in the store):" in shown
    assert ("of another kind" in shown, "--seed" in shown, "(default: all)" in shown) == (True, False, False)
    assert parser(number={"default": 8}).parse_args([]).number == 8


def test_published_names_are_silent():
    with warnings.catch_warnings():
        warnings.simplefilter("error", Note)
        given = parser().parse_args(["--task-id", "5", "--output-dir", "results"])
    assert (given.task_id, given.output_dir) == ([5], Path("results"))


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
    with pytest.raises(BadArgument, match=r"0-17.* 18-35"):
        select_layers(range(16, 20), 18, "pi05")
    assert select_layers(range(16, 20), 28, "cosmos").blocks == (16, 17, 18, 19)


def test_tasks_are_chosen_by_number_or_by_their_words(capsys):
    given = parser().parse_args(["--task", "1-2", "LIFT the green cube", "0"]).task_id
    assert given == [1, 2, "LIFT the green cube", 0]
    assert resolve_tasks(given, INSTRUCTIONS, "the suite") == (1, 2, 0)
    with pytest.warns(Note, match="0, 4 .*'lift the red cube'"):
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
    with pytest.raises(UnknownName, match="'lift the green cube'"):
        resolve_tasks(["lift the gren cube"], INSTRUCTIONS, "the suite")
