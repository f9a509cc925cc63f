"""Documents to JSON, back, and to JSON Schema.

One declaration gives three things: the object in memory, the text in the store, and the schema file that other
languages check against. Decoding is strict (unknown and missing fields are errors), and an error gives the path:
`$.spans[2].kind`.
"""

from __future__ import annotations

import inspect
import json
import sys
from typing import Annotated, Any, TypeVar, get_args

import msgspec

from vla_attention.schemas.errors import UserError, did_you_mean, listing, shortened

T = TypeVar("T")
#: A number that JSON has: neither NaN nor infinite.
Number = Annotated[float, msgspec.Meta(ge=-sys.float_info.max, le=sys.float_info.max)]


class MalformedDocument(UserError, ValueError):
    """A JSON document that does not have the declared structure."""


class Document(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What is written as JSON, and read again. `msgspec.structs` has `replace`, `asdict` and `fields` for them."""


def decode_json(content: bytes) -> Any:
    """The value of a JSON document in UTF-8; `NaN` and `Infinity` are numbers, as the published scripts write them.

    Raises:
        ValueError: it is no JSON.
    """
    try:
        try:
            return msgspec.json.decode(content)
        except msgspec.DecodeError:
            if b"NaN" not in content and b"Infinity" not in content:
                raise
            return json.loads(content)  # slower
    except RecursionError:
        raise ValueError("its lists and objects are nested too deep") from None


def to_json(value: Any) -> Any:
    """Turn documents, tuples and mappings into plain JSON values; a non-finite number is an error (JSON has none)."""
    return json.loads(json.dumps(msgspec.to_builtins(value, str_keys=True), allow_nan=False))


def from_json(declared: type[T], data: Any, where: str = "$") -> T:
    """Decode plain JSON values into the declared type.

    Raises `MalformedDocument` with the path of the first value that does not fit, or that a document's own checks
    refuse.
    """
    try:
        return msgspec.convert(data, declared)
    except msgspec.ValidationError as error:
        problem, _, path = str(error).replace("`", "'").partition(" - at ")
    path = path.strip("'").removeprefix("$")
    fields: dict[str, Any] = {}
    if isinstance(declared, type) and issubclass(declared, Document):
        fields = {field.name: field.type for field in msgspec.structs.fields(declared)}
    name, within, _ = path.removeprefix(".").partition("[...]")
    if within and name in fields:  # msgspec does not say which key of a mapping it is
        for key, item in data[name].items():
            from_json(get_args(fields[name])[1], item, f"{where}.{name}.{shortened(key)}")
    _, unknown, given = problem.partition("Object contains unknown field ")
    nearest = f"{did_you_mean(given[1:-1], fields)} Existing: {listing(fields)}." if unknown and not path else ""
    raise MalformedDocument(f"{where}{path}: {problem.rstrip('.')}.{nearest}")


def json_schema(declared: Any, title: str, description: str) -> dict[str, Any]:
    """JSON Schema (draft 2020-12) of a declared document; nested documents become `$defs`."""
    about = {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": title, "description": description}
    schema: dict[str, Any] = _without_indents(about | msgspec.json.schema(declared))
    return schema


def _without_indents(node: Any) -> Any:
    """The descriptions are docstrings, which Python 3.13 has without the indents of the source, and 3.12 with them."""
    if isinstance(node, list):
        return [_without_indents(one) for one in node]
    if not isinstance(node, dict):
        return node
    return {
        name: inspect.cleandoc(one) if name == "description" and isinstance(one, str) else _without_indents(one)
        for name, one in node.items()
    }
