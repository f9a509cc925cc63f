from __future__ import annotations

from dataclasses import replace

import pytest

from vla_attention.schemas.groupings.builtin_groupings import find_grouping
from vla_attention.schemas.groupings.grouping import (
    Grouping,
    GroupingError,
    GroupingNotFound,
    Ratio,
    parse_group_argument,
    parse_ratio_argument,
    read_grouping_file,
    with_groups,
)
from vla_attention.schemas.groupings.selectors import SelectorError
from vla_attention.schemas.groupings.vocabulary import Vocabulary
from vla_attention.schemas.layout import SiteLayout, Span

VOCABULARY = Vocabulary(
    SiteLayout("joint", (Span("base", "image", 0, 1, "base"), Span("prompt", "text", 1, 2))),
    cameras=("base", "wrist"),
    roles=("image", "instruction"),
    words=("bowl",),
    objects=("bowl_1",),
)


def read(tmp_path, text: str) -> Grouping:
    path = tmp_path / "mine.toml"
    path.write_text(text)
    return read_grouping_file(path)


def test_a_file_keeps_order_lists_and_ratio(tmp_path):
    grouping = read(
        tmp_path,
        'name = "n"\n[groups]\nb = "camera:base"\na = ["word:bowl", "word:plate"]\nrest = "*"\n'
        '[ratio]\nnumerator = ["b"]\ndenominator = ["a"]\n',
    )
    assert grouping.names == ("b", "a", "rest")
    assert grouping.groups["a"] == ("word:bowl", "word:plate")
    assert grouping.ratio == Ratio(("b",), ("a",))


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("[groups\n", "TOML"),
        ("", r"\$: .*'groups'"),
        ("[groups]\n", "no groups"),
        ("[groups]\na = 3\n", r"\$.groups.a: .*'int'"),
        ('[groups]\na = "camera:"\n', "'a'.*'camera:'"),
        ('[group]\na = "*"\n', "'group'.*'groups'"),
        ('[groups]\na = "*"\n[ratio]\nnumerator = ["a"]\ndenominator = ["b"]\n', "'b'"),
        ('[groups]\na = "*"\n[ratio]\nnumerator = ["a"]\ndenominator = []\n', "denominator"),
        ('[groups]\na = ["*", "word:x"]\n', r"'a'.*'\*'"),
        ("[groups]\na = []\n", "'a'"),
        ('[groups]\nratio = "*"\n', "'ratio'"),
    ],
)
def test_errors_in_a_file_name_it_and_the_place(tmp_path, text, named):
    with pytest.raises((GroupingError, SelectorError, ValueError), match=named) as caught:
        read(tmp_path, text)
    assert "mine.toml" in str(caught.value)


def test_finding_a_grouping(tmp_path):
    assert find_grouping("cameras", VOCABULARY).ratio == Ratio(("base", "wrist"), ("linguistic",))
    assert "bowl_1" in find_grouping("objects", VOCABULARY).names
    # A site without text (Cosmos's self-attention) has nothing to divide by.
    assert find_grouping("default", replace(VOCABULARY, roles=("image", "blank"))).ratio is None
    with pytest.raises(GroupingNotFound, match="'cameras'"):
        find_grouping("camera", VOCABULARY)
    with pytest.raises(GroupingNotFound, match=r"'reference:x'.*'reference:N'"):
        find_grouping("reference:x", VOCABULARY)
    with pytest.raises(GroupingNotFound, match=r"none\.toml"):
        find_grouping(str(tmp_path / "none.toml"), VOCABULARY)


def test_groups_from_the_command_line():
    assert parse_group_argument("a = word:x | word:y") == ("a", "word:x | word:y")
    assert parse_ratio_argument("a,b / c") == Ratio(("a", "b"), ("c",))
    for wrong in ("a", "=x", "a="):
        with pytest.raises(GroupingError, match=f"'{wrong}'"):
            parse_group_argument(wrong)
    for wrong in ("a", "a/", "/b"):
        with pytest.raises(GroupingError, match=f"'{wrong}'"):
            parse_ratio_argument(wrong)


def test_command_line_groups_alone_get_a_rest_and_repeat_as_a_union():
    alone = with_groups(None, [("a", "word:x"), ("a", "word:y"), ("b", "camera:base")])
    assert alone.groups == {"a": ("word:x", "word:y"), "b": ("camera:base",), "rest": ("*",)}
    assert with_groups(None, [("a", "word:x"), ("others", "*")]).names == ("a", "others")


def test_command_line_groups_replace_those_of_the_same_name():
    base = Grouping("base", {"a": ("word:x",), "rest": ("*",)}, ratio=Ratio(("a",), ("rest",)))
    changed = with_groups(base, [("a", "word:y")])
    assert changed.groups == {"a": ("word:y",), "rest": ("*",)}
    assert changed.ratio == base.ratio
    assert changed.name == "base+a"
