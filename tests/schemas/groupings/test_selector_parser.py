from __future__ import annotations

import pytest

from vla_attention.schemas.groupings.selector_parser import Atom, Everything, Operation, parse_selector
from vla_attention.schemas.groupings.selectors import SelectorError


def test_and_binds_tighter_than_or_and_minus():
    tree = parse_selector("camera:a | role:image & object:bowl_1 - keys:3-9")
    assert tree == Operation(
        "-",
        Operation("|", Atom("camera", "a"), Operation("&", Atom("role", "image"), Atom("object", "bowl_1"))),
        Atom("keys", "3-9"),
    )


def test_minus_and_or_associate_to_the_left():
    assert parse_selector("* - role:bos - role:padding") == Operation(
        "-", Operation("-", Everything(), Atom("role", "bos")), Atom("role", "padding")
    )


def test_parentheses_quotes_and_hyphens_in_names():
    assert parse_selector('(word:"black bowl")&object:salad-dressing') == Operation(
        "&", Atom("word", "black bowl"), Atom("object", "salad-dressing")
    )


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", ""),
        ("camera:", "'camera:'"),
        ('word:""', "'word:'"),
        ("camra:base", "'camera'"),
        ("base", "KIND:NAME"),
        ("(role:bos", "')'"),
        ("role:bos role:image", "'&', '|' or ' - '"),
        ("role:bos &", ""),
        ("| role:bos", ""),
        ("role:bos)", "'&', '|' or ' - '"),
    ],
)
def test_errors_quote_the_selector_and_what_was_expected(text, expected):
    with pytest.raises(SelectorError) as caught:
        parse_selector(text)
    assert expected in str(caught.value)
    assert f"'{text}'" in str(caught.value)
