"""Frozen dataclasses do what those of the standard library do."""

from __future__ import annotations

import copy
import dataclasses
import inspect
import pickle
from dataclasses import FrozenInstanceError
from typing import Any

import pytest

from gsmerge import frozen


class Point:
    x: int
    y: list[int] = dataclasses.field(default_factory=list, compare=False, repr=False)
    z: float = 0.5


MADE: list[Any] = [
    decorator(frozen=True)(type("Point", (Point,), {"__annotations__": Point.__annotations__, **vars(Point)}))
    for decorator in (dataclasses.dataclass, frozen.dataclass)
]
STANDARD, OURS = MADE
Point = OURS  # type: ignore[misc]  # pickle finds the class by its name


def test_values_are_made_compared_and_described_as_by_the_standard_library() -> None:
    assert inspect.signature(OURS) == inspect.signature(STANDARD)
    for point, standard in ((OURS(3), STANDARD(3)), (OURS(3, [1], z=2), STANDARD(3, [1], z=2))):
        assert repr(point) == repr(standard)
        assert hash(point) == hash(standard)
        assert dataclasses.asdict(point) == dataclasses.asdict(standard)
    assert OURS(3, [1]) == OURS(3, [2]) != OURS(4)
    assert OURS(3) != STANDARD(3)
    assert dataclasses.replace(OURS(3), z=1.0) == OURS(3, z=1.0)


def test_copies_are_equal() -> None:
    assert pickle.loads(pickle.dumps(OURS(3))) == copy.copy(OURS(3)) == copy.deepcopy(OURS(3)) == OURS(3)


@pytest.mark.parametrize("name", ["x", "other"])
def test_values_cannot_be_changed(name: str) -> None:
    point = OURS(3)
    with pytest.raises(FrozenInstanceError, match=name):
        setattr(point, name, 4)
    with pytest.raises(FrozenInstanceError, match=name):
        delattr(point, name)


def test_methods_of_the_class_itself_stay() -> None:
    own = {"__annotations__": {"x": int}, "__repr__": lambda _: "own", "__module__": __name__}
    assert repr(frozen.dataclass(frozen=True)(type("Own", (), own))(1)) == "own"
