"""Pickles of plain containers, numbers and what a table of names makes of them, as torch and numpy write them.

The instructions are those that a pickler writes for such values; any other is refused before its argument is read.
Python's unpicklers read more: a few bytes make them take gigabytes, or hash nested tuples for ever. So does
``torch.load(weights_only=True)``, which would need torch as well.
"""

from __future__ import annotations

import pickle
import struct
from collections.abc import Callable, Mapping
from itertools import count
from typing import Any

from gsmerge.io.bounds import ReadBudget

_MAX_DEPTH = 20  # of containers in containers
_MAX_KEY = 1 << 31  # of numbers that are keys: dictionaries are slow with some larger ones

_U2, _U4, _U8, _I4, _F8 = (struct.Struct(form) for form in ("<H", "<I", "<Q", "<i", ">d"))

Names = Mapping[tuple[str, str], object]
"""What the module and name of a global stand for; a function there takes the tuple of its arguments."""


class StandIn:
    """Stands for an object that a pickle makes in two steps: by a call, and by its state."""

    def set_state(self, state: object) -> None:
        """Take the state; ValueError if it is not the expected one."""
        raise NotImplementedError


def refuse_storage(pid: object) -> object:
    """Refuse a persistent id."""
    raise ValueError("expected no data outside of the pickle, found some")


def read_pickle(
    content: bytes, budget: ReadBudget, names: Names, find_storage: Callable[[object], object] = refuse_storage
) -> Any:
    """Read a pickle; ``find_storage`` returns what a persistent id stands for.

    ValueError if it is damaged or holds anything else than plain values and ``names``; SceneError if it takes more
    than the budget.
    """
    reader = _Reader(content, names, find_storage)
    try:
        for steps in count(1):
            budget.check_steps(steps, "steps of a pickle")
            instruction = reader.take(1)
            if instruction == pickle.STOP:
                break
            if instruction not in _STEPS:
                raise ValueError(f"expected plain values, found the instruction {instruction!r}")
            _STEPS[instruction](reader)
        ((value,),) = reader.stacks
    except (IndexError, struct.error) as error:
        raise ValueError("expected more values, found the end of the pickle or of a list") from error
    _check_depth(value)
    return value


def _check_depth(value: object) -> None:
    """Raise ValueError if containers are nested deeply, or one holds itself."""
    level: list[Any] = [[value]]
    for _ in range(_MAX_DEPTH):
        inner = (item for outer in level for item in (outer.values() if isinstance(outer, dict) else outer))
        level = list({id(item): item for item in inner if isinstance(item, list | tuple | dict) and item}.values())
        if not level:
            return
    raise ValueError(f"expected at most {_MAX_DEPTH} containers in one another, found more")


class _Reader:
    """A pickle machine: a stack of values for each open mark, and a memo in the order of writing."""

    def __init__(self, content: bytes, names: Names, find_storage: Callable[[object], object]) -> None:
        self.content, self.names, self.find_storage = content, names, find_storage
        self.at = 0
        self.stacks: list[list[Any]] = [[]]
        self.memo: list[Any] = []

    def take(self, length: int) -> bytes:
        start, self.at = self.at, self.at + length
        if self.at > len(self.content):
            raise ValueError("expected more bytes, found the end of the pickle")
        return self.content[start : self.at]

    def byte(self) -> int:
        self.at += 1
        return self.content[self.at - 1]

    def number(self, form: struct.Struct) -> Any:
        start, self.at = self.at, self.at + form.size
        return form.unpack_from(self.content, start)[0]

    def text(self, length: int) -> str:
        return str(self.take(length), "utf-8", "surrogatepass")

    def line(self) -> str:
        text = self.text(self.content.index(b"\n", self.at) - self.at)
        self.at += 1
        return text

    def push(self, value: object) -> None:
        self.stacks[-1].append(value)

    def pop(self, length: int) -> list[Any]:
        stack = self.stacks[-1]
        if len(stack) < length:
            raise IndexError
        values, stack[-length:] = stack[-length:], []
        return values

    def pop_mark(self) -> list[Any]:
        if len(self.stacks) < 2:
            raise IndexError
        return self.stacks.pop()

    def put(self, place: int) -> None:
        if place != len(self.memo):
            raise ValueError("expected a memo in order, found another")
        self.memo.append(self.stacks[-1][-1])

    def extend(self, values: list[Any]) -> None:
        target = self.stacks[-1][-1]
        if not isinstance(target, list):
            raise ValueError("expected a list to append to, found another value")
        target += values

    def update(self, values: list[Any]) -> None:
        target = self.stacks[-1][-1]
        if not isinstance(target, dict) or len(values) % 2:
            raise ValueError("expected a dictionary and pairs, found other values")
        for key, value in zip(values[::2], values[1::2], strict=True):
            if not isinstance(key, str) and not (isinstance(key, int) and abs(key) < _MAX_KEY):
                raise ValueError("expected text or small numbers as keys, found others")
            if key in target:  # comparing long keys takes its time
                raise ValueError("expected each key once, found one again")
            target[key] = value

    def find(self, module: object, name: object) -> object:
        if not isinstance(module, str) or not isinstance(name, str):
            raise ValueError("expected a name to load, found another value")
        if (module, name) not in self.names:
            raise ValueError(f"refused to load {module[:40]}.{name[:40]}")
        return self.names[module, name]

    def call(self, function: object, arguments: object) -> object:
        if not callable(function) or not isinstance(arguments, tuple):  # all functions are from the names
            raise ValueError("expected a function and its arguments, found other values")
        return function(arguments)

    def build(self, target: object, state: object) -> object:
        if not isinstance(target, StandIn):
            raise ValueError("refused to set the state of a value")
        target.set_state(state)
        return target


