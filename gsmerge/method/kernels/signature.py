"""Declare functions of the native library, and check their arguments, so that C code accesses only valid memory.

For example,

    @native(values=f4("n"), ids=i4("m", least=0, below="n"), out=f4("m", out=True))
    def take(values, ids, out):
        \"\"\"Write the values at the ids.\"\"\"

declares ``void take(const float *values, const int32_t *ids, float *out, int64_t n, int64_t m)``. A call passes the
arguments in their order, and then the named sizes in the order in which they first appear.
"""

from __future__ import annotations

import ctypes
import inspect
from collections.abc import Callable, Sequence
from functools import cached_property, partial, wraps
from typing import Any

import numpy as np

from gsmerge.frozen import dataclass
from gsmerge.method.kernels.library import load_library

_CODES = {
    "u1": ("uint8_t", ctypes.c_uint8), "i1": ("int8_t", ctypes.c_int8), "i2": ("int16_t", ctypes.c_int16),
    "u4": ("uint32_t", ctypes.c_uint32), "i4": ("int32_t", ctypes.c_int32), "u8": ("uint64_t", ctypes.c_uint64),
    "i8": ("int64_t", ctypes.c_int64), "f4": ("float", ctypes.c_float), "f8": ("double", ctypes.c_double),
}  # fmt: skip
_POSITIONAL = inspect.Parameter.POSITIONAL_OR_KEYWORD
ArraySize = int | str  # a number, or the name of a size or of an integer argument


@dataclass(frozen=True)
class Argument:
    """Declaration of an argument of a native function, which is an array in C order, or a scalar without a shape.

    The limits ``least``, ``below`` and ``most`` are None, numbers, or names of sizes or of integer arguments.

    Args:
        code: NumPy's name of the type.
        shape: Sizes of the array's axes, as numbers or names. A name stands for the same size in all arguments.
        least: Smallest allowed value.
        below: Least number above all allowed values.
        most: Largest allowed value.
        ascending: True if no value may be smaller than the value before it.
        out: True if the function writes the array.
        optional: True if None is allowed, which becomes a null pointer. Each name in its shape is also in the shape of
            another argument.
    """

    code: str
    shape: tuple[ArraySize, ...]
    least: ArraySize | None = None
    below: ArraySize | None = None
    most: ArraySize | None = None
    ascending: bool = False
    out: bool = False
    optional: bool = False

    @property
    def c(self) -> str:
        """The type in C."""
        name = _CODES[self.code][0]
        if not self.shape:
            return name
        return f"{name} *" if self.out else f"const {name} *"

    @cached_property
    def dtype(self) -> np.dtype[Any]:
        """The type in NumPy."""
        return np.dtype(self.code)

    @cached_property
    def span(self) -> tuple[int, int]:
        """The smallest and the largest integer that the type and the numeric limits allow."""
        limits = np.iinfo(self.dtype)
        most = self.below - 1 if isinstance(self.below, int) else self.most
        return (
            self.least if isinstance(self.least, int) else int(limits.min),
            most if isinstance(most, int) else int(limits.max),
        )

    @property
    def has_rules(self) -> bool:
        """True if limits have to be checked after all sizes are known, because they are of an array or name a size."""
        rules = [rule for rule in (self.least, self.below, self.most) if rule is not None]
        return self.ascending or any(self.shape or isinstance(rule, str) for rule in rules)

    def __str__(self) -> str:
        return f"{np.dtype(self.code)} [{','.join(map(str, self.shape))}]"


def _argument(code: str, *shape: ArraySize, **rules: Any) -> Argument:
    return Argument(code, shape, **rules)


u1, i1, i2, u4, i4, u8, i8, f4, f8 = (
    partial(_argument, code) for code in ("u1", "i1", "i2", "u4", "i4", "u8", "i8", "f4", "f8")
)

STATUS = i4()  # return type of a function that checks indices: 0, or another number if an index is outside its array
COUNT = i8()  # return type of a function that also counts: a count, or a negative number if an index is outside


PROTOTYPES: dict[str, str] = {}  # C declarations of all functions by name, which tests compare with the sources


