"""Frozen dataclasses to JSON, back, and to JSON Schema.

One declaration serves three purposes: the object in memory, the text in the store, and the schema file that other
languages check against. Decoding is strict (unknown and missing fields are errors) and an error says where: `$.spans[2].kind`.
"""

from __future__ import annotations

import dataclasses
import math
import types
import typing
from collections.abc import Mapping
from typing import Any, Literal, TypeVar, Union, get_args, get_origin

from schemas.errors import UserError, did_you_mean, listing

T = TypeVar("T")


class MalformedDocument(UserError, ValueError):
    """A JSON document that does not have the declared structure."""


def to_json(value: Any) -> Any:
    """Turn dataclasses, tuples and mappings into plain JSON values; a non-finite number is an error (JSON has none)."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: to_json(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(key): to_json(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [to_json(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        raise ValueError(f"{value!r} has no JSON representation")
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    raise TypeError(f"no JSON representation for {type(value).__name__}")


def from_json(declared: type[T], data: Any, where: str = "$") -> T:
    """Decode plain JSON values into the declared type.

    Raises `MalformedDocument` with the path of the first value that does not fit.
    """
    return typing.cast(T, _decode(declared, data, where))


def json_schema(declared: type, title: str, description: str) -> dict[str, Any]:
    """JSON Schema (draft 2020-12) of a declared dataclass; nested dataclasses become `$defs`."""
    definitions: dict[str, Any] = {}
    body = _schema(declared, definitions)
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": title,
        "description": description,
        **body,
        **({"$defs": dict(sorted(definitions.items()))} if definitions else {}),
    }


def _fields(declared: type) -> dict[str, tuple[Any, bool]]:
    """Field name -> (type, required)."""
    hints = typing.get_type_hints(declared)
    return {
        field.name: (
            hints[field.name],
            field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING,
        )
        for field in dataclasses.fields(declared)
    }


def _decode(declared: Any, data: Any, where: str) -> Any:
    origin, arguments = get_origin(declared), get_args(declared)
    if declared is Any:
        return data
    if origin in (Union, types.UnionType):
        if data is None and type(None) in arguments:
            return None
        choices = [choice for choice in arguments if choice is not type(None)]
        for choice in choices:
            try:
                return _decode(choice, data, where)
            except MalformedDocument:
                if choice is choices[-1]:
                    raise
    if origin is Literal:
        if data in arguments:
            return data
        raise MalformedDocument(f"{where} is {data!r}; expected one of {listing(map(repr, arguments))}.")
    if dataclasses.is_dataclass(declared):
        return _decode_dataclass(typing.cast(type, declared), data, where)
    if origin is tuple:
        items = _expect(list, data, where)
        if len(arguments) == 2 and arguments[1] is Ellipsis:
            return tuple(_decode(arguments[0], item, f"{where}[{i}]") for i, item in enumerate(items))
        if len(items) != len(arguments):
            raise MalformedDocument(f"{where} has {len(items)} items; expected {len(arguments)}.")
        return tuple(
            _decode(kind, item, f"{where}[{i}]") for i, (kind, item) in enumerate(zip(arguments, items, strict=True))
        )
    if origin is list:
        return [_decode(arguments[0], item, f"{where}[{i}]") for i, item in enumerate(_expect(list, data, where))]
    if origin is dict:
        return {key: _decode(arguments[1], item, f"{where}.{key}") for key, item in _expect(dict, data, where).items()}
    if declared is float and isinstance(data, int) and not isinstance(data, bool):
        return float(data)
    return _expect(declared, data, where)


def _decode_dataclass(declared: type, data: Any, where: str) -> Any:
    given = _expect(dict, data, where)
    fields = _fields(declared)
    for name in given:
        if name not in fields:
            raise MalformedDocument(
                f"{where} has an unknown field '{name}'.{did_you_mean(name, fields)} Existing: {listing(fields)}."
            )
    for name, (_, required) in fields.items():
        if required and name not in given:
            raise MalformedDocument(f"{where} lacks the field '{name}'.")
    return declared(**{name: _decode(fields[name][0], item, f"{where}.{name}") for name, item in given.items()})


def _expect(kind: type, data: Any, where: str) -> Any:
    if not isinstance(data, kind) or (isinstance(data, bool) and kind is not bool):
        raise MalformedDocument(f"{where} is {type(data).__name__}; expected {kind.__name__}.")
    return data


_PRIMITIVES = {str: "string", bool: "boolean", int: "integer", float: "number", type(None): "null"}


def _schema(declared: Any, definitions: dict[str, Any]) -> dict[str, Any]:
    origin, arguments = get_origin(declared), get_args(declared)
    if declared is Any:
        return {}
    if declared in _PRIMITIVES:
        return {"type": _PRIMITIVES[declared]}
    if origin in (Union, types.UnionType):
        return {"anyOf": [_schema(choice, definitions) for choice in arguments]}
    if origin is Literal:
        return {"enum": list(arguments)}
    if origin is tuple and not (len(arguments) == 2 and arguments[1] is Ellipsis):
        return {
            "type": "array",
            "prefixItems": [_schema(item, definitions) for item in arguments],
            "minItems": len(arguments),
            "maxItems": len(arguments),
        }
    if origin in (tuple, list):
        return {"type": "array", "items": _schema(arguments[0], definitions)}
    if origin is dict:
        return {"type": "object", "additionalProperties": _schema(arguments[1], definitions)}
    name = declared.__name__
    if name not in definitions:
        definitions[name] = {}  # stands in while the fields are visited
        fields = _fields(declared)
        definitions[name] = {
            "type": "object",
            "description": (declared.__doc__ or "").strip().split("\n")[0],
            "properties": {field: _schema(kind, definitions) for field, (kind, _) in fields.items()},
            "required": [field for field, (_, required) in fields.items() if required],
            "additionalProperties": False,
        }
    return {"$ref": f"#/$defs/{name}"}
