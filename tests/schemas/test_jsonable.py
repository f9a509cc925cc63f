from __future__ import annotations

import json
from typing import Literal

import jsonschema
import pytest

from vla_attention.schemas.errors import BadArgument
from vla_attention.schemas.jsonable import Document, MalformedDocument, Number, from_json, json_schema, to_json


class Inner(Document, frozen=True):
    """An inner thing."""

    kind: Literal["a", "b"]
    pair: tuple[int, int]
    note: str | None = None

    def __post_init__(self) -> None:
        """Check the note."""
        if self.note == "refused":
            raise BadArgument("The note is refused.")


class Outer(Document, frozen=True):
    """An outer thing."""

    items: tuple[Inner, ...]
    table: dict[str, Number]
    named: dict[str, Inner] = {}  # noqa: RUF012 - a document cannot be changed
    flag: bool = False


EXAMPLE = Outer((Inner("a", (1, 2)), Inner("b", (3, 4), "x")), {"y": 0.5}, {}, True)


def test_there_and_back_through_text():
    assert from_json(Outer, json.loads(json.dumps(to_json(EXAMPLE)))) == EXAMPLE
    assert list(to_json(EXAMPLE)) == ["items", "table", "named", "flag"]


@pytest.mark.parametrize(
    ("document", "said"),
    [
        ([], ["$:"]),
        ({"table": {}}, ["$:", "items"]),
        ({"items": [], "table": {}, "flga": 1}, ["$:", "flga", "'flag'", "items, table, named, flag"]),
        ({"items": [{"kind": "c", "pair": [1, 2]}], "table": {}}, ["$.items[0].kind:", "'c'"]),
        ({"items": [{"kind": "a", "pair": [1]}], "table": {}}, ["$.items[0].pair:", "2", "1"]),
        ({"items": [{"kind": "a", "pair": [1, True]}], "table": {}}, ["$.items[0].pair[1]:", "int", "bool"]),
        ({"items": [], "table": {"x": 1, "y": "1"}}, ["$.table.y:", "float", "str"]),
        ({"items": [], "table": {}, "named": {"z": {"kind": "a", "pair": 3}}}, ["$.named.z.pair:", "array", "int"]),
    ],
)
def test_decoding_is_strict_and_says_where(document, said):
    with pytest.raises(MalformedDocument) as refused:
        from_json(Outer, document)
    assert [part for part in said if part not in str(refused.value)] == []
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(document, json_schema(Outer, "outer", "An example."))


def test_what_a_document_checks_itself_is_refused_with_its_place():
    with pytest.raises(MalformedDocument, match=r"\$\.items\[0\]: .*note"):
        from_json(Outer, {"items": [{"kind": "a", "pair": [1, 2], "note": "refused"}], "table": {}})


@pytest.mark.parametrize("number", [float("nan"), float("inf"), float("-inf")])
def test_numbers_that_json_does_not_have_are_refused(number):
    with pytest.raises(ValueError, match="JSON"):
        to_json(Outer((), {"y": number}))
    with pytest.raises(MalformedDocument, match=r"\$\.table\.y:"):
        from_json(Outer, {"items": [], "table": {"y": number}})
