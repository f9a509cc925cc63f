from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Literal

import jsonschema
import pytest

from vla_attention.schemas.jsonable import MalformedDocument, from_json, json_schema, to_json


@dataclass(frozen=True)
class Inner:
    """An inner thing."""

    kind: Literal["a", "b"]
    pair: tuple[int, int]
    note: str | None = None


@dataclass(frozen=True)
class Outer:
    """An outer thing."""

    items: tuple[Inner, ...]
    table: dict[str, float]
    flag: bool = False


EXAMPLE = Outer((Inner("a", (1, 2)), Inner("b", (3, 4), "x")), {"y": 0.5}, True)


def test_there_and_back_through_text():
    assert from_json(Outer, json.loads(json.dumps(to_json(EXAMPLE)))) == EXAMPLE


@pytest.mark.parametrize(
    ("document", "said"),
    [
        ([], r"\$ is list; expected dict"),
        ({"table": {}}, r"\$ lacks the field 'items'"),
        ({"items": [], "table": {}, "flga": 1}, r"unknown field 'flga'. Did you mean 'flag'"),
        (
            {"items": [{"kind": "c", "pair": [1, 2]}], "table": {}},
            r"\$.items\[0\].kind is 'c'; expected one of 'a', 'b'",
        ),
        ({"items": [{"kind": "a", "pair": [1]}], "table": {}}, r"\$.items\[0\].pair has 1 items; expected 2"),
        ({"items": [{"kind": "a", "pair": [1, True]}], "table": {}}, r"\$.items\[0\].pair\[1\] is bool; expected int"),
        ({"items": [{"kind": "a", "pair": [1, 2], "note": 3}], "table": {}}, r"\$.items\[0\].note is int"),
        ({"items": [], "table": {"y": "1"}}, r"\$.table.y is str; expected float"),
    ],
)
def test_decoding_is_strict_and_says_where(document, said):
    with pytest.raises(MalformedDocument, match=said):
        from_json(Outer, document)
    schema = json_schema(Outer, "outer", "An example.")
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(document, schema)


def test_numbers_that_json_does_not_have_are_refused():
    with pytest.raises(ValueError, match="no JSON representation"):
        to_json(Outer((), {"y": float("nan")}))
    with pytest.raises(TypeError, match="no JSON representation"):
        to_json(object())
