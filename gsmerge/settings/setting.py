"""Declare settings: default, help and possible values of each.

The checks of values, the help in Python, the options of the command line and docs/reference are all derived from these
declarations. This package imports neither NumPy nor torch, so that ``--help`` is fast.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import Field, dataclass, field, fields, is_dataclass, replace
from functools import cache
from inspect import cleandoc
from math import inf
from numbers import Integral, Real
from operator import ge, gt, le, lt
from types import NoneType, UnionType
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

T = TypeVar("T")
SAME = "as it is"  # marks that a run on a piece of a scene takes the value of the whole scene
KIND_NAMES = {int: "a whole number", float: "a number", bool: "true or false", str: "text", NoneType: "null"}


@dataclass(frozen=True)
class Setting:
    """Declaration of one setting: default, help and range. :func:`setting` makes it, :func:`settings_of` names it."""

    help: str  # shown by the command line too; names of values in single backticks
    more: str = ""  # further sentences, shown by Python's help and docs/reference only
    choices: Sequence[Any] | Callable[[], Sequence[Any]] = ()  # possible values, where the type does not list them
    least: float | None = None
    most: float | None = None
    above: float | None = None
    below: float | None = None
    unit: str = ""
    unique: bool = False  # true: a list must not repeat a value
    filled: bool = False  # true: a list must have at least one value
    internal: bool = False  # true: the program sets it, users cannot
    counts: bool = False  # true: it decides the number of Gaussians
    neutral: tuple[Any, ...] = ()  # values besides the default with which it decides nothing
    replaces: bool = False  # true: it replaces the closed formulas of the stages
    in_batches: bool = True  # false: batches of views take its default only
    # For a group of settings: "superpixels" if they decide how views become superpixels, "views" if they have another
    # effect on views
    acts_on: Literal["", "views", "superpixels"] = ""
    common: bool = False  # True if every method uses it, baselines too
    # Not empty: values other than the default need the whole scene, and messages call the setting by its "name", or
    # by name and "value"

    whole: Literal["", "name", "value"] = ""
    uncut: tuple[Any, ...] = ()  # values that exclude blocks, but allow views that arrive in batches
    # The value in a run on a piece of a scene, which is a block or a batch of views. `in_trial` is the value in a run
    # that tries settings on some of the views, if it differs
    in_piece: Any = SAME
    in_trial: Any = SAME
    shown: str | None = None  # the default in words, if the program chooses it
    metavar: str | None = None  # form of the values on the command line
    name: str = ""
    kind: Any = None
    default: Any = None

    @property
    def text(self) -> str:
        """Full help text of the setting."""
        return f"{self.help} {self.more}".strip()

    @property
    def is_group(self) -> bool:
        """Whether the value is itself a dataclass of settings, such as those of one stage."""
        return is_dataclass(self.kind)

    @property
    def is_list(self) -> bool:
        """Whether the value is a list; choices and range then apply to its elements."""
        return get_origin(self.kind) is tuple

    @property
    def kinds(self) -> list[Any]:
        """Types that a value may have."""
        kinds = [kind for kind in _types(self.kind) if get_origin(kind) is not Literal]
        return [kind for kind in kinds if kind is NoneType] if self.choices else kinds

    @property
    def words(self) -> tuple[Any, ...]:
        """The possible values that are listed one by one."""
        listed = self.choices() if callable(self.choices) else self.choices
        literals = [kind for kind in _types(self.kind) if get_origin(kind) is Literal]
        return (*listed, *(word for kind in literals for word in get_args(kind)))

    def fits(self, value: Any) -> bool:
        """Return whether a value has one of the types, without checking choices and range."""
        if self.is_list:
            return isinstance(value, list | tuple) and all(map(self._fits, value))
        return self._fits(value)

    def _fits(self, value: Any) -> bool:
        is_bool = type(value).__name__.startswith("bool")  # of Python or NumPy, which is not imported here
        for kind in _types(self.kind):
            if get_origin(kind) is Literal:
                fits = value in get_args(kind)
            elif kind is bool:
                fits = is_bool
            elif kind in (int, float):
                fits = isinstance(value, Integral if kind is int else Real) and not is_bool
            else:
                fits = isinstance(value, kind)
            if fits:
                return True
        return False

    def _in_range(self, value: Any) -> bool:
        if self.choices:
            return value is None or value in self.words
        is_number = isinstance(value, Real)
        limits = ((self.least, ge), (self.most, le), (self.above, gt), (self.below, lt))
        return all(bool(holds(value, limit)) for limit, holds in limits if is_number and limit is not None)

    def values(self, *, null: bool = True) -> str:
        """Describe the possible values: choices, a range, or a type; if ``null``, also None."""
        kinds = [kind for kind in self.kinds if kind is not NoneType]
        texts = [self._describe_range(kind) if kind in (int, float) else KIND_NAMES.get(kind, "") for kind in kinds]
        texts += [str(word) for word in self.words]
        return join_words([*texts, KIND_NAMES[NoneType]] if null and NoneType in self.kinds else texts)

    def expected(self, value: Any, *, null: bool = False) -> str:
        """Describe the expected values for an error message about ``value``."""
        values = self.values(null=null)
        numbers = [kind for kind in (float, int) if kind in self.kinds]
        is_whole = isinstance(value, float) and numbers == [int]
        is_other = not isinstance(value, Real | NoneType) and not self.words
        if not numbers or not (is_whole or is_other) or values.startswith(KIND_NAMES[numbers[0]]):
            return values
        return f"{KIND_NAMES[numbers[0]]}, {values}"

    def _describe_range(self, kind: type) -> str:
        low = None if self.least is None else _number(self.least)
        high = None if self.most is None else _number(self.most)
        if low is None and self.above is not None:
            low = f"above {_number(self.above)}"
        if high is None and self.below not in (None, inf):
            high = f"below {_number(self.below)}"
        if low is None:
            return KIND_NAMES[kind]
        text = f"at least {low}".replace("at least above", "more than") if high is None else f"{low} to {high}"
        return f"{text} {self.unit}".strip()

    def check(self, value: Any) -> None:
        """Raise ValueError, with the expected values, if a value is not allowed."""
        if value is self.default:
            return
        if self.is_list:
            if not isinstance(value, list | tuple):
                remedy = f"; write ({value!r},)" if self._fits(value) and self._in_range(value) else ""
                raise ValueError(f"{self.name}: expected a list of {self.expected(value)}, got {value!r}{remedy}")
            if self.filled and not value:
                raise ValueError(f"{self.name}: expected at least one value, got none")
            for element in value:
                self._check(element)
            if self.unique and len(set(value)) < len(value):
                raise ValueError(f"{self.name}: expected every value once, got {','.join(map(str, value))}")
        else:
            self._check(value)

    def _check(self, value: Any) -> None:
        is_text = not self.choices and set(_types(self.kind)) <= {str, NoneType}
        if is_text and not isinstance(value, str | NoneType):
            raise ValueError(f"{self.name}: expected a text, got {value!r}")
        is_checked_later = any(kind not in (int, float, bool, NoneType) for kind in self.kinds)  # by its class
        if is_checked_later or (self._fits(value) and self._in_range(value)):
            return
        is_number = isinstance(value, str) and re.fullmatch(r"-?\d*\.?\d+", value, re.ASCII) is not None
        is_quoted = is_number and bool({int, float} & set(self.kinds))
        hint = f"; perhaps {value} without quotes" if is_quoted else suggest_name(value, self.words)
        raise ValueError(f"{self.name}: expected {self.expected(value)}, got {value!r}{hint}")


def setting(default: Any, help: str, more: str = "", **declared: Any) -> Any:
    """Declare a setting as a field of a :class:`Settings` class; ``declared`` are fields of :class:`Setting`."""
    return field(default=default, metadata={"setting": Setting(help, more, default=default, **declared)})


class Settings:
    """Base class of frozen dataclasses whose fields are settings; invalid values raise ValueError."""

    def __init_subclass__(cls) -> None:
        """Write the declarations of the fields into the docstring."""
        declared = [(name, f) for name, f in vars(cls).items() if isinstance(f, Field) and "setting" in f.metadata]
        lines = [f"    {name}: {f.metadata['setting'].text}" for name, f in declared]
        cls.__doc__ = "\n".join([cleandoc(cls.__doc__ or ""), "", "Args:", *lines])

    def __post_init__(self) -> None:
        for name, declared in settings_of(type(self)).items():
            value = getattr(self, name)
            if declared.is_group and not isinstance(value, declared.kind):
                actual = repr(value) if isinstance(value, str | Real) else type(value).__name__
                single = f"{type(self).__name__}().with_settings({{...}}) takes single settings by name"
                remedy = f"; {single}" if hasattr(self, "with_settings") else ""
                raise ValueError(f"{name}: expected {declared.kind.__name__}, got {actual}{remedy}")
            declared.check(value)


_declared: dict[type, dict[str, Setting]] = {}  # by class; resolving the types of its fields takes time


def settings_of(options: type) -> dict[str, Setting]:
    """Return the declarations of a class of settings by field name."""
    if options not in _declared:
        kinds = get_type_hints(options)
        entries = {f.name: f.metadata["setting"] for f in fields(options) if "setting" in f.metadata}
        _declared[options] = {n: replace(entry, name=entry.name or n, kind=kinds[n]) for n, entry in entries.items()}
    return _declared[options]


@cache
def flat_settings(options: type) -> dict[str, Setting]:
    """Return all settings by flat name; the settings of a stage replace the stage."""
    flat: dict[str, Setting] = {}
    for name, declared in settings_of(options).items():
        if not declared.internal:
            inner = flat_settings(declared.kind) if declared.is_group else {name: declared}
            flat |= {key: replace(entry, acts_on=entry.acts_on or declared.acts_on) for key, entry in inner.items()}
    return flat


def names_of(options: type, condition: Callable[[Setting], Any]) -> tuple[str, ...]:
    """Return the flat names of the settings whose declaration meets a condition."""
    return tuple(name for name, declared in flat_settings(options).items() if condition(declared))


def piece_settings(options: type, *, trial: bool = False) -> dict[str, Any]:
    """Return the values that a run on a piece of a scene needs, by flat name.

    ``trial`` stands for a run that tries settings on some of the views.
    """
    declared = flat_settings(options)
    values = {
        name: entry.in_trial if trial and entry.in_trial is not SAME else entry.in_piece
        for name, entry in declared.items()
    }
    return {name: value for name, value in values.items() if value is not SAME}


def change_settings(options: T, values: Mapping[str, Any]) -> T:
    """Change settings by flat name, including those of stages."""
    changes: dict[str, Any] = {}
    for name, declared in settings_of(type(options)).items():
        names = flat_settings(declared.kind) if declared.is_group and not declared.internal else {name}
        new_values = {key: values[key] for key in names if key in values}
        if new_values:
            changes[name] = change_settings(getattr(options, name), new_values) if declared.is_group else values[name]
    changed: T = replace(options, **changes)  # type: ignore[type-var]
    return changed


def join_words(words: Iterable[str]) -> str:
    """Join words as "a, b or c"."""
    listed = list(words)
    return " or ".join(filter(None, (", ".join(listed[:-1]), *listed[-1:])))


def find_near_names(word: str, names: Iterable[Any], count: int = 1, least: float = 0.6) -> list[Any]:
    """List at most ``count`` names that resemble a word, the nearest first; case does not matter.

    ``least``: least similarity, 0 to 1, as difflib measures it.
    """
    from difflib import get_close_matches

    lower = {str(name).lower(): name for name in names}
    return [lower[match] for match in get_close_matches(word.lower(), lower, count, least)]


def suggest_name(word: Any, names: Iterable[Any]) -> str:
    """Return "; perhaps NAME", the end of a message about an unknown word, or "" if no name resembles it."""
    return "".join(f"; perhaps {name}" for name in find_near_names(word, names)) if isinstance(word, str) else ""


def _types(kind: Any) -> list[Any]:
    """List the possible types of a value, or of the elements of a list."""
    if get_origin(kind) in (Union, UnionType):
        return [inner for member in get_args(kind) for inner in _types(member)]
    return _types(get_args(kind)[0]) if get_origin(kind) is tuple else [kind]


def _number(value: float | None) -> str:
    return str(value) if isinstance(value, int) else f"{value:g}"
