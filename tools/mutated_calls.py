"""Call every kernel with changed arguments: a plugin of pytest, ``python -m pytest -p mutated_calls``.

While tests run, the first calls of each function are repeated with changed copies of their arguments. Sizes, contents
of arrays and scalars change, mostly within the limits of the declaration. A function may refuse a call by a ValueError,
and must end in any other case, while a sanitizer checks its reads and writes. The run fails if some function is never
called.
"""

from __future__ import annotations

import faulthandler
import sys
import threading
import zlib
from collections import Counter
from collections.abc import Callable
from importlib import import_module
from typing import Any

import numpy as np
import pytest

from gsmerge.method.kernels import signature
from gsmerge.method.kernels.build import FOLDER

CALLS, CHANGES = 8, 60  # number of calls of each function that are repeated, and number of repeats
BYTES = 1 << 22  # calls with arrays of more bytes are not repeated
BY_TABLE = {"fit_phase"}  # takes a table of addresses, whose arrays tests/kernels/raster/test_step.py changes
SECONDS = 120  # longest time of all repeats of a call
FLOATS = (0.0, -0.0, 1.0, -1.0, 0.5, 1e-40, 1e30, -1e30, 3e38, np.nan, np.inf, -np.inf)
INTEGERS = (0, 1, 2, -1, -2, 2**15, 2**31 - 1, 2**31, -(2**31), 2**32 + 1, 2**62, 2**63 - 1, -(2**63))

Arguments = dict[str, signature.Argument]
tried, refused = Counter[str](), Counter[str]()
_recorded, _lock = Counter[str](), threading.Lock()
_declare = signature.declare


def declare(name: str, returns: signature.Argument | None = None, /, **arguments: signature.Argument) -> Any:
    """Declare a function of the library whose first calls are repeated with changed arguments."""
    call = _declare(name, returns, **arguments)

    def recorded(*values: Any, **named: Any) -> Any:
        """Call the function, and repeat its first small calls with changed arguments."""
        row = (*values, *(named[key] for key in list(arguments)[len(values) :]))
        with _lock:
            small = sum(value.nbytes for value in row if isinstance(value, np.ndarray)) < BYTES
            _recorded[name] += small
            if small and _recorded[name] <= CALLS:
                repeat(name, call, arguments, row)
        return call(*values, **named)

    recorded.prepare = call.prepare  # type: ignore[attr-defined]
    return recorded


def repeat(name: str, call: Callable[..., Any], arguments: Arguments, values: tuple[Any, ...]) -> None:
    """Call a function with changed copies of its arguments, the same in every run."""
    rng = np.random.default_rng((zlib.crc32(name.encode()), _recorded[name]))
    faulthandler.dump_traceback_later(SECONDS, exit=True, file=sys.__stderr__)  # pytest does not capture this stream
    for _ in range(CHANGES):
        copies = change(arguments, values, rng)
        tried[name] += 1
        try:
            call(*copies)
        except ValueError:
            refused[name] += 1
    faulthandler.cancel_dump_traceback_later()


def change(arguments: Arguments, values: tuple[Any, ...], rng: np.random.Generator) -> list[Any]:
    """Copy the arguments of a call, change one to three sizes or arguments, and return the copies."""
    kinds = list(arguments.values())
    copies = (value.copy() if isinstance(value, np.ndarray) else value for value in values)
    named = dict(zip(arguments, copies, strict=True))
    names = sorted({size for kind in kinds for size in kind.shape if isinstance(size, str)})
    for _ in range(rng.integers(1, 4)):
        key = rng.choice([*arguments, *names])
        if key in names:
            _resize(arguments, named, str(key), rng)
        elif named[key] is None or (arguments[key].optional and rng.random() < 0.3):
            named[key] = None
        elif arguments[key].shape:
            _spoil(named[key], rng)
        elif arguments[key].code[0] == "f":
            named[key] = float(rng.choice(FLOATS))
        else:
            value = int(named[key])
            near = (value - 1, value + 1, 2 * value)
            named[key] = int([*INTEGERS, *near][rng.integers(len(INTEGERS) + len(near))])
    if rng.random() < 0.8:
        _admit(arguments, named)
    return list(named.values())


def _resize(arguments: Arguments, named: dict[str, Any], size: str, rng: np.random.Generator) -> None:
    """Give all arrays another length along the axes called ``size``, and mostly also change the scalar of that name."""
    kinds = [(key, kind) for key, kind in arguments.items() if size in kind.shape and named[key] is not None]
    if not kinds:
        return
    old = named[kinds[0][0]].shape[kinds[0][1].shape.index(size)]
    new = int(rng.choice([0, 1, max(old - 1, 0), old + 1, old // 2, min(2 * old, old + 1000)]))
    for key, kind in kinds:
        for axis, name in enumerate(kind.shape):
            if name == size:
                array = named[key] if named[key].size else np.zeros([max(n, 1) for n in named[key].shape], kind.code)
                named[key] = array.take(np.arange(new) % array.shape[axis], axis)
    if size in arguments and rng.random() < 0.8:
        named[size] = new


def _spoil(array: np.ndarray[Any, Any], rng: np.random.Generator) -> None:
    """Change an array at random: its order, all values to small numbers, or one, some or all values to an extreme."""
    if not array.size:
        return
    flat = array.reshape(-1)
    kind = rng.integers(5)
    if kind == 0:
        rng.shuffle(flat)
    elif kind == 1:
        flat[:] = rng.integers(0, max(2, min(array.shape[0], 100)), flat.size).astype(array.dtype)
    else:
        extremes = FLOATS if array.dtype.kind == "f" else (*INTEGERS, len(array), len(array) - 1)
        count = (1, max(1, flat.size // 4), flat.size)[kind - 2]
        with np.errstate(all="ignore"):
            value = np.array(extremes[rng.integers(len(extremes))]).astype(array.dtype)
        flat[rng.choice(flat.size, count, replace=False)] = value


def _admit(arguments: Arguments, named: dict[str, Any]) -> None:
    """Change arguments so that they keep to the limits of their declarations, as far as possible."""
    sizes = {key: value for key, value in named.items() if isinstance(value, int)}
    for key, kind in arguments.items():
        if isinstance(named[key], np.ndarray):
            sizes |= dict(zip(map(str, kind.shape), named[key].shape, strict=True))
    for key, kind in arguments.items():
        if named[key] is None or kind.code[0] == "f":
            continue
        limits, rules = np.iinfo(kind.code), (kind.least, kind.below, kind.most)
        least, below, most = (sizes.get(rule, 0) if isinstance(rule, str) else rule for rule in rules)
        low = limits.min if least is None else max(limits.min, least)
        high = min(limits.max, limits.max if below is None else below - 1, limits.max if most is None else most)
        if kind.shape and low <= high:
            named[key] = np.clip(named[key], low, high).astype(kind.code)
            named[key] = np.sort(named[key]) if kind.ascending else named[key]
        elif not kind.shape:
            named[key] = int(max(low, min(high, named[key])))


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Print the number of calls; let the run fail if a function was not called."""
    missing = sorted(set(signature.PROTOTYPES) - set(tried) - BY_TABLE)
    print(f"\n{len(tried)} functions, {tried.total()} changed calls, {refused.total()} of them refused")
    if missing:
        print(f"never called: {', '.join(missing)}")
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


signature.declare = declare
for _path in sorted(FOLDER.rglob("*.py")):
    if _path.name != "build.py":  # others import it as they need it
        import_module(".".join(("gsmerge.method.kernels", *_path.relative_to(FOLDER).with_suffix("").parts)))
