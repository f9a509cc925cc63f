"""Pickles of tensors and arrays: every instruction is checked before a reader carries out the first.

A reader that allows harmless functions only still takes the memory and the time that a file asks for: a table entry of
number 4 billion, 10 GB of zeros, a tuple that holds itself twice forty times over. Here the instructions are followed
on a stack of place holders; nothing of the file is built.
"""

from __future__ import annotations

import pickletools
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import IO, cast

#: Instructions of a pickle. A model of a thousand tensors has about thirty thousand.
MAX_INSTRUCTIONS = 2_000_000
#: Bytes of one text or string of bytes: an array in the pickle itself. An embedding of T5 has 1 MB.
MAX_ITEM_BYTES = 64_000_000
#: Items of a tuple, with those of the tuples in it, as often as they stand there.
MAX_TUPLE_ITEMS = 10_000
#: Longer texts are neither names nor keys; only their length is kept while the instructions are followed.
_NAME_LENGTH = 10_000


class PickleRefused(ValueError):
    """A pickle that holds more than it should; the text completes "it ..."."""


class PickleDamaged(PickleRefused):
    """A pickle that cannot be followed to its end, or no pickle at all."""


@dataclass(frozen=True)
class _Text:
    """A long text, or bytes."""

    length: int


@dataclass(frozen=True)
class _Tuple:
    """A tuple; weight: its items with those of the tuples in it."""

    items: tuple[object, ...]
    weight: int


@dataclass(frozen=True)
class _Name:
    """A function or class that the pickle names."""

    name: str


@dataclass(frozen=True)
class _Made:
    """What a call makes, and other objects. kind: the name that was called, or a type."""

    kind: str


#: What the arguments of a call have to be.
Check = Callable[[tuple[object, ...]], bool]


def anything(_arguments: tuple[object, ...]) -> bool:
    """Any arguments: the function checks them itself, and makes nothing larger than what it is given."""
    return True


def nothing(arguments: tuple[object, ...]) -> bool:
    """No arguments: bytes(N) would take N bytes, and OrderedDict(PAIRS) hashes keys of any kind."""
    return not arguments


def _at_most_bytes(arguments: tuple[object, ...]) -> bool:
    return not arguments or (len(arguments) == 1 and isinstance(arguments[0], (_Text, _Made, bytes)))


def _latin(arguments: tuple[object, ...]) -> bool:
    # Bytes in pickles of protocol 2. Other encodings take time that grows with the square of the length.
    return len(arguments) == 2 and isinstance(arguments[0], (str, _Text)) and arguments[1] in ("latin1", "latin-1")


def _empty_array(arguments: tuple[object, ...]) -> bool:
    # The shape and the numbers follow; numpy compares their size with the bytes that are there.
    return len(arguments) == 3 and isinstance(arguments[1], _Tuple) and arguments[1].items == (0,)


def _number_type(arguments: tuple[object, ...]) -> bool:
    return bool(arguments) and isinstance(arguments[0], str) and bool(_NUMBER_TYPE.fullmatch(arguments[0]))


_NUMBER_TYPE = re.compile(r"[<>|=]?[biufc][0-9]{1,2}")
_STORAGE = re.compile(r"torch\.(storage\.)?[A-Z][A-Za-z0-9]*Storage")
_DTYPE = re.compile(r"torch\.(b?float|complex|u?int|bool|half|double|long|short)[0-9a-z_]*")

#: Names that files of tensors may call, with what their arguments have to be. Types of numbers and storages are named
#: and never called.
TENSORS: Mapping[str, Check] = {
    "collections.OrderedDict": nothing,
    "torch._utils._rebuild_tensor_v2": anything,
    "torch._utils._rebuild_tensor_v3": anything,
    "torch._utils._rebuild_parameter": anything,
    "torch.Size": anything,
    "torch.device": anything,
    "_codecs.encode": _latin,
    "__builtin__.bytes": nothing,
    "builtins.bytes": nothing,
    "_io.BytesIO": _at_most_bytes,
    "io.BytesIO": _at_most_bytes,
}
#: Names that files of numpy's arrays may call.
ARRAYS: Mapping[str, Check] = {
    "numpy.core.multiarray._reconstruct": _empty_array,
    "numpy._core.multiarray._reconstruct": _empty_array,
    "numpy.ndarray": lambda _: False,  # named only
    "numpy.dtype": _number_type,
    "_codecs.encode": _latin,
    "__builtin__.bytes": nothing,
    "builtins.bytes": nothing,
}


