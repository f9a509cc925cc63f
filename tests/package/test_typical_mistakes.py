"""What people type by mistake: it is understood, or the sentence says what to type."""

from __future__ import annotations

import pytest

from tests.kit.stores import write_store
from vla_attention.__main__ import main


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return write_store(tmp_path_factory.mktemp("typed") / "a.zarr")


def said(capsys, *words: object, code: int = 2) -> str:
    try:
        ended: object = main([str(word) for word in words])
    except SystemExit as end:  # of a mistake in the arguments
        ended = end.code
    assert ended == code
    printed = capsys.readouterr()
    assert "Traceback" not in printed.err
    return printed.err if code else printed.out


@pytest.mark.parametrize(
    ("words", "typed"),
    [
        (["capture", "pi05"], "vla-attention capture pi --checkpoint PATH"),
        (["capture", "pi0.5"], "vla-attention capture pi --checkpoint PATH"),
        (["capture", "smolvla"], "va.record"),
        (["capture", "pi", "--episodes", "3"], "--num-episodes N"),
        (["wrods"], "'words'"),
        (["analyze", "STORE", "--output-dir", "out"], "--output FOLDER"),
        (["words", "STORE", "-o", "out"], "--output FOLDER"),
        (["analyze", "STORE", "--plot-all"], "--no-plots"),
        (["objects", "STORE", "--plots"], "--no-plots"),
        (["analyze", "STORE", "--format=csv"], "--csv"),
        (["analyze", "STORE", "--gruoping", "cameras"], "'--grouping'"),
        (["store", "verify", "STORE", "--quik"], "'--quick'"),
        (["store", "verfy", "STORE"], "'verify'?"),
        (["words", "STORE", "--twins", "STORE"], "an option of failures"),
        (["words", "STORE", "--task", "0-999999999999"], "at most 10,000"),
        (["analyze", "STORE", "--output", "OUT/a.csv"], "folder"),
        (["compare", "STORE", "STORE", "--output", "OUT/a.JSON"], "folder"),
        (["report", "STORE", "--output", "OUT/a.json"], "FILE.html"),
        (["analyze", "OUT/nowhere.zarr"], "vla-attention capture pi --output NAME.zarr"),
        (["analyze", "OUT/empty.zarr"], "vla-attention capture pi --output NAME.zarr"),
    ],
)
def test_the_sentence_says_what_to_type(store, tmp_path, capsys, words, typed):
    (tmp_path / "empty.zarr").mkdir()
    words = [word.replace("STORE", str(store)).replace("OUT", str(tmp_path)) for word in words]
    answer = said(capsys, *words)
    assert typed in answer
    assert f"{tmp_path}: " not in answer  # what is no store is not offered
    assert [entry.name for entry in tmp_path.iterdir()] == ["empty.zarr"]


@pytest.mark.parametrize(
    "words", [["--layers", "0,2"], ["--heads", "0,1"], ["--denoise", "0,9"], ["--denoise", "first,last"]]
)
def test_several_numbers_may_have_commas_between(store, tmp_path, capsys, words):
    option, text = words
    spaced = [option, *text.split(",")]
    more = ["--no-plots", "--output", tmp_path]
    assert said(capsys, "analyze", store, *words, *more, code=0) == said(
        capsys, "analyze", store, *spaced, *more, code=0
    )


def test_the_store_may_stand_first(store, tmp_path, capsys):
    words = ["--no-plots", "--output", tmp_path]
    turned = said(capsys, store, "words", *words, code=0)
    assert (
        turned
        == said(capsys, "words", store, *words, code=0)
        == said(capsys, "analyze", "words", store, *words, code=0)
    )
    assert "words" in turned


def test_a_store_alone_is_analysed(store, tmp_path, capsys):
    words = ["--no-plots", "--output", tmp_path]
    assert said(capsys, store, *words, code=0) == said(capsys, "analyze", store, *words, code=0)


def test_a_ratio_may_name_a_default_group_beside_ones_own(store, tmp_path, capsys):
    words = ["--group", "bowl=word:bowl", "--no-plots", "--output", tmp_path]
    assert "visual to bowl" in " ".join(
        said(capsys, "analyze", store, "--ratio", "visual/bowl", *words, code=0).split()
    )
    assert "nouns" in said(capsys, "analyze", store, "--ratio", "visual/nouns", *words)
