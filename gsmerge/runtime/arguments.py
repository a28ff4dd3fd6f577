"""Check the arguments of public functions, and the fields of public classes, by their annotations.

A wrong type raises TypeError with one clear line. Left out, ``compact(5)`` fails from 10 calls deep with "expected str,
bytes or os.PathLike object", and a result in place of its Gaussians with "has no attribute 'sh_degree'". The checks
take 2 % of the instructions of a run's imports. Annotations are compared as texts, because most of their types are
imported only for type checking.
"""

from __future__ import annotations

import inspect
import os
import re
from collections.abc import Callable, Mapping
from dataclasses import fields
from functools import cache, wraps
from pathlib import Path
from typing import Any, TypeVar, cast

from gsmerge.errors import SceneError

Function = TypeVar("Function", bound=Callable[..., Any])

# Name in annotations -> words for it in messages, and a function that tests a value. CLASSES are all other known names
ARGUMENT_KINDS: Mapping[str, tuple[str, Callable[[Any], bool]]] = {
    "None": ("", lambda value: value is None),
    "StrPath": ("a path", lambda value: isinstance(value, str | os.PathLike)),
    "str": ("a text", lambda value: isinstance(value, str)),
    "int": ("a whole number", lambda value: hasattr(value, "__index__") and not isinstance(value, bool)),
    "Progress": ("a function", callable),
    "OnImage": ("a function", callable),
    "np.ndarray": ("an array", lambda value: hasattr(value, "ndim")),
    "HasGaussians": ("a result", lambda value: hasattr(value, "gaussians")),
}
CLASSES = (
    "Pixels", "LargePhotos", "Region", "Scene", "Gaussians", "Cameras", "Views", "CameraFile", "CompactOptions",
    "EvaluateOptions",
)  # fmt: skip
# Beginning of the annotation of a container -> the types that count as this container
CONTAINERS = {"Mapping[str, ": Mapping, "Sequence[": list | tuple, "tuple[": list | tuple}
REMEDIES = {
    "Mapping": 'pass {"a name": result}',
    "Scene": "gsmerge.read_scene(path) reads one; tensors go to gsmerge.compact_tensors",
    "Gaussians": "pass the .gaussians of a result",
    "CompactOptions": 'settings are named, as in compact(scene, budget="2%"), and .save(path) of the result writes it',
}


def check_arguments(function: Function) -> Function:
    """Decorate a public function, so that arguments of other types than declared raise a TypeError of one line.

    A parameter is checked if its annotation consists of names from :data:`ARGUMENT_KINDS` and :data:`CLASSES`, or of
    lists and mappings of these. Paths that begin with ~ are changed as by :func:`expand_home`.
    """
    signature = inspect.signature(function)
    checked = {name: str(p.annotation) for name, p in signature.parameters.items() if _is_known(str(p.annotation))}

    @wraps(function)
    def call(*args: Any, **named: Any) -> Any:
        bound = signature.bind(*args, **named)
        arguments = bound.arguments
        for name in [name for name in arguments if name in checked]:
            is_variadic = signature.parameters[name].kind is inspect.Parameter.VAR_POSITIONAL
            values = arguments[name] if is_variadic else (arguments[name],)
            for value in values:
                _check_value(name, checked[name], value)
            if "StrPath" in checked[name]:
                arguments[name] = tuple(map(expand_home, values)) if is_variadic else expand_home(values[0])
        return function(*bound.args, **bound.kwargs)

    return cast("Function", call)


def expand_home(path: Any) -> Any:
    """Return a path whose leading ~ is replaced by the home folder, unless a file or folder has the name as it stands.

    A name such as ~scan, which is no user's, stays as it is, and so does what is no path. Raise SceneError where no
    home folder is known.
    """
    if not (isinstance(path, str | Path) and str(path).startswith("~")) or os.path.lexists(Path(path).parts[0]):
        return path
    expanded = os.path.expanduser(path)
    if expanded == str(path) and Path(path).parts[0] == "~":
        raise SceneError(path, "expected a home folder for ~, found none", "set HOME, or name the whole path")
    return type(path)(expanded)


def check_fields(value: Any) -> None:
    """Raise TypeError, with one line, if a field of a dataclass has another type than declared."""
    for field in fields(value):
        if _is_known(str(field.type)):
            _check_value(field.name, str(field.type), getattr(value, field.name))


@cache
def _split_annotation(annotation: str) -> list[tuple[str, str]]:
    """Split an annotation at each |; return the container of each part ("" for none) and the name in the container."""
    matches = [re.fullmatch(r"(Mapping\[str, |Sequence\[|tuple\[)?(.*?)(?:, \.\.\.)?\]?", part.strip())
               for part in re.split(r"\|(?![^\[]*\])", annotation)]  # fmt: skip
    return [(match[1] or "", match[2]) for match in matches if match]


@cache
def _is_known(annotation: str) -> bool:
    """Return whether an annotation consists only of names from ``ARGUMENT_KINDS`` and ``CLASSES``."""
    return all(
        (container in CONTAINERS and _is_known(name)) if container else name in ARGUMENT_KINDS or name in CLASSES
        for container, name in _split_annotation(annotation)
    )


def _check_value(name: str, annotation: str, value: Any) -> None:
    """Raise TypeError, with the expected types, if the value of an argument has another type than its annotation."""
    if _has_type(annotation, value):
        return
    words = re.sub(
        r"[\w.]+", lambda match: ARGUMENT_KINDS[match[0]][0] if match[0] in ARGUMENT_KINDS else match[0], annotation
    )
    words = words.removesuffix(" | ").replace(" | ", " or ")
    remedies = (f"; {remedy}" for kind, remedy in REMEDIES.items() if re.search(rf"\b{kind}\b", annotation))
    raise TypeError(f"{name}: expected {words}, got {type(value).__name__}{next(remedies, '')}")


def _has_type(annotation: str, value: Any) -> bool:
    """Return whether a value has one of the types that an annotation names."""
    for container, name in _split_annotation(annotation):
        if container:
            values = value.values() if isinstance(value, Mapping) else value
            fits = isinstance(value, CONTAINERS[container]) and all(_has_type(name, each) for each in values)
        elif name in ARGUMENT_KINDS:
            fits = ARGUMENT_KINDS[name][1](value)
        else:
            fits = any(base.__name__ == name for base in type(value).__mro__)
        if fits:
            return True
    return False
