"""Rows of colours in registers: sixteen triples weighed, or spread, at once, and a square of numbers turned over.

Loops over triples with a stride of three, and loops that turn rows into planes, LLVM's vectoriser leaves scalar.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from llvmlite import ir  # type: ignore[import-untyped]
from numba.core import cgutils, types
from numba.extending import intrinsic

from gsmerge.kernels.raster.lanes import LANES, Lanes, load, mask, store

TRIPLES = 3 * LANES  # numbers of sixteen triples


def _addresses(context: Any, builder: Any, signature: Any, arguments: Any, array: int, at: int, step: Any) -> list[Any]:
    """Addresses of a flat array: from one index on, a step apart."""
    kind = signature.args[array]
    made = context.make_array(kind)(context, builder, arguments[array])
    index = context.cast(builder, arguments[at], signature.args[at], types.intp)
    steps = context.get_constant(types.intp, step) if isinstance(step, int) else step
    pointers = []
    for _ in range(LANES):
        pointers.append(cgutils.get_item_pointer(context, builder, kind, made, [index], wraparound=False))
        index = builder.add(index, steps)
    return pointers


def _picked(vectors: Sequence[Lanes], lanes: Sequence[int]) -> Lanes:
    """Lanes of three vectors in a row, by their numbers from 0 to 47."""
    builder, (first, second, third) = vectors[0].builder, (vector.value for vector in vectors)
    early = builder.shuffle_vector(first, second, mask([lane % (2 * LANES) for lane in lanes]))
    late = mask([i if lane < 2 * LANES else lane - LANES for i, lane in enumerate(lanes)])
    return Lanes(builder, builder.shuffle_vector(early, third, late))


@intrinsic
def weigh_triples(
    typing_context: Any, rows: Any, at: Any, red: Any, green: Any, blue: Any, out: Any, to: Any
) -> Any:  # fmt: skip
    """``out[to + q] = red rows[at + 3 q] + green rows[at + 3 q + 1] + blue rows[at + 3 q + 2]``, q from 0 to 15."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        source = _addresses(context, builder, signature, arguments, 0, 1, LANES)[:3]
        (target, *_) = _addresses(context, builder, signature, arguments, 5, 6, LANES)
        vectors = [load(builder, address) for address in source]
        r, g, b = (Lanes(builder, arguments[i]) for i in (2, 3, 4))
        reds, greens, blues = (_picked(vectors, range(c, TRIPLES, 3)) for c in range(3))
        store(r * reds + g * greens + b * blues, target)
        return context.get_dummy_value()

    return types.void(rows, at, red, green, blue, out, to), generate


@intrinsic
def spread_triples(
    typing_context: Any, weights: Any, at: Any, red: Any, green: Any, blue: Any, out: Any, to: Any
) -> Any:  # fmt: skip
    """``out[to + 3 q + c] = weights[at + q]`` times red, green or blue, q from 0 to 15."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        (source, *_) = _addresses(context, builder, signature, arguments, 0, 1, LANES)
        targets = _addresses(context, builder, signature, arguments, 5, 6, LANES)[:3]
        values = load(builder, source).value
        color = ir.Constant(values.type, ir.Undefined)
        for c in range(3):
            color = builder.insert_element(color, arguments[2 + c], ir.Constant(ir.IntType(32), c))
        for part, target in enumerate(targets):
            lanes = range(part * LANES, (part + 1) * LANES)
            weight = builder.shuffle_vector(values, values, mask([lane // 3 for lane in lanes]))
            tint = builder.shuffle_vector(color, color, mask([lane % 3 for lane in lanes]))
            store(Lanes(builder, weight) * Lanes(builder, tint), target)
        return context.get_dummy_value()

    return types.void(weights, at, red, green, blue, out, to), generate


@intrinsic
def turn(typing_context: Any, rows: Any, at: Any, step: Any, out: Any, to: Any, out_step: Any) -> Any:
    """``out[to + out_step q + i] = rows[at + step i + q]``, q and i from 0 to 15."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        steps = [context.cast(builder, arguments[i], signature.args[i], types.intp) for i in (2, 5)]
        source = _addresses(context, builder, signature, arguments, 0, 1, steps[0])
        vectors = [load(builder, address).value for address in source]
        half = LANES // 2
        while half:
            # exchange the upper half of every group of lanes of one row with the lower half of its partner's
            low = mask([lane if not lane & half else LANES + (lane ^ half) for lane in range(LANES)])
            high = mask([lane ^ half if not lane & half else LANES + lane for lane in range(LANES)])
            vectors = [
                builder.shuffle_vector(vectors[i & ~half], vectors[i | half], high if i & half else low)
                for i in range(LANES)
            ]
            half //= 2
        targets = _addresses(context, builder, signature, arguments, 3, 4, steps[1])
        for vector, target in zip(vectors, targets, strict=True):
            store(Lanes(builder, vector), target)
        return context.get_dummy_value()

    return types.void(rows, at, step, out, to, out_step), generate
