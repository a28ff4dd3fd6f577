"""Declare settings, each with its default, its help and its possible values.

The checks of values, the help in Python, the options of the command line and docs/reference all follow from these
declarations. This package imports neither NumPy nor torch, so that ``--help`` is fast.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from functools import cache
from inspect import cleandoc
from math import inf
from numbers import Integral, Real
from operator import ge, gt, le, lt
from types import NoneType, UnionType
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from gsmerge.frozen import Field, dataclass, field, fields, is_dataclass, replace

T = TypeVar("T", bound="Settings")
KIND_NAMES = {int: "a whole number", float: "a number", bool: "true or false", str: "text"}


@dataclass(frozen=True)
class Setting:
    """The declaration of a setting, made by :func:`setting`; :func:`settings_of` adds the setting's name and type."""

    help: str  # first sentences of the help, which the command line shows too; names of values are in single backticks
    more: str = ""  # further sentences, which only Python's help and docs/reference show
    choices: Sequence[Any] | Callable[[], Sequence[Any]] = ()  # possible values, if the type does not list them
    least: float | None = None  # smallest value
    most: float | None = None  # largest value
    above: float | None = None  # values must be larger than this
    below: float | None = None  # values must be smaller than this
    unit: str = ""  # unit of the value, for messages
    unique: bool = False  # true if a list must not repeat a value
    filled: bool = False  # true if a list must have at least one value
    internal: bool = False  # true if only the program sets it
    as_text: bool = False  # true if a number that a user types stays a text, as reports store it
    name: str = ""  # name of the field
    kind: Any = None  # type of the field
    default: Any = None

    @property
    def text(self) -> str:
        """The whole help of the setting."""
        return f"{self.help} {self.more}".strip()

    @property
    def is_group(self) -> bool:
        """True if the value is a group of settings in its own dataclass, such as the settings of a stage."""
        return is_dataclass(self.kind)

    @property
    def is_list(self) -> bool:
        """True if the setting takes a list. Choices and range of a list apply to the elements of the list."""
        return get_origin(self.kind) is tuple

    @property
    def kinds(self) -> list[Any]:
        """The types that a value may have, besides the words that are listed one by one."""
        kinds = [kind for kind in _types(self.kind) if get_origin(kind) is not Literal]
        return [kind for kind in kinds if kind is NoneType] if self.choices else kinds

    @property
    def words(self) -> tuple[Any, ...]:
        """The possible values that are listed one by one."""
        listed = self.choices() if callable(self.choices) else self.choices
        literals = [kind for kind in _types(self.kind) if get_origin(kind) is Literal]
        return (*listed, *(word for kind in literals for word in get_args(kind)))

    def fits(self, value: Any) -> bool:
        """Return whether a value has one of the types of this setting. Choices and range are not checked."""
        values = value if self.is_list and isinstance(value, list | tuple) else [value]
        is_kind = isinstance(value, list | tuple) or not self.is_list
        return is_kind and all(any(_is_of_kind(one, kind) for kind in _types(self.kind)) for one in values)

    def _in_range(self, value: Any) -> bool:
        """Return whether a value of the right type is one of the choices, and in the range."""
        if self.choices:
            return value is None or value in self.words
        is_number = isinstance(value, Real)
        limits = ((self.least, ge), (self.most, le), (self.above, gt), (self.below, lt))
        return all(bool(holds(value, limit)) for limit, holds in limits if is_number and limit is not None)

    def parse(self, text: str) -> Any:
        """Return the value that a typed text stands for: the first of JSON, a number and the text itself that fits."""
        if self.as_text and text != "null":
            return text
        meanings = _list_meanings(text)
        if self.is_list:
            meanings.append([_list_meanings(word.strip())[0] for word in text.split(",")])
        return next(filter(self.fits, meanings), text)

    def read(self, text: str) -> Any:
        """Return the value that a typed text stands for; ValueError if it is not allowed."""
        value = self.parse(text)
        self.check(value)
        return value

    def values(self) -> str:
        """Describe the possible values in a text for messages, such as "a whole number from 1 to 8 or auto"."""
        kinds = [kind for kind in self.kinds if kind is not NoneType]
        texts = [self._describe_range(kind) if kind in (int, float) else KIND_NAMES.get(kind, "") for kind in kinds]
        return join_words([*texts, *map(str, self.words)])

    def _describe_range(self, kind: type) -> str:
        """Describe the possible numbers in words, such as "a whole number from 1 to 8"."""
        low = f"above {_number(self.above)}" if self.least is None else _number(self.least)
        high = f"below {_number(self.below)}" if self.most is None else _number(self.most)
        if self.least is None and self.above is None:
            return KIND_NAMES[kind]
        text = f"from {low} to {high}"
        if self.most is None and self.below in (None, inf):
            text = low if self.least is None else f"of at least {low}"
        return f"{KIND_NAMES[kind]} {text} {self.unit}".strip()

    def check(self, value: Any) -> None:
        """Raise ValueError if a value is not allowed; the message has the possible values."""
        if value is self.default:
            return
        if self.is_list and not isinstance(value, list | tuple):
            raise ValueError(f"{self.name}: expected a list of {self.values()}, got {value!r}")
        if self.filled and not value:
            raise ValueError(f"{self.name}: expected at least one value, got none")
        for element in value if self.is_list else [value]:
            fits = any(_is_of_kind(element, kind) for kind in _types(self.kind))
            if not (fits and self._in_range(element)):
                hint = suggest_name(element, self.words)
                raise ValueError(f"{self.name}: expected {self.values()}, got {element!r}{hint}")
        if self.unique and len(set(value)) < len(value):
            raise ValueError(f"{self.name}: expected every value once, got {','.join(map(str, value))}")