def check_pickle(file: IO[bytes], allowed: Mapping[str, Check], *, most_numbers: int) -> None:
    """Follow the instructions of the pickle that begins here, up to its end.

    allowed: the functions that it may call. most_numbers: of one storage that it may ask for.

    Raises:
        PickleRefused: it holds more than that, or cannot be followed.
    """
    machine = _Machine(allowed, most_numbers)
    try:
        for count, (opcode, argument, _) in enumerate(pickletools.genops(cast(IO[bytes], _Limited(file)))):
            if count >= MAX_INSTRUCTIONS:
                raise PickleRefused(f"has more than {MAX_INSTRUCTIONS} instructions")
            machine.follow(opcode.name, argument)
    except PickleRefused:
        raise
    except (ValueError, IndexError, KeyError, TypeError, EOFError, OverflowError, UnicodeError) as error:
        raise PickleDamaged(f"is damaged or no pickle ({error})") from error


class _Limited:
    """A file from which nothing longer than `MAX_ITEM_BYTES` is read at once."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file

    def read(self, count: int) -> bytes:
        if count > MAX_ITEM_BYTES:
            raise PickleRefused(f"has an item of {count} bytes; expected {MAX_ITEM_BYTES} at most")
        return self._file.read(count)

    def readline(self) -> bytes:
        return self._file.readline(_NAME_LENGTH)


class _Machine:
    """The stack, the marks and the table of a pickle, with place holders."""

    def __init__(self, allowed: Mapping[str, Check], most_numbers: int) -> None:
        self._allowed, self._most_numbers = allowed, most_numbers
        self._stack: list[object] = []
        self._marks: list[int] = []
        self._table: dict[int, object] = {}

    def follow(self, name: str, argument: object) -> None:
        """Follow one instruction."""
        if name in _IGNORED:
            return
        if name in _VALUES:
            self._stack.append(self._value(argument))
        elif name in _NUMBERS:
            self._stack.append(argument)
        elif name in _EMPTY:
            self._stack.append(_EMPTY[name])
        elif name in _TUPLES:
            count = _TUPLES[name]
            self._stack.append(self._tuple(tuple(self._pop() for _ in range(count))[::-1]))
        else:
            step = _STEPS.get(name)
            if step is None:
                raise PickleRefused(f"has the instruction {name}, which tensors and arrays do not need")
            step(self, argument)

    def _pop(self) -> object:
        if self._marks and len(self._stack) <= self._marks[-1]:
            raise PickleDamaged("is damaged: it takes more from its stack than there is")
        return self._stack.pop()

    def _to_mark(self) -> tuple[object, ...]:
        start = self._marks.pop()
        items = tuple(self._stack[start:])
        del self._stack[start:]
        return items

    @staticmethod
    def _value(argument: object) -> object:
        if isinstance(argument, (str, bytes)) and len(argument) > _NAME_LENGTH:
            return _Text(len(argument))
        return argument

    @staticmethod
    def _tuple(items: tuple[object, ...]) -> _Tuple:
        weight = 1 + sum(item.weight if isinstance(item, _Tuple) else 1 for item in items)
        if weight > MAX_TUPLE_ITEMS:
            raise PickleRefused(f"has a tuple of more than {MAX_TUPLE_ITEMS} items")
        return _Tuple(items, weight)

    def _mark(self, _: object) -> None:
        self._marks.append(len(self._stack))

    def _marked_tuple(self, _: object) -> None:
        self._stack.append(self._tuple(self._to_mark()))

    def _append(self, _: object) -> None:
        self._pop()
        self._expect("list")

    def _appends(self, _: object) -> None:
        self._to_mark()
        self._expect("list")

    def _set_item(self, _: object) -> None:
        _, key = self._pop(), self._pop()
        self._check_keys((key,))

    def _set_items(self, _: object) -> None:
        self._check_keys(self._to_mark()[::2])

    def _check_keys(self, keys: tuple[object, ...]) -> None:
        # Keys are hashed, and a tuple that holds itself many times over would be hashed as often.
        wrong = [key for key in keys if not isinstance(key, (str, int))]
        if wrong:
            raise PickleRefused(f"has a key that is no name, but a {type(wrong[0]).__name__.strip('_').lower()}")
        self._expect("dict", "collections.OrderedDict")

    def _expect(self, *kinds: str) -> None:
        target = self._stack[-1]
        if not isinstance(target, _Made) or target.kind not in kinds:
            raise PickleRefused(f"adds items to what is no {kinds[0]}")

    def _put(self, index: object) -> None:
        index = len(self._table) if index is None else index
        if not isinstance(index, int) or not 0 <= index <= MAX_INSTRUCTIONS:
            raise PickleRefused(f"has a table entry of number {index}")
        self._table[index] = self._stack[-1]

    def _get(self, index: object) -> None:
        if not isinstance(index, int) or index not in self._table:
            raise PickleRefused(f"refers to the table entry {index}, which it does not have")
        self._stack.append(self._table[index])

    def _global(self, argument: object) -> None:
        self._name(str(argument).replace(" ", ".", 1))

    def _stack_global(self, _: object) -> None:
        name, module = self._pop(), self._pop()
        if not isinstance(name, str) or not isinstance(module, str):
            raise PickleRefused("names a function by something else than text")
        self._name(f"{module}.{name}")

    def _name(self, name: str) -> None:
        if name not in self._allowed and not _STORAGE.fullmatch(name) and not _DTYPE.fullmatch(name):
            raise PickleRefused(f"asks for {name}")
        self._stack.append(_Name(name))

    def _call(self, _: object) -> None:
        arguments, called = self._pop(), self._pop()
        if not isinstance(called, _Name) or not isinstance(arguments, _Tuple) or called.name not in self._allowed:
            raise PickleRefused("calls what is no function")
        if not self._allowed[called.name](arguments.items):
            raise PickleRefused(f"calls {called.name} with other arguments than tensors and arrays need")
        self._stack.append(_Made(called.name))

    def _build(self, _: object) -> None:
        self._pop()
        target = self._stack[-1]
        if not isinstance(target, _Made) or target.kind not in _WITH_STATE:
            raise PickleRefused("gives a state to what has none")

    def _storage(self, _: object) -> None:
        asked = self._pop()
        items = asked.items if isinstance(asked, _Tuple) else ()
        if len(items) < 5 or any(isinstance(item, _Tuple) for item in items[:5]):
            raise PickleRefused("refers to something outside itself")
        count = items[4]
        if not isinstance(count, int) or not 0 <= count <= self._most_numbers:
            raise PickleRefused(f"asks for {count} numbers, and its file has {self._most_numbers} bytes")
        self._stack.append(_Made("storage"))


#: What gets a state after it was made: attributes, bytes, the numbers of an array.
_WITH_STATE = {"collections.OrderedDict", "_io.BytesIO", "io.BytesIO", *ARRAYS} - {"_codecs.encode"}
_IGNORED = {"PROTO", "FRAME", "STOP"}
_NUMBERS = {"BININT", "BININT1", "BININT2", "LONG1", "BINFLOAT"}
_VALUES = {
    "BINUNICODE", "SHORT_BINUNICODE", "BINUNICODE8", "BINBYTES", "SHORT_BINBYTES", "BINBYTES8", "BINSTRING",
    "SHORT_BINSTRING",
}  # fmt: skip
_EMPTY: dict[str, object] = {
    "NONE": None,
    "NEWTRUE": True,
    "NEWFALSE": False,
    "EMPTY_TUPLE": _Tuple((), 1),
    "EMPTY_LIST": _Made("list"),
    "EMPTY_DICT": _Made("dict"),
}
_TUPLES = {"TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}
_STEPS: dict[str, Callable[[_Machine, object], None]] = {
    "MARK": _Machine._mark,
    "TUPLE": _Machine._marked_tuple,
    "APPEND": _Machine._append,
    "APPENDS": _Machine._appends,
    "SETITEM": _Machine._set_item,
    "SETITEMS": _Machine._set_items,
    "BINPUT": _Machine._put,
    "LONG_BINPUT": _Machine._put,
    "MEMOIZE": _Machine._put,
    "BINGET": _Machine._get,
    "LONG_BINGET": _Machine._get,
    "GLOBAL": _Machine._global,
    "STACK_GLOBAL": _Machine._stack_global,
    "REDUCE": _Machine._call,
    "NEWOBJ": _Machine._call,
    "BUILD": _Machine._build,
    "BINPERSID": _Machine._storage,
}
