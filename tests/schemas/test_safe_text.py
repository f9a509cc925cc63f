"""Names that are refused, names as parts of file names, and text whose control characters are visible."""

from __future__ import annotations

import io
import sys
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.kit.examples import examples
from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.results import results_file_name, suite_of_results_file
from vla_attention.schemas.safe_text import (
    check_inner_path,
    check_name,
    check_text,
    file_part,
    plain_stderr,
    visible,
    visible_output,
)


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("put the bowl on the plate", "put the bowl on the plate"),
        ("größer, 大きい ± ½ …", "größer, 大きい ± ½ …"),
        ("\x1b[2Ja\nb\r\x07\x9b", "\\x1b[2Ja\\nb\\r\\x07\\x9b"),
        ("a\u202eb\u2066c\u200bd\ufeff", "a\\u202eb\\u2066c\\u200bd\\ufeff"),
        ("a\u2028b\x85", "a\\u2028b\\x85"),
        ("\ud800", "\\ud800"),
    ],
)
def test_control_and_format_characters_are_escapes(text, shown):
    assert visible(text) == shown
    assert visible(shown) == shown


def test_line_ends_may_stay():
    assert visible("a\n\x1bb\n", keep="\n") == "a\n\\x1bb\n"


@pytest.mark.parametrize("name", ["", " ", ".", "..", "a/b", "../../x", "/etc/x", "a\\b", "a\x1bb", "a\nb", "a\u202eb"])
def test_names_that_are_paths_or_not_printable_are_refused(name):
    with pytest.raises(BadArgument) as error:
        check_name("suite", name)
    assert str(error.value).isprintable()
    assert "suite" in str(error.value)


def test_usual_names_are_accepted():
    for name in ("libero_10", "akita_black_bowl_1", "left wrist", "größe", "<b>", "$x$", "a..b"):
        check_name("suite", name)
    check_text("checkpoint", "gs://openpi-assets/checkpoints/pi05_libero")
    check_inner_path("joint/rows/c.0.0")


@pytest.mark.parametrize("path", ["", "/etc/x", "../x", "a/../../x", "a//b", "a/./b", "a\\..\\b", "a\x1b"])
def test_paths_that_leave_their_folder_are_refused(path):
    with pytest.raises(BadArgument):
        check_inner_path(path)


@settings(max_examples=examples(100), deadline=None)
@given(st.text(), st.text())
def test_parts_of_file_names_are_one_part_stay_different_and_are_read_back(first, second):
    part = file_part(first)
    assert part.isprintable()
    assert Path("folder", f"x_{part}.json").parent == Path("folder")
    assert not part.startswith(".")
    assert (part == file_part(second)) == (first == second)
    assert suite_of_results_file(Path(results_file_name(first))) == first


def test_usual_names_are_file_names_as_they_are():
    assert results_file_name("libero_10") == "attention_ratio_results_libero_10.json"
    assert file_part("soup and sauce") == "soup and sauce"
    assert file_part("../../x") == "%2E.%2F..%2Fx"


def test_what_a_block_prints_is_visible_and_the_rest_of_the_streams_is_theirs(monkeypatch):
    out, err = io.StringIO(), io.StringIO()
    monkeypatch.setattr(sys, "stdout", out)
    monkeypatch.setattr(sys, "stderr", err)
    with visible_output():
        print("a\x1b[1m", "b", sep="\n")
        print("c\u202e", file=sys.stderr)
        assert plain_stderr() is err
        assert not sys.stdout.isatty()
    assert (sys.stdout, sys.stderr) == (out, err)
    assert (out.getvalue(), err.getvalue()) == ("a\\x1b[1m\nb\n", "c\\u202e\n")


@pytest.mark.parametrize(
    ("encoding", "written"), [("latin-1", b"pot...\xd7 \\u2581\n"), ("utf-8", "pot\u2026\xd7 \u2581\n".encode())]
)
def test_a_terminal_of_another_encoding_shows_what_it_can(monkeypatch, encoding, written):
    terminal = io.TextIOWrapper(io.BytesIO(), encoding=encoding, newline="\n")
    monkeypatch.setattr(sys, "stdout", terminal)
    with visible_output():
        print("pot\u2026\xd7 \u2581")
    terminal.flush()
    assert terminal.buffer.getvalue() == written
