"""Check the arguments of public functions, and the fields of public classes, by their annotations.

A wrong type raises TypeError with one clear line.
"""

from __future__ import annotations

import inspect
import os
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from functools import cache, wraps
from typing import Any, TypeVar, cast

Function = TypeVar("Function", bound=Callable[..., Any])

# Name in an annotation -> its words in messages, and the test of a value; CLASSES has the names of classes
KINDS: Mapping[str, tuple[str, Callable[[Any], bool]]] = {
    "None": ("", lambda value: value is None),
    "StrPath": ("a path", lambda value: isinstance(value, str | os.PathLike)),
    "int": ("a whole number", lambda value: hasattr(value, "__index__") and not isinstance(value, bool)),
    "Progress": ("a function", callable),
    "OnImage": ("a function", callable),
    "np.ndarray": ("an array", lambda value: hasattr(value, "ndim")),
    "tuple[str, ...]": (
        "a tuple of texts",
        lambda value: isinstance(value, tuple | list) and all(isinstance(one, str) for one in value),
    ),
    "HasGaussians": ("a result", lambda value: hasattr(value, "gaussians")),
}
CLASSES = {
    "Pixels": "Pixels", "LargePhotos": "LargePhotos", "Region": "a Region",
    "Scene": "a Scene", "Gaussians": "Gaussians", "Cameras": "Cameras", "Views": "Views", "CameraFile": "a CameraFile",
    "CompactOptions": "CompactOptions", "EvaluateOptions": "EvaluateOptions",
}  # fmt: skip
GAUSSIANS_REMEDY = "write Gaussians to a file and give its path; tensors go to compact_tensors"


def check_arguments(function: Function) -> Function:
    """Decorate a public function so that arguments of undeclared types raise TypeError, with one line.

    Only parameters are checked whose annotations consist of names from :data:`KINDS` and :data:`CLASSES`, and of lists
    and mappings of these.
    """
    parameters = inspect.signature(function).parameters
    checked = {name: p for name, p in parameters.items() if isinstance(p.annotation, str) and _is_known(p.annotation)}
    places = {name: place for place, name in enumerate(parameters)}

    @wraps(function)
    def call(*args: Any, **named: Any) -> Any:
        for name, parameter in checked.items():
            if parameter.kind is parameter.VAR_POSITIONAL:
                for value in args[places[name] :]:
                    _check(name, parameter.annotation, value)
            elif name in named:
                _check(name, parameter.annotation, named[name])
            elif places[name] < len(args) and parameter.kind is not parameter.KEYWORD_ONLY:
                _check(name, parameter.annotation, args[places[name]])
        return function(*args, **named)

    return cast("Function", call)


def check_fields(value: Any) -> None:
    """Raise TypeError, with one line, if a field of a dataclass has an undeclared type; see :func:`check_arguments`."""
    kind: Any = type(value)
    for name, annotation in _known_fields(kind):
        _check(name, annotation, getattr(value, name))


@cache
def _known_fields(kind: type) -> Sequence[tuple[str, str]]:
    """Return names and annotations of the fields of a dataclass that are checked."""
    return [(field.name, field.type) for field in fields(kind) if isinstance(field.type, str) and _is_known(field.type)]


def _check(name: str, annotation: str, value: Any) -> None:
    """Raise TypeError, with the expected types, if a value has none of the types of an annotation."""
    if not _fits(annotation, value):
        remedy = _remedy(annotation, value)
        end = f"; {remedy}" if remedy else ""
        raise TypeError(f"{name}: expected {_describe(annotation)}, got {_describe_value(value)}{end}")


def _remedy(annotation: str, value: Any) -> str:
    """Return what to pass instead of a wrong value; "" if that is not clear."""
    kinds = {_split(part)[1] for part in _parts(annotation)}
    if "Scene" in kinds:
        is_path = KINDS["StrPath"][1](value)
        return "gsmerge.read_scene(path) reads it" if is_path else GAUSSIANS_REMEDY if "StrPath" in kinds else ""
    if annotation.startswith("Mapping"):
        return "name each, such as {'small': result}"
    return "pass its .gaussians" if "Gaussians" in annotation and hasattr(value, "gaussians") else ""


@cache
def _parts(annotation: str) -> Sequence[str]:
    """Split an annotation at each | outside brackets."""
    return [part.strip() for part in re.split(r"\|(?![^\[]*\])", annotation)]


@cache
def _split(part: str) -> tuple[str, str]:
    """Split a part of an annotation into its container, "" without one, and the annotation of the elements."""
    match = re.fullmatch(r"(Mapping\[str, |Sequence\[)(.*)\]", part)
    return ("", part) if match is None else (match[1], match[2])


def _is_known(annotation: str) -> bool:
    """Return whether an annotation consists of known names only."""
    split = [_split(part) for part in _parts(annotation)]
    return all(_is_known(inner) if container else inner in KINDS or inner in CLASSES for container, inner in split)


def _fits(annotation: str, value: Any) -> bool:
    """Return whether a value has one of the types that an annotation names."""
    for container, inner in map(_split, _parts(annotation)):
        if container:
            values = _values(container, value)
            fits = values is not None and all(_fits(inner, each) for each in values)
        elif inner in KINDS:
            fits = KINDS[inner][1](value)
        else:
            fits = any(base.__name__ == inner for base in type(value).__mro__)
        if fits:
            return True
    return False


def _values(container: str, value: Any) -> Sequence[Any] | None:
    """Return the values in a container; None if ``value`` is not such a container."""
    if container.startswith("Mapping"):
        return list(value.values()) if isinstance(value, Mapping) else None
    return value if isinstance(value, list | tuple) else None


def _describe(annotation: str) -> str:
    """Describe the types of an annotation in words, containers last."""
    words, containers = list[str](), list[str]()
    for container, inner in map(_split, _parts(annotation)):
        if not container:
            words.append(KINDS[inner][0] if inner in KINDS else CLASSES[inner])
        elif container.startswith("Mapping"):
            containers.append(f"{_describe(inner)} by name")
        else:
            containers.append(f"a list of {_describe(inner)}")
    listed = [word for word in words if word]
    listed += containers if not listed else ["several by name"] * bool(containers)
    return " or ".join(filter(None, (", ".join(listed[:-1]), listed[-1])))


def _describe_value(value: Any) -> str:
    """Name the type of a value and of its first element."""
    elements = list(value.values()) if isinstance(value, Mapping) else value if isinstance(value, list | tuple) else ()
    return type(value).__name__ + (f" of {type(elements[0]).__name__}" if elements else "")
