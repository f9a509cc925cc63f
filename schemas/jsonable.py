"""Frozen dataclasses to JSON, back, and to JSON Schema.

One declaration gives three things: the object in memory, the text in the store, and the schema file that other
languages check against. Decoding is strict (unknown and missing fields are errors), and an error gives the path:
`$.spans[2].kind`.

Why not msgspec (0.22, tried): with our dataclasses it ignores unknown fields without a word; `forbid_unknown_fields`
needs every class to be its `Struct`. Its errors name neither the key of a mapping (`$.groups[...]`), nor the allowed
values, nor the nearest field. It writes NaN as null. It is faster (0.1 ms instead of 2.9 ms for the attributes of a
LIBERO episode of 60 replans), which adds up to 0.3 s for 100 episodes. With the messages and the check for NaN written
around it, the code is not shorter.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import types
import typing
from collections.abc import Callable, Mapping
from typing import Any, Literal, TypeVar, Union, get_args, get_origin

from vla_attention.schemas.errors import UserError, did_you_mean, listing, shortened
from vla_attention.schemas.limits import WHOLE_NUMBER

T = TypeVar("T")
#: Plain objects of one class that are kept to be given out again, at most.
_MOST_REMEMBERED = 20_000


class MalformedDocument(UserError, ValueError):
    """A JSON document that does not have the declared structure."""


def to_json(value: Any) -> Any:
    """Turn dataclasses, tuples and mappings into plain JSON values; a non-finite number is an error (JSON has none)."""
    if value is None or isinstance(value, (str, bool, int)):
        return value
    if isinstance(value, float):
        if not math.isfinite(value):
            raise ValueError(f"{value!r} has no JSON representation")
        return value
    if isinstance(value, (list, tuple)):
        return [to_json(item) for item in value]
    if isinstance(value, Mapping):
        return {str(key): to_json(item) for key, item in value.items()}
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {name: to_json(getattr(value, name)) for name in _fields(type(value))}
    raise TypeError(f"no JSON representation for {type(value).__name__}")


def from_json(declared: type[T], data: Any, where: str = "$") -> T:
    """Decode plain JSON values into the declared type.

    Raises `MalformedDocument` with the path of the first value that does not fit.
    """
    try:
        return typing.cast(T, _decoder(typing.cast(Any, declared))(data))
    except _Misfit as misfit:
        raise MalformedDocument(f"{where}{''.join(reversed(misfit.path))} {misfit.problem}") from None


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


@functools.cache
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


class _Misfit(Exception):
    """A value that does not fit; each level of the document adds its part of the path as the error passes it."""

    def __init__(self, problem: str) -> None:
        super().__init__(problem)
        self.problem = problem
        self.path: list[str] = []

    def inside(self, part: str) -> _Misfit:
        self.path.append(part)
        return self


@functools.cache
def _decoder(declared: Any) -> Callable[[Any], Any]:
    """The function that decodes one declared type, made once: an episode may hold ten thousand token pieces."""
    origin, arguments = get_origin(declared), get_args(declared)
    if declared is Any:
        return lambda data: data
    if origin in (Union, types.UnionType):
        return _union_decoder(arguments)
    if origin is Literal:
        return _literal_decoder(arguments)
    if dataclasses.is_dataclass(declared):
        return _dataclass_decoder(typing.cast(type, declared))
    if origin is tuple and not (len(arguments) == 2 and arguments[1] is Ellipsis):
        return _fixed_tuple_decoder(arguments)
    if origin in (tuple, list):
        return _sequence_decoder(origin, arguments[0])
    if origin is dict:
        return _dict_decoder(arguments[1])
    return _primitive_decoder(declared)


def _union_decoder(arguments: tuple[Any, ...]) -> Callable[[Any], Any]:
    optional = type(None) in arguments
    decoders = [_decoder(choice) for choice in arguments if choice is not type(None)]

    def decode(data: Any) -> Any:
        if data is None and optional:
            return None
        for decoder in decoders[:-1]:
            try:
                return decoder(data)
            except _Misfit:
                continue
        return decoders[-1](data)

    return decode


def _literal_decoder(arguments: tuple[Any, ...]) -> Callable[[Any], Any]:
    def decode(data: Any) -> Any:
        if data in arguments:
            return data
        raise _Misfit(f"is {shortened(repr(data))}; expected one of {listing(map(repr, arguments))}.")

    return decode


def _sequence_decoder(made: type, declared: Any) -> Callable[[Any], Any]:
    decoder = _decoder(declared)
    plain = {declared} if declared in (str, int, bool) else None

    def decode(data: Any) -> Any:
        # Shapes and axes: that each item is of its type is all there is to check.
        if plain is not None and type(data) is list and plain.issuperset(map(type, data)) and _are_bounded(data):
            return made(data)
        items: list[Any] = []
        try:
            for item in _expect(list, data):
                items.append(decoder(item))  # noqa: PERF401 - the length says which item did not fit
        except _Misfit as misfit:
            raise misfit if not isinstance(data, list) else misfit.inside(f"[{len(items)}]") from None
        return items if made is list else tuple(items)

    return decode


def _fixed_tuple_decoder(arguments: tuple[Any, ...]) -> Callable[[Any], Any]:
    decoders = [_decoder(argument) for argument in arguments]

    def decode(data: Any) -> Any:
        items = _expect(list, data)
        if len(items) != len(decoders):
            raise _Misfit(f"has {len(items)} items; expected {len(decoders)}.")
        return tuple(
            _at(f"[{i}]", decoder, item) for i, (decoder, item) in enumerate(zip(decoders, items, strict=True))
        )

    return decode


def _dict_decoder(declared: Any) -> Callable[[Any], Any]:
    decoder = _decoder(declared)

    def decode(data: Any) -> dict[str, Any]:
        values = {}
        for key, item in _expect(dict, data).items():
            try:
                values[key] = decoder(item)
            except _Misfit as misfit:
                raise misfit.inside(f".{shortened(key)}") from None
        return values

    return decode


def _dataclass_decoder(declared: type) -> Callable[[Any], Any]:
    fields = _fields(declared)
    # Fields are looked up at the first value, not before: a dataclass may contain itself.
    decoders: dict[str, Callable[[Any], Any]] = {}
    needed = {name for name, (_, required) in fields.items() if required}
    # Tens of thousands of token pieces have texts and numbers only, in the order in which they are declared: that each
    # is of its type is all there is to check. Prompts share most of them, so that equal ones are one object. Anything
    # else, and every error, goes the long way below.
    names, kinds = tuple(fields), tuple(kind for kind, _ in fields.values())
    frozen = getattr(declared, "__dataclass_params__").frozen  # noqa: B009 - mypy does not know it
    plain = frozen and bool(names) and all(kind in (str, int, bool) for kind in kinds)
    known: dict[tuple[Any, ...], Any] = {}

    def decode(data: Any) -> Any:
        given = _expect(dict, data)
        if plain and tuple(given) == names:
            items = tuple(given.values())
            if tuple(map(type, items)) == kinds:
                shared = known.get(items)
                if shared is not None:
                    return shared
                if all(type(item) is not int or -WHOLE_NUMBER <= item < WHOLE_NUMBER for item in items):
                    return remember(items)
        if not decoders:
            decoders.update({name: _decoder(kind) for name, (kind, _) in fields.items()})
        values = {}
        for name, item in given.items():
            decoder = decoders.get(name)
            if decoder is None:
                raise _Misfit(
                    f"has an unknown field '{shortened(name)}'.{did_you_mean(name, fields)} "
                    f"Existing: {listing(fields)}."
                )
            try:
                values[name] = decoder(item)
            except _Misfit as misfit:
                raise misfit.inside(f".{name}") from None
        if not needed <= values.keys():
            missing = next(name for name in fields if name in needed and name not in values)
            raise _Misfit(f"lacks the field '{missing}'.")
        return declared(**values)

    def remember(items: tuple[Any, ...]) -> Any:
        if len(known) >= _MOST_REMEMBERED:
            known.clear()
        made = declared(*items)
        known[items] = made
        return made

    return decode


def _primitive_decoder(declared: type) -> Callable[[Any], Any]:
    if declared is int:
        return lambda data: (
            data if type(data) is int and -WHOLE_NUMBER <= data < WHOLE_NUMBER else _bounded(_expect(int, data))
        )
    if declared is not float:
        return lambda data: _expect(declared, data)

    def decode(data: Any) -> float:
        if isinstance(data, int) and not isinstance(data, bool):
            return float(_bounded(data))
        if not math.isfinite(_expect(float, data)):
            raise _Misfit(f"is {data!r}; expected a finite number.")
        return typing.cast(float, data)

    return decode


def _bounded(number: int) -> int:
    if not -WHOLE_NUMBER <= number < WHOLE_NUMBER:
        raise _Misfit("is a whole number that does not fit into 64 bits.")
    return number


def _are_bounded(items: list[Any]) -> bool:
    """Whether items, which are all of one plain type, have no whole number that does not fit into 64 bits."""
    return not items or type(items[0]) is not int or (max(items) < WHOLE_NUMBER and min(items) >= -WHOLE_NUMBER)


def _at(part: str, decoder: Callable[[Any], Any], data: Any) -> Any:
    try:
        return decoder(data)
    except _Misfit as misfit:
        raise misfit.inside(part) from None


def _expect(kind: type, data: Any) -> Any:
    if not isinstance(data, kind) or (isinstance(data, bool) and kind is not bool):
        raise _Misfit(f"is {type(data).__name__}; expected {kind.__name__}.")
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
        definitions[name] = {}  # a dataclass that contains itself ends here
        fields = _fields(declared)
        definitions[name] = {
            "type": "object",
            "description": (declared.__doc__ or "").strip().split("\n")[0],
            "properties": {field: _schema(kind, definitions) for field, (kind, _) in fields.items()},
            "required": [field for field, (_, required) in fields.items() if required],
            "additionalProperties": False,
        }
    return {"$ref": f"#/$defs/{name}"}
