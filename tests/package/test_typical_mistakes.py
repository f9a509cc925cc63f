"""What people type by mistake: it is understood, or the sentence says what to type."""

from __future__ import annotations

import pytest

from tests.kit.stores import write_store
from vla_attention.__main__ import main


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


def test_the_store_may_stand_first(store, tmp_path, capsys):
    words = ["--no-plots", "--output", tmp_path]
    turned = said(capsys, store, "words", *words, code=0)
    assert (
        turned
        == said(capsys, "words", store, *words, code=0)
        == said(capsys, "analyze", "words", store, *words, code=0)
    )
    assert "Which words are read?" in turned


def test_a_store_alone_is_analysed(store, tmp_path, capsys):
    words = ["--no-plots", "--output", tmp_path]
    assert said(capsys, store, *words, code=0) == said(capsys, "analyze", store, *words, code=0)


def test_a_ratio_may_name_a_default_group_beside_ones_own(store, tmp_path, capsys):
    words = ["--group", "bowl=word:bowl", "--no-plots", "--output", tmp_path]
    assert "The ratio of visual to bowl is" in " ".join(
        said(capsys, "analyze", store, "--ratio", "visual/bowl", *words, code=0).split()
    )
    assert "nouns" in said(capsys, "analyze", store, "--ratio", "visual/nouns", *words)