def setting(default: Any, help: str, more: str = "", **declared: Any) -> Any:
    """Declare a field of a :class:`Settings` class as a setting; ``declared`` are fields of :class:`Setting`."""
    return field(default=default, metadata={"setting": Setting(help, more, default=default, **declared)})


class Settings:
    """Base class of frozen dataclasses whose fields are settings. Invalid values raise ValueError."""

    def __init_subclass__(cls) -> None:
        """Append the help of all fields to the docstring of the class."""
        declared = [(name, f) for name, f in vars(cls).items() if isinstance(f, Field) and "setting" in f.metadata]
        lines = [f"    {name}: {f.metadata['setting'].text}" for name, f in declared]
        cls.__doc__ = "\n".join([cleandoc(cls.__doc__ or ""), "", "Args:", *lines])

    def __post_init__(self) -> None:
        for name, declared in settings_of(type(self)).items():
            value = getattr(self, name)
            if declared.is_group and not isinstance(value, declared.kind):
                problem = f"{name}: expected {declared.kind.__name__}, got {value!r:.40}"
                raise ValueError(f"{problem}; {type(self).__name__}().with_settings takes single settings by name")
            declared.check(value)

    def with_settings(self: T, settings: Mapping[str, Any]) -> T:
        """Return these settings with other values of some, also of settings in groups, by flat name."""
        changes: dict[str, Any] = {}
        for name, declared in settings_of(type(self)).items():
            names = flat_settings(declared.kind) if declared.is_group and not declared.internal else {name}
            values = {key: settings[key] for key in names if key in settings}
            if values:
                changes[name] = getattr(self, name).with_settings(values) if declared.is_group else settings[name]
        return replace(self, **changes)  # type: ignore[type-var]


_declared: dict[type, dict[str, Setting]] = {}  # results of settings_of, which takes time to resolve types


def settings_of(options: type) -> dict[str, Setting]:
    """Return the declarations of the settings of a class, by field name, in the order of the fields."""
    if options not in _declared:
        kinds = get_type_hints(options)
        entries = {f.name: f.metadata["setting"] for f in fields(options) if "setting" in f.metadata}
        _declared[options] = {
            name: replace(entry, name=entry.name or name, kind=kinds[name]) for name, entry in entries.items()
        }
    return _declared[options]


@cache
def flat_settings(options: type) -> dict[str, Setting]:
    """Return the declarations of all settings that users can give, also of settings in groups, by flat name."""
    flat: dict[str, Setting] = {}
    for name, declared in settings_of(options).items():
        if not declared.internal:
            flat |= flat_settings(declared.kind) if declared.is_group else {name: declared}
    return flat


def join_words(words: Iterable[str]) -> str:
    """Join words to a text such as "a, b or c"."""
    listed = list(words)
    return " or ".join(filter(None, (", ".join(listed[:-1]), *listed[-1:])))


# Names that other programs give to options and settings, and the different names of the same here
SYNONYMS = {
    **dict.fromkeys(("force", "clobber", "yes"), "overwrite"),
    **dict.fromkeys(("ratio", "percent", "keep", "count", "number", "num_gaussians", "target", "size"), "budget"),
    **dict.fromkeys(("format", "to", "type", "out", "path"), "output"),
    **dict.fromkeys(("photos", "image_dir"), "images"),
    **dict.fromkeys(("poses", "colmap", "viewmats"), "cameras"),
}


def suggest_name(word: Any, names: Iterable[Any]) -> str:
    """Return the end of a message about an unknown word: "; perhaps NAME", or nothing if no name resembles the word."""
    from difflib import get_close_matches

    lower_names = {str(name).lower(): name for name in names}
    return "".join(
        f"; perhaps {lower_names[nearest]}" for nearest in get_close_matches(str(word).lower(), lower_names, 1)
    )


def _list_meanings(text: str) -> list[Any]:
    """List the possible values of a text, the best first: as JSON, as a number, and as text."""
    meanings: list[Any] = [text]
    for parse in (float, json.loads):
        with suppress(ValueError, RecursionError):
            meanings.insert(0, parse(text))
    return meanings


def _is_of_kind(value: Any, kind: Any) -> bool:
    """Return whether a value has a type, or is one of the words of a Literal; neither True nor False is a number."""
    if get_origin(kind) is Literal:
        return value in get_args(kind)
    is_bool = type(value).__name__.startswith("bool")  # of Python or NumPy, which is not imported here
    if is_bool or kind is bool:
        return is_bool and kind is bool
    return isinstance(value, {int: Integral, float: Real}.get(kind, kind))


def _types(kind: Any) -> list[Any]:
    """Return the possible types of a value or, if ``kind`` is a list, of its elements."""
    if get_origin(kind) in (Union, UnionType):
        return [inner for member in get_args(kind) for inner in _types(member)]
    return _types(get_args(kind)[0]) if get_origin(kind) is tuple else [kind]


def _number(value: float | None) -> str:
    """Format a number; a float has no zeros at its end."""
    return f"{value:g}" if isinstance(value, float) else str(value)