_STEPS: dict[bytes, Callable[[_Reader], object]] = {
    pickle.PROTO: lambda r: r.byte(),
    pickle.FRAME: lambda r: r.number(_U8),
    pickle.NONE: lambda r: r.push(None),
    pickle.NEWTRUE: lambda r: r.push(True),
    pickle.NEWFALSE: lambda r: r.push(False),
    pickle.BININT: lambda r: r.push(r.number(_I4)),
    pickle.BININT1: lambda r: r.push(r.byte()),
    pickle.BININT2: lambda r: r.push(r.number(_U2)),
    pickle.LONG1: lambda r: r.push(int.from_bytes(r.take(r.byte()), "little", signed=True)),
    pickle.BINFLOAT: lambda r: r.push(r.number(_F8)),
    pickle.SHORT_BINUNICODE: lambda r: r.push(r.text(r.byte())),
    pickle.BINUNICODE: lambda r: r.push(r.text(r.number(_U4))),
    pickle.SHORT_BINBYTES: lambda r: r.push(r.take(r.byte())),
    pickle.BINBYTES: lambda r: r.push(r.take(r.number(_U4))),
    pickle.EMPTY_LIST: lambda r: r.push([]),
    pickle.APPEND: lambda r: r.extend(r.pop(1)),
    pickle.APPENDS: lambda r: r.extend(r.pop_mark()),
    pickle.EMPTY_DICT: lambda r: r.push({}),
    pickle.SETITEM: lambda r: r.update(r.pop(2)),
    pickle.SETITEMS: lambda r: r.update(r.pop_mark()),
    pickle.MARK: lambda r: r.stacks.append([]),
    pickle.EMPTY_TUPLE: lambda r: r.push(()),
    pickle.TUPLE: lambda r: r.push(tuple(r.pop_mark())),
    pickle.TUPLE1: lambda r: r.push(tuple(r.pop(1))),
    pickle.TUPLE2: lambda r: r.push(tuple(r.pop(2))),
    pickle.TUPLE3: lambda r: r.push(tuple(r.pop(3))),
    pickle.MEMOIZE: lambda r: r.put(len(r.memo)),
    pickle.BINPUT: lambda r: r.put(r.byte()),
    pickle.LONG_BINPUT: lambda r: r.put(r.number(_U4)),
    pickle.BINGET: lambda r: r.push(r.memo[r.byte()]),
    pickle.LONG_BINGET: lambda r: r.push(r.memo[r.number(_U4)]),
    pickle.GLOBAL: lambda r: r.push(r.find(r.line(), r.line())),
    pickle.STACK_GLOBAL: lambda r: r.push(r.find(*r.pop(2))),
    pickle.REDUCE: lambda r: r.push(r.call(*r.pop(2))),
    pickle.BUILD: lambda r: r.push(r.build(*r.pop(2))),
    pickle.BINPERSID: lambda r: r.push(r.find_storage(*r.pop(1))),
}
