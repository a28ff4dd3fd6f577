"""Functions on NumPy arrays or torch tensors; torch is imported only if tensors are asked for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from functools import reduce
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gsmerge.errors import SceneError, refuse_without_torch

if TYPE_CHECKING:
    import torch

Array = NDArray[Any]  # or a torch tensor if a docstring allows tensors, which type checkers do not see


class ArrayFields:
    """Base of dataclasses of arrays, whose ``==`` gives one boolean; on the arrays alone it would give an array."""

    def __eq__(self, other: object) -> bool:
        if other.__class__ is not self.__class__:
            return NotImplemented
        names = [field.name for field in fields(self) if field.compare]  # type: ignore[arg-type]
        return all(is_equal(getattr(self, name), getattr(other, name)) for name in names)

    def __hash__(self) -> int:
        return hash(repr(self))  # equal values have equal shapes

    def __repr__(self) -> str:
        names = [field.name for field in fields(self) if field.repr]  # type: ignore[arg-type]
        return f"{type(self).__name__}({', '.join(f'{name}={shorten(getattr(self, name))}' for name in names)})"


def check_numbers(name: str, values: Any) -> None:
    """Raise SceneError unless values are an array, or a tensor that has a real number in each place."""
    is_tensor = hasattr(values, "detach")
    is_real = (
        "strided" in str(values.layout)
        and not (values.is_nested or values.is_quantized or values.is_meta or values.is_complex())
        if is_tensor else np.asarray(values).dtype.kind in "fiub"
    )  # fmt: skip
    if not is_real:
        kind = (
            type(values).__name__
            + (f" of {values.dtype}" if hasattr(values, "dtype") else "")
            + (f" ({values.layout}, on {values.device})" if is_tensor else "")
        )
        raise SceneError(name, f"expected an array or a dense tensor of numbers, found {kind}")


def check_shape(name: str, array: Array, shape: tuple[int | str, ...]) -> int:
    """Return the length of an array; TypeError for anything but an array or tensor, ValueError for another shape.

    ``shape`` is the expected shape, in which a name stands for any length. ``name`` is the array's name in messages.
    """
    if not hasattr(array, "ndim"):
        raise TypeError(f"{name}: expected an array or a tensor, got {type(array).__name__}")
    fits = array.ndim == len(shape) and all(
        isinstance(expected, str) or expected == length for expected, length in zip(shape, array.shape, strict=True)
    )
    if not fits:
        raise ValueError(f"{name}: expected shape [{', '.join(map(str, shape))}], got {list(array.shape)}")
    return array.shape[0]


def as_index(rows: str, index: Any) -> Any:
    """Return an index of several rows: a slice, a mask or integers, a tuple as a list; TypeError for any other index.

    ``rows`` is the name of the rows in messages.
    """
    if isinstance(index, slice | list | range) or getattr(index, "ndim", 0) == 1:
        return index
    if isinstance(index, tuple):
        return list(index)
    is_number = isinstance(index, int | np.integer)
    actual, remedy = (index, f"; write {rows}[[{index}]] for one") if is_number else (type(index).__name__, "")
    raise TypeError(f"{rows}: expected a slice, a mask or indices, got {actual}{remedy}")


def as_array(values: Any) -> np.ndarray:
    """Return an array, or a tensor on any device, as a NumPy array without gradient; copy only if needed.

    A tensor's floats of less than 32 bits become float32, because NumPy lacks some of their types.
    """
    if hasattr(values, "detach"):
        check_numbers("tensor", values)
        values = values.float() if values.is_floating_point() and values.element_size() < 4 else values
    return np.asarray(values.detach().cpu().numpy() if hasattr(values, "detach") else values)


def as_pictures(images: Array) -> np.ndarray:
    """Return pictures ``[...,3]`` as sRGB in [0, 1]; pictures of uint8 are divided by 255.

    Raises ValueError for values more than 1/255 outside [0, 1].
    """
    pictures = as_array(images)
    if pictures.dtype == np.uint8:
        return np.multiply(pictures, np.float32(1 / 255), dtype=np.float32)
    low, high = (float(pictures.min()), float(pictures.max())) if pictures.size else (0.0, 0.0)
    if not (low >= -1 / 255 and high <= 1 + 1 / 255):
        remedy = "divide them by 255" if low >= 0 and 1.5 < high <= 255 else "clip them"
        raise ValueError(f"images: expected sRGB in [0, 1], or uint8, got {low:.4g} to {high:.4g}; {remedy}")
    return pictures if pictures.dtype in (np.float32, np.float64) else to_float32(pictures)


def as_tensor(values: Array, device: torch.device | str = "cpu") -> torch.Tensor:
    """Return an array or a tensor as a tensor on a device; on the CPU the tensor shares the array's memory."""
    with refuse_without_torch():
        import torch

    check_numbers("tensor", values)
    return torch.as_tensor(values, device=device)


def distinct(values: np.ndarray) -> np.ndarray:
    """Return the distinct values of an array ``[n]``, ascending, like ``np.unique``, but several times as fast."""
    ordered = np.sort(values)
    is_new = np.ones(len(ordered), bool)
    np.not_equal(ordered[1:], ordered[:-1], out=is_new[1:])
    return ordered[is_new]


def mean_columns(values: np.ndarray) -> np.ndarray:
    """Return the mean of few columns, such as channels, with the bits of ``mean(-1)``, in a tenth of its time."""
    first, *others = np.moveaxis(values, -1, 0)
    return np.asarray(sum(others, first) / values.dtype.type(values.shape[-1]))


def max_columns(values: np.ndarray) -> np.ndarray:
    """Return the maximum of few columns, such as channels, like ``max(-1)``, in a tenth of its time."""
    return np.asarray(reduce(np.maximum, np.moveaxis(values, -1, 0)))


def to_float32(values: np.ndarray) -> np.ndarray:
    """Round an array to float32; numbers beyond the range of float32 become infinite."""
    with np.errstate(over="ignore"):
        return values.astype(np.float32, order="C")


def like(values: np.ndarray, template: Array) -> Any:
    """Convert ``values`` to the type of ``template``: a NumPy array, or a tensor on the same device."""
    return as_tensor(values, template.device) if hasattr(template, "detach") else values


def concat_rows(parts: Sequence[Array], axis: int = 0) -> Any:
    """Concatenate arrays, or tensors, along ``axis``."""
    if all(isinstance(part, np.ndarray) for part in parts):
        return np.concatenate(parts, axis)
    import torch

    return torch.cat([torch.as_tensor(part) for part in parts], axis)


def concat_columns(parts: Sequence[Array]) -> Array:
    """Concatenate the columns of arrays or tensors."""
    return concat_rows(parts, 1)


def is_equal(one: Any, other: Any) -> bool:
    """Return whether two values are equal, for arrays and tensors in shape and in all numbers; NaN equals NaN."""
    if one is other:
        return True
    if getattr(one, "ndim", 0) or getattr(other, "ndim", 0):
        alike = [(getattr(each, "shape", None), getattr(each, "device", None)) for each in (one, other)]
        return alike[0] == alike[1] and bool(((one == other) | ((one != one) & (other != other))).all())
    return bool(one == other)


def shorten(value: Any) -> str:
    """Describe a value in one line; an array or a tensor only by its type and shape."""
    return f"{type(value).__name__}{list(value.shape)}" if getattr(value, "ndim", 0) else repr(value)
