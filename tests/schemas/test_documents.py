"""JSON and TOML from anybody: equal to the standard parsers, but for what is too large, too deep or no text."""

from __future__ import annotations

import json
import tomllib

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.kit.examples import examples
from vla_attention.schemas.documents import decode_json, decode_toml

#: Texts with what looks like structure.
TEXTS = st.text("ab[]{}\"'\\,:.#=\n é\U0001f600", max_size=8)
VALUES = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**63 - 1) | st.floats(allow_nan=False) | TEXTS,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(TEXTS, inner, max_size=3),
    max_leaves=12,
)


@settings(max_examples=examples(100), deadline=None)
@given(value=VALUES, ascii_only=st.booleans())
def test_json_is_read_as_by_python(value, ascii_only):
    assert decode_json(json.dumps(value, ensure_ascii=ascii_only).encode()) == value


@settings(max_examples=examples(100), deadline=None)
@given(keys=st.lists(TEXTS, min_size=1, max_size=4, unique=True), values=st.lists(TEXTS, max_size=4))
def test_toml_is_read_as_by_python(keys, values):
    quoted = [json.dumps(text, ensure_ascii=False) for text in keys]
    text = "\n".join(f"{key} = {json.dumps(values, ensure_ascii=False)} # [[[ {{ ' \"" for key in quoted)
    assert decode_toml(text) == tomllib.loads(text) == dict.fromkeys(keys, values)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"[1, ", "Expecting value"),
        (b'"\xff"', "no text in UTF-8"),
        (b'["\\ud83d"]', "surrogate"),
        (b"[" + b"9" * 5000 + b"]", "64 bits"),
        (b'{"a": 1, "b": -9223372036854775809}', "64 bits"),
        (b"9223372036854775808", "64 bits"),
        (b"[" + b"[]," * 20 + b"1]", "more than 10 lists and objects"),
        (b" " * 200 + b"1", "it has 201 bytes; expected at most 200"),
    ],
)
def test_what_is_refused(content, said):
    with pytest.raises(ValueError, match=said):
        decode_json(content, most=200 if content.startswith(b"  ") else 10_000, nests=10)
