"""What people type by mistake: it is understood, or the sentence says what to type."""

from __future__ import annotations

import pytest

from vla_attention.__main__ import main
from vla_attention.analyze.__main__ import main as analyze
from vla_attention.testing.stores import write_store


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return write_store(tmp_path_factory.mktemp("typed") / "a.zarr")


def said(capsys, *words: object, code: int = 2) -> str:
    assert main([str(word) for word in words]) == code
    printed = capsys.readouterr()
    assert "Traceback" not in printed.err
    return printed.err if code else printed.out


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["capture", "pi05"], "use vla-attention capture pi --checkpoint PATH"),
        (["capture", "pi0.5"], "use vla-attention capture pi --checkpoint PATH"),
        (["capture", "smolvla"], "with va.record, or over a data set"),
        (["capture", "pi", "--episodes", "3"], "--num-episodes N is how many of each task, --task which tasks"),
        (["wrods"], "Did you mean 'words'?"),
    ],
)
def test_the_sentence_says_what_to_type(capsys, words, sentence):
    assert sentence in said(capsys, *words)


def test_a_folder_of_stores_is_listed(store, capsys):
    assert "The folder holds the stores a.zarr: name one, or several." in said(capsys, "analyze", store.parent)


def test_the_store_may_stand_first(store, tmp_path, capsys):
    words = ["--no-plots", "--output", tmp_path]
    turned = said(capsys, store, "words", *words, code=0)
    assert (
        turned
        == said(capsys, "words", store, *words, code=0)
        == said(capsys, "analyze", "words", store, *words, code=0)
    )
    assert turned.startswith("WORDS")


def test_a_store_alone_is_analysed(store, tmp_path, capsys):
    words = ["--no-plots", "--output", tmp_path]
    assert said(capsys, store, *words, code=0) == said(capsys, "analyze", store, *words, code=0)


def test_a_ratio_may_name_a_default_group_beside_ones_own(store, tmp_path, capsys):
    words = ["--group", "bowl=word:bowl", "--no-plots", "--output", tmp_path]
    assert "The ratio visual / bowl is" in " ".join(
        said(capsys, "analyze", store, "--ratio", "visual/bowl", *words, code=0).split()
    )
    assert "nouns" in said(capsys, "analyze", store, "--ratio", "visual/nouns", *words)


def test_the_program_that_was_called_is_named(store, capsys):
    assert said(capsys, "words", store, "--layers", 99).startswith("vla-attention words: ")
    assert said(capsys, "analyze", store, "--layers", 99).startswith("vla-attention analyze: ")
    assert analyze(["words", str(store), "--layers", "99"]) == 2
    assert capsys.readouterr().err.startswith("vla-analyze words: ")


@pytest.mark.parametrize(
    "command", ["analyze", "words", "objects", "time", "compare", "view", "copy", "verify", "cache"]
)
def test_a_help_fits_a_screen_and_help_all_has_every_option(capsys, command):
    with pytest.raises(SystemExit):
        main([command, "--help"])
    short = capsys.readouterr().out
    with pytest.raises(SystemExit):
        main([command, "--help-all"])
    whole = capsys.readouterr().out
    assert short.count("\n") <= 30
    assert "--threads" in whole
    assert all(len(line) <= 120 for line in short.splitlines())


def test_the_programs_help_has_every_command_in_some_thirty_lines(capsys):
    from vla_attention.analyze.commands import COMMANDS

    shown = said(capsys, "help", code=0)
    assert shown.count("\n") <= 32
    assert all(f"  {name} " in shown for name in COMMANDS if name != "ratios")