def native(returns: Argument | None = None, /, **arguments: Argument) -> Callable[[Callable[..., Any]], Any]:
    """Replace a function by the function of the same name in the native library.

    Only the name, the parameters and the docstring of the decorated function are used. The arguments are checked at
    every call. A ValueError names the argument that has a wrong type, shape or range.

    Args:
        returns: Scalar that the C function returns, or None for no result. With STATUS, the Python function returns
            nothing, and with COUNT, it returns a count. With STATUS or COUNT, it raises ValueError for an index outside
            its array.
        arguments: Declarations of the arguments in their order.
    """

    def wrap(function: Callable[..., Any]) -> Any:
        """Check the names of the parameters, and return the native function with the docstring."""
        code = function.__code__
        if code.co_varnames[: code.co_argcount] != tuple(arguments):
            raise TypeError(f"{function.__name__}: expected parameters {list(arguments)}, as they are declared")
        return wraps(function)(declare(function.__name__, returns, **arguments))

    return wrap


def declare(name: str, returns: Argument | None = None, /, **arguments: Argument) -> Callable[..., Any]:
    """Return a function of the native library without a docstring, with the checks of :func:`native`."""
    signature = inspect.Signature([inspect.Parameter(key, _POSITIONAL) for key in arguments])
    entries: dict[ctypes.CDLL, Any] = {}  # the C function in each loaded library, because tests load several
    names = size_names(arguments)
    limited = [(i, key, argument) for i, (key, argument) in enumerate(arguments.items()) if argument.has_rules]

    def convert(values: Sequence[Any], sizes: dict[str, int]) -> list[Any]:
        """Check types and shapes, return the arguments for ctypes, and add named sizes to ``sizes``."""
        pairs = zip(arguments.items(), values, strict=True)
        return [_convert_argument(name, key, argument, value, sizes) for (key, argument), value in pairs]

    def call(*values: Any, **named: Any) -> Any:
        """Check the arguments, and call the C function of the loaded library."""
        if named or len(values) != len(arguments):
            values = signature.bind(*values, **named).args
        sizes: dict[str, int] = {}
        passed = convert(values, sizes)
        for i, key, argument in limited:
            _check_values(name, key, argument, values[i], sizes)
        library = load_library()
        if library not in entries:
            entries[library] = _entry(library, name, returns, arguments)
        result = entries[library](*passed, *[sizes.get(key, 0) for key in names])
        if (returns is STATUS and result) or (returns is COUNT and result < 0):
            raise ValueError(f"{name}: expected indices inside their arrays, found one outside")
        return None if returns is STATUS else result

    def prepare(*values: Any) -> Callable[[], None]:
        """Check arguments once, and return a function that makes the call. The caller keeps the arrays in memory."""
        sizes: dict[str, int] = {}
        passed = convert(values, sizes)
        passed += [sizes.get(key, 0) for key in names]
        entry = _entry(load_library(), name, returns, arguments)

        def call_again() -> None:
            if entry(*passed):
                raise ValueError(f"{name}: expected indices inside their arrays, found one outside")

        return call_again

    call.prepare = prepare  # type: ignore[attr-defined]
    parameters = [f"{argument.c}{'' if argument.shape else ' '}{key}" for key, argument in arguments.items()]
    parameters += [f"int64_t {size}" for size in names]
    PROTOTYPES[name] = f"{returns.c if returns else 'void'} {name}({', '.join(parameters)})"
    return call


class Table:
    """Declaration of a struct of the native library: addresses of arrays, named sizes, and numbers, 8 bytes each."""

    def __init__(self, name: str, numbers: tuple[str, ...], **arrays: Argument) -> None:
        self.name = name
        self.arrays = arrays
        self.fields = {key: i for i, key in enumerate((*arrays, *size_names(arrays), *numbers))}


class FilledTable:
    """A struct that a :class:`Table` declares. The struct keeps its arrays in memory."""

    def __init__(self, table: Table, arrays: dict[str, np.ndarray[Any, Any]]) -> None:
        """Check the arrays, write their addresses and sizes to ``values``, and set the numbers to zero."""
        self.table, self.arrays, self._sizes = table, dict[str, np.ndarray[Any, Any]](), dict[str, int]()
        self.values = np.zeros(len(table.fields), np.int64)
        for key in table.arrays:
            self.point(key, arrays[key])
        for key, size in self._sizes.items():
            self[key] = size

    def point(self, key: str, array: np.ndarray[Any, Any]) -> None:
        """Let the struct point to another array, or raise ValueError if it has other sizes."""
        self[key] = _convert_argument(self.table.name, key, self.table.arrays[key], array, self._sizes)
        self.arrays[key] = array

    def __getitem__(self, key: str) -> int:
        return int(self.values[self.table.fields[key]])

    def __setitem__(self, key: str, value: int) -> None:
        self.values[self.table.fields[key]] = value


