"""Frozen dataclasses of this package behave like those of the standard library."""

from __future__ import annotations

import copy
import dataclasses
import inspect
import pickle
from collections.abc import Callable
from dataclasses import FrozenInstanceError, dataclass, field, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
import pytest

Decorator = Callable[..., Any]


def make(decorator: Decorator, **options: Any) -> type:
    @decorator(frozen=True, **options)
    class Box:
        values: list[int]  # a name that a compiled method might use as well
        side: float = 1.5
        names: list[str] = field(default_factory=list, compare=False)
        hidden: int = field(default=3, repr=False)
        late: list[int] = field(init=False, default_factory=list)
        fixed: int = field(init=False, default=7)

        def __post_init__(self) -> None:
            self.late.append(len(self.values))

        @cached_property
        def total(self) -> int:
            return sum(self.values)

    return Box


@dataclass(frozen=True)
class Point:
    x: int
    y: int = 0


@dataclass(frozen=True)
class Named(Point):
    name: str = ""

    def __repr__(self) -> str:
        return self.name

    def __hash__(self) -> int:
        return 5


@pytest.mark.parametrize("options", [{}, {"eq": False}, {"repr": False}, {"kw_only": True}], ids=str)
def test_classes_are_like_those_of_the_standard_library(options: dict[str, bool]) -> None:
    ours, theirs = make(dataclass, **options), make(dataclasses.dataclass, **options)
    assert str(inspect.signature(ours)) == str(inspect.signature(theirs))
    assert ours.__init__.__annotations__ == theirs.__init__.__annotations__  # type: ignore[misc]
    a, b = (kind(values=[1, 2], names=["x"], side=2.5) for kind in (ours, theirs))
    assert vars(a) == vars(b)
    assert a.fixed == 7
    assert (repr(a) == repr(b)) == options.get("repr", True)  # otherwise both have an address
    for change in ({}, {"names": []}, {"hidden": 4}, {"values": [1]}):
        assert (a == replace(a, **change)) == (b == replace(b, **change))
    assert [f.name for f in fields(ours)] == [f.name for f in fields(theirs)]
    for wrong in ((), (1, 2, 3, 4, 5, 6)):
        with pytest.raises(TypeError):
            ours(*wrong)


def test_values_stay() -> None:
    point = Point(1)
    with pytest.raises(FrozenInstanceError, match="cannot assign to field 'x'"):
        point.x = 2  # type: ignore[misc]
    with pytest.raises(FrozenInstanceError, match="cannot delete field 'x'"):
        del point.x
    box = make(dataclass)([1, 2])
    assert (box.total, vars(box)["total"]) == (3, 3)


def test_equality_and_hash_go_by_class_and_values() -> None:
    assert Point(1, 2) == Point(1, 2) != Point(1, 3)
    assert len({Point(1, 2), Point(1, 2), Point(2, 1)}) == 2
    assert Point(1, 2) != Named(1, 2)
    assert (Point(1) == "a point") is False
    assert make(dataclass, eq=False)([1]) != make(dataclass, eq=False)([1])


def test_methods_of_a_class_stay() -> None:
    named = Named(1, name="corner")
    assert (repr(named), hash(named), named.y) == ("corner", 5, 0)
    assert repr(Point(1)) == "Point(x=1, y=0)"


@pytest.mark.parametrize("copied", [copy.copy, copy.deepcopy, lambda value: pickle.loads(pickle.dumps(value))])
def test_copies_are_equal(copied: Callable[[Any], Any]) -> None:
    assert copied(Named(1, 2, "corner")) == Named(1, 2, "corner")


def test_other_classes_are_those_of_the_standard_library() -> None:
    @dataclass
    class Bare:
        x: int

    @dataclass(eq=False)
    class Compared:
        x: int

    bare = Bare(1)
    bare.x = 2
    assert bare == Bare(2)
    assert Compared(1) != Compared(1)


def test_arrays_are_equal_by_shape_and_numbers() -> None:
    """Also inside tuples and dictionaries; the type of the numbers does not count, and NaN equals NaN."""
    values = np.array([1.0, np.nan])
    for one in (values, (1, values), [values], {"a": (values,)}, values[:0], np.float32("nan"), np.array(["a"])):
        assert Point(copy.deepcopy(one)) == Point(one)  # type: ignore[arg-type]
        assert Point(one) != Point(1)  # type: ignore[arg-type]
    assert Point(values.astype(np.float32)) == Point(values)  # type: ignore[arg-type]
    assert Point(np.arange(2)) in [Point(np.zeros(2)), Point(np.array([0.0, 1.0]))]  # type: ignore[arg-type]
    for other in (values[:1], values[None], values + 1, [1.0, np.nan], (values, values), {"b": values}, None, "1"):
        assert Point(other) != Point(values)  # type: ignore[arg-type]
        assert Point({"a": other}) != Point({"a": values})  # type: ignore[arg-type]


def test_tensors_are_equal_on_one_device(torch: Any) -> None:
    tensor = torch.tensor([1.0, torch.nan], requires_grad=True)
    assert Point(copy.deepcopy(tensor)) == Point(tensor)
    for other in (tensor + 1, tensor[:1], tensor.detach().numpy(), tensor.to("meta")):
        assert Point(other) != Point(tensor)
