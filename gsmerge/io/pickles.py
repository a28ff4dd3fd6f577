"""Pickles of plain containers, numbers and what a table of names makes of them, as torch and numpy write them.

Python's own unpickler reads them, held to the instructions that a pickler writes for such values. The one in C and
``torch.load(weights_only=True)`` are not held to a budget: a few bytes make them take gigabytes, or hash nested tuples
for ever.
"""

from __future__ import annotations

import io
import pickle
import struct
from collections.abc import Callable, Mapping
from typing import Any

from gsmerge.io.bounds import ReadBudget

_MAX_KEY = 1 << 31  # of numbers that are keys: dictionaries are slow with some larger ones

Names = Mapping[tuple[str, str], object]
"""What the module and name of a global stand for; functions there are called with the arguments in the pickle."""


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
    """Read a pickle; ``find_storage`` returns the object for a persistent id.

    ValueError if it is damaged or holds anything but plain values and ``names``; SceneError if it takes more than the
    budget.
    """
    unpickler = _Unpickler(content, budget, names, find_storage)
    try:
        value = unpickler.load()
    except (pickle.UnpicklingError, EOFError, IndexError, TypeError, AttributeError, struct.error) as error:
        raise ValueError(f"expected values as a pickler writes them, found {str(error) or 'the end'}") from error
    if unpickler.stack or unpickler.metastack:
        raise ValueError("expected one value, found more")
    return value


class _Unpickler(pickle._Unpickler):
    """Python's unpickler, with the names of a table, and with keys that are hashed at once."""

    stack: list[Any]
    metastack: list[list[Any]]  # the stacks below open marks
    pop_mark: Callable[[], list[Any]]

    def __init__(
        self, content: bytes, budget: ReadBudget, names: Names, find_storage: Callable[[object], object]
    ) -> None:
        super().__init__(io.BytesIO(content))
        self.dispatch = _Instructions(budget)  # type: ignore[misc]  # a table of each reader's own
        self.names, self.find_storage = names, find_storage

    def persistent_load(self, pid: object) -> object:
        return self.find_storage(pid)

    def find_class(self, module: str, name: str) -> object:
        if (module, name) not in self.names:
            raise ValueError(f"refused to load {module[:40]}.{name[:40]}")
        return self.names[module, name]

    def load_build(self) -> None:
        state, target = self.stack.pop(), self.stack[-1]
        if not isinstance(target, StandIn):
            raise ValueError("refused to set the state of a value")
        target.set_state(state)

    def load_setitem(self) -> None:
        value, key = self.stack.pop(), self.stack.pop()
        self._set_item(key, value)

    def load_setitems(self) -> None:
        items = self.pop_mark()
        for key, value in zip(items[::2], items[1::2], strict=True):
            self._set_item(key, value)

    def _set_item(self, key: object, value: object) -> None:
        target = self.stack[-1]
        if not isinstance(target, dict):
            raise ValueError("expected a dictionary to add to, found another value")
        if not isinstance(key, str) and not (isinstance(key, int) and abs(key) < _MAX_KEY):
            raise ValueError("expected text or small numbers as keys, found others")
        if key in target:  # comparing long keys takes its time
            raise ValueError("expected each key once, found one again")
        target[key] = value


_CODES = (
    pickle.PROTO, pickle.FRAME, pickle.STOP, pickle.MARK, pickle.NONE, pickle.NEWTRUE, pickle.NEWFALSE,
    pickle.BININT, pickle.BININT1, pickle.BININT2, pickle.LONG1, pickle.BINFLOAT,
    pickle.SHORT_BINUNICODE, pickle.BINUNICODE, pickle.SHORT_BINBYTES, pickle.BINBYTES,
    pickle.EMPTY_LIST, pickle.APPEND, pickle.APPENDS, pickle.EMPTY_DICT,
    pickle.EMPTY_TUPLE, pickle.TUPLE, pickle.TUPLE1, pickle.TUPLE2, pickle.TUPLE3,
    pickle.MEMOIZE, pickle.BINPUT, pickle.LONG_BINPUT, pickle.BINGET, pickle.LONG_BINGET,
    pickle.GLOBAL, pickle.STACK_GLOBAL, pickle.REDUCE, pickle.BINPERSID,
)  # fmt: skip
_INSTRUCTIONS = {code[0]: pickle._Unpickler.dispatch[code[0]] for code in _CODES} | {
    pickle.BUILD[0]: _Unpickler.load_build,
    pickle.SETITEM[0]: _Unpickler.load_setitem,
    pickle.SETITEMS[0]: _Unpickler.load_setitems,
}


class _Instructions(dict[int, Callable[[Any], None]]):
    """What is done for each instruction; one is looked up at each step of the budget."""

    def __init__(self, budget: ReadBudget) -> None:
        super().__init__(_INSTRUCTIONS)
        self.budget, self.steps = budget, 0

    def __getitem__(self, code: int) -> Callable[[Any], None]:
        self.steps += 1
        self.budget.check_steps(self.steps, "steps of a pickle")
        return super().__getitem__(code)

    def __missing__(self, code: int) -> Callable[[Any], None]:
        raise ValueError(f"expected plain values, found the instruction {bytes([code])!r}")