def size_names(arguments: dict[str, Argument]) -> list[str]:
    """Return the names of sizes that are no arguments themselves, in the order in which they first appear."""
    sizes = (size for argument in arguments.values() for size in argument.shape)
    return list(dict.fromkeys(size for size in sizes if isinstance(size, str) and size not in arguments))


def _entry(library: ctypes.CDLL, name: str, returns: Argument | None, arguments: dict[str, Argument]) -> Any:
    """Return a function of a loaded library for ctypes, and set the types of its arguments and of its result."""
    function = getattr(library, name)
    types = [ctypes.c_void_p if argument.shape else _CODES[argument.code][1] for argument in arguments.values()]
    function.argtypes = [*types, *[ctypes.c_int64] * len(size_names(arguments))]
    function.restype = _CODES[returns.code][1] if returns else None
    return function


def _convert_argument(name: str, key: str, argument: Argument, value: Any, sizes: dict[str, int]) -> Any:
    """Check the type and the shape of one argument, and return the value or the address to pass.

    Named sizes that are not known yet are added to ``sizes``.
    """
    if not argument.shape:
        if argument.code[0] != "f":
            value = int(value)
            low, high = argument.span
            if not low <= value <= high:
                raise ValueError(f"{name}: {key}: expected an integer from {low} to {high}, found {value}")
            if sizes.setdefault(key, value) != value:
                raise ValueError(f"{name}: {key}: expected {sizes[key]}, as arrays have it, got {value}")
        return value
    if value is None and argument.optional:
        return None
    dtype = argument.dtype
    shape = argument.shape
    if type(value) is not np.ndarray or (value.dtype is not dtype and value.dtype != dtype) or value.ndim != len(shape):
        raise ValueError(f"{name}: {key}: expected {argument}, got {_describe(value)}")
    for size, length in zip(shape, value.shape, strict=True):
        if (size if isinstance(size, int) else sizes.setdefault(size, length)) != length:
            known = f" with {size} = {sizes[size]}" if isinstance(size, str) else ""
            raise ValueError(f"{name}: {key}: expected {argument}{known}, got {_describe(value)}")
    flags = value.flags
    writeable = flags.writeable
    if not flags.c_contiguous or not flags.aligned or (argument.out and not writeable):
        raise ValueError(f"{name}: {key}: expected an aligned{' writable' * argument.out} array in C order")
    if writeable and value.size:  # a buffer takes a fifth of the time
        return ctypes.addressof(ctypes.c_char.from_buffer(value))  # type: ignore[arg-type]
    return int(value.__array_interface__["data"][0])


def _check_values(name: str, key: str, argument: Argument, value: Any, sizes: dict[str, int]) -> None:
    """Raise ValueError if an argument, whose type and shape are right, has values outside its limits."""
    if value is None or (argument.shape and not value.size):
        return
    low, high = (value.min(), value.max()) if argument.shape else (value, value)
    least, below, most = (
        sizes[rule] if isinstance(rule, str) else rule for rule in (argument.least, argument.below, argument.most)
    )
    if least is not None and not low >= least:
        raise ValueError(f"{name}: {key}: expected values from {least} on, found {low}")
    if below is not None and not high < below:
        raise ValueError(f"{name}: {key}: expected values below {below}, found {high}")
    if most is not None and not high <= most:
        raise ValueError(f"{name}: {key}: expected values up to {most}, found {high}")
    if argument.ascending and (value[1:] < value[:-1]).any():
        raise ValueError(f"{name}: {key}: expected values in rising order")


def _describe(value: Any) -> str:
    """Return the type and the shape of a value for a message."""
    if not isinstance(value, np.ndarray):
        return type(value).__name__
    return f"{value.dtype} [{','.join(map(str, value.shape))}]"
