"""Sixteen floats in one register, for the loop that LLVM's vectoriser does not get right by itself.

A sum per column of a tile, over its rows, belongs into a register. The vectoriser leaves it in memory, so the loop is
written in vectors; LLVM splits them on processors whose registers are shorter.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba.core import cgutils, types
from numba.extending import intrinsic

LANES = 16
FLOAT = ir.FloatType()
VECTOR = ir.VectorType(FLOAT, LANES)
FAST = ("contract", "nsz", "arcp", "reassoc")  # as in gsmerge.kernels.jit


class Lanes:
    """A vector or scalar of floats while code is generated, with the operators of one."""

    def __init__(self, builder: Any, value: Any) -> None:
        self.builder, self.value = builder, value

    def _with(self, operation: str, other: Any) -> Lanes:
        mine, theirs = self.value, self.like(other).value
        if mine.type != theirs.type:
            mine, theirs = self.wide().value, self.like(other).wide().value
        return Lanes(self.builder, getattr(self.builder, operation)(mine, theirs, flags=FAST))

    def like(self, other: Any) -> Lanes:
        """A number as a scalar of the same code."""
        return other if isinstance(other, Lanes) else Lanes(self.builder, ir.Constant(FLOAT, float(np.float32(other))))

    def wide(self) -> Lanes:
        """The scalar in all lanes."""
        if self.value.type == VECTOR:
            return self
        one = self.builder.insert_element(ir.Constant(VECTOR, ir.Undefined), self.value, ir.Constant(ir.IntType(32), 0))
        return Lanes(self.builder, self.builder.shuffle_vector(one, one, mask([0] * LANES)))

    def __add__(self, other: Any) -> Lanes:
        return self._with("fadd", other)

    def __sub__(self, other: Any) -> Lanes:
        return self._with("fsub", other)

    def __mul__(self, other: Any) -> Lanes:
        return self._with("fmul", other)

    def __truediv__(self, other: Any) -> Lanes:
        return self._with("fdiv", other)

    def __radd__(self, other: Any) -> Lanes:
        return self.like(other) + self

    def __rsub__(self, other: Any) -> Lanes:
        return self.like(other) - self

    def compare(self, operator: str, other: Any) -> Any:
        """Bits of a comparison, for :meth:`where`."""
        return self.builder.fcmp_ordered(operator, self.value, self.like(other).wide().value)

    def where(self, bits: Any, other: Any) -> Lanes:
        """These lanes where the bits are set, elsewhere the other's."""
        return Lanes(self.builder, self.builder.select(bits, self.value, self.like(other).wide().value))


def mask(lanes: Sequence[int]) -> Any:
    """Constant for the shuffles: lanes 0 to 15 are the first vector's, 16 to 31 the second's."""
    return ir.Constant(ir.VectorType(ir.IntType(32), len(lanes)), list(lanes))


def vector(builder: Any, numbers: Sequence[float]) -> Lanes:
    """Constant lanes."""
    return Lanes(builder, ir.Constant(VECTOR, [float(np.float32(number)) for number in numbers]))


def load(builder: Any, pointer: Any) -> Lanes:
    """Sixteen floats from an address of no particular alignment."""
    value = builder.load(builder.bitcast(pointer, VECTOR.as_pointer()))
    value.align = 4
    return Lanes(builder, value)


def store(lanes: Lanes, pointer: Any) -> None:
    """Write lanes, of any number, to an address of no particular alignment."""
    builder, value = lanes.builder, lanes.value
    builder.store(value, builder.bitcast(pointer, value.type.as_pointer())).align = 4


def totals(vectors: Sequence[Lanes]) -> Lanes:
    """The sums over the lanes of eight vectors, as eight lanes: a tree that halves all at once."""
    builder = vectors[0].builder

    def halves(first: Lanes, second: Lanes, group: int) -> Lanes:
        """Add the two halves of every group of lanes; the second's follow the first's per block."""
        low: list[int] = []
        high: list[int] = []
        for source in (0, LANES):
            for block in range(0, LANES, 2 * group):
                low += range(source + block, source + block + group)
                high += range(source + block + group, source + block + 2 * group)
        return Lanes(builder, builder.shuffle_vector(first.value, second.value, mask(low))) + Lanes(
            builder, builder.shuffle_vector(first.value, second.value, mask(high))
        )

    group = LANES // 2
    while len(vectors) > 1:
        vectors = [halves(vectors[i], vectors[i + 1], group) for i in range(0, len(vectors), 2)]
        group //= 2
    (last,) = vectors
    even = builder.shuffle_vector(last.value, last.value, mask(range(0, LANES, 2)))
    odd = builder.shuffle_vector(last.value, last.value, mask(range(1, LANES, 2)))
    return Lanes(builder, builder.fadd(even, odd, flags=FAST))


def total(lanes: Lanes) -> Lanes:
    """The sum over sixteen lanes, as a scalar."""
    builder, value, width = lanes.builder, lanes.value, LANES
    while width > 1:
        width //= 2
        low, high = (builder.shuffle_vector(value, value, mask(range(i, i + width))) for i in (0, width))
        value = builder.fadd(low, high, flags=FAST)
    return Lanes(builder, builder.extract_element(value, ir.Constant(ir.IntType(32), 0)))


def negative(lanes: Lanes) -> Lanes:
    """Minus the lanes' absolute values."""
    builder, bits = lanes.builder, ir.VectorType(ir.IntType(32), LANES)
    sign = ir.Constant(bits, [-(1 << 31)] * LANES)
    return Lanes(builder, builder.bitcast(builder.or_(builder.bitcast(lanes.value, bits), sign), VECTOR))


@intrinsic
def prefetch_row(typing_context: Any, array: Any, row: Any) -> Any:
    """Start loading the cache line where ``array[row]`` begins; changes nothing.

    The lists of a tile point anywhere in the arrays of Gaussians. On scenes whose order has nothing to do with the
    image, asking for the next batch while one is blended takes a third off the time of blending.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        kind = signature.args[0]
        data = context.make_array(kind)(context, builder, arguments[0])
        index = context.cast(builder, arguments[1], signature.args[1], types.intp)
        pointer = cgutils.get_item_pointer2(
            context, builder, data.data,
            cgutils.unpack_tuple(builder, data.shape, kind.ndim),
            cgutils.unpack_tuple(builder, data.strides, kind.ndim),
            kind.layout, [index, *[context.get_constant(types.intp, 0)] * (kind.ndim - 1)], wraparound=False,
        )  # fmt: skip
        address, flag = ir.IntType(8).as_pointer(), ir.IntType(32)
        shape = ir.FunctionType(ir.VoidType(), [address, flag, flag, flag])
        function = builder.module.declare_intrinsic("llvm.prefetch", [address], shape)
        # 0: to read; 3: keep in all caches; 1: data
        builder.call(function, [builder.bitcast(pointer, address), flag(0), flag(3), flag(1)])
        return context.get_dummy_value()

    return types.void(array, row), generate
