"""A Gaussian of a batch over the rows of a tile, sixteen pixels at a time: code that the blending kernels share.

A tile's state lives in one flat buffer of 16 x 16 planes, a batch of Gaussians in one of planes of ``BATCH`` numbers.
The weights are gsplat's: alpha clamped at 0.99, cut below 1/255, and a pixel stops before the Gaussian that would take
its transmittance to 1e-4 or below. Plane 0 of the state is the transmittance; its sign bit marks pixels that stopped.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np
from numba.core import cgutils, types
from numba.extending import intrinsic
from numpy import float32 as f4

from gsmerge.kernels.raster.lanes import FLOAT, LANES, Lanes, load, negative, store, vector
from gsmerge.kernels.raster.project import LN_CUT, TILE

BATCH = 32
PLANE = TILE * TILE
PLANES = 11  # of a batch: mean x and y, rate, slope, decay, ln opacity, first and last row, colour
MY, RATE, SLOPE, DECAY, LNOP, FIRST, LAST = (np.uint64(BATCH * plane) for plane in range(1, 8))  # mean x is at 0
COLOR = np.uint64(BATCH * 8)
MAX_ALPHA, MIN_TRANSMITTANCE = f4(0.99), f4(1e-4)

# exp(p) = poly(p)^8 on [ln(1/255), 0]: minimax of relative error 8e-8 for exp(p / 8), coefficients scaled by 8^-k.
E0, E1, E2 = f4(0.99999992), f4(0.12499907), f4(0.0078106653)
E3, E4, E5 = f4(3.2416797e-4), f4(9.7100983e-6), f4(1.7842896e-7)


class Share(NamedTuple):
    """Part of the light of sixteen pixels that a Gaussian takes."""

    alpha: Lanes
    weight: Lanes  # alpha times the transmittance; 0 where the pixel stops
    left: Lanes  # transmittance behind it; negative where the pixel stopped
    free: Any  # bits: alpha is not clamped
    goes: Any  # bits: the pixel does not stop here or before


def take_share(t: Lanes, p: Lanes) -> Share:
    """Compute the part that a Gaussian with exponents ``p`` takes of transmittances ``t``; any p <= 0 is safe."""
    e = E0 + p * (E1 + p * (E2 + p * (E3 + p * (E4 + p * E5))))
    e = e * e
    e = e * e
    e = e * e
    free = e.compare("<", MAX_ALPHA)
    alpha = e.where(free, MAX_ALPHA).where(p.compare(">=", LN_CUT), 0.0)
    weight = alpha * t
    left = t - weight
    goes = left.compare(">", MIN_TRANSMITTANCE)
    return Share(alpha, weight.where(goes, 0.0), left.where(goes, negative(t)), free, goes)


class Walk:
    """Gaussian ``j`` of a batch while code is generated; the first arguments are state, batch, j, y0 and y1."""

    def __init__(self, context: Any, builder: Any, signature: Any, arguments: Any) -> None:
        self.context, self.builder, self.signature, self.arguments = context, builder, signature, arguments
        self.columns = vector(builder, range(LANES))
        member = self.whole(2)
        numbers = (self.address(1, builder.add(member, self.index(BATCH * plane))) for plane in range(PLANES))
        self.mx, self.my, self.rate, self.slope, self.decay, self.lnop, _, _, *self.color = (
            Lanes(builder, builder.load(number)) for number in numbers
        )

    def index(self, number: int) -> Any:
        """A constant index."""
        return self.context.get_constant(types.intp, number)

    def whole(self, position: int) -> Any:
        """Return an argument as an index."""
        return self.context.cast(self.builder, self.arguments[position], self.signature.args[position], types.intp)

    def address(self, position: int, *indices: Any) -> Any:
        """Return the address of an element of an array among the arguments."""
        kind = self.signature.args[position]
        array = self.context.make_array(kind)(self.context, self.builder, self.arguments[position])
        return cgutils.get_item_pointer(self.context, self.builder, kind, array, indices, wraparound=False)

    @contextmanager
    def rows(self, num_planes: int) -> Iterator[tuple[list[Any], Lanes, Lanes]]:
        """Loop over rows y0 to y1: addresses of the row in the state's planes, distance from the mean, exponents."""
        builder, one = self.builder, self.index(1)
        first, end = self.whole(3), builder.add(self.whole(4), one)
        with cgutils.for_range_slice(builder, first, end, one, first.type, inc=True) as (y, _):
            start = builder.mul(y, self.index(TILE))
            planes = [self.address(0, builder.add(start, self.index(PLANE * plane))) for plane in range(num_planes)]
            dy = Lanes(builder, builder.sitofp(y, FLOAT)) - self.my
            d = self.rate * self.columns - self.rate * (self.mx + self.slope * dy)
            yield planes, dy, (self.lnop - self.decay * dy * dy) - d * d


@intrinsic
def blend_rows(typing_context: Any, state: Any, batch: Any, j: Any, y0: Any, y1: Any) -> Any:
    """Blend Gaussian j of a batch over rows y0 to y1 of a tile; planes 1 to 3 collect the colour."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        walk = Walk(context, builder, signature, arguments)
        with walk.rows(4) as (planes, _, p):
            share = take_share(load(builder, planes[0]), p)
            store(share.left, planes[0])
            for plane, channel in zip(planes[1:], walk.color, strict=True):
                store(load(builder, plane) + share.weight * channel, plane)
        return context.get_dummy_value()

    return types.void(state, batch, j, y0, y1), generate


@intrinsic
def weigh_rows(typing_context: Any, state: Any, batch: Any, j: Any, y0: Any, y1: Any) -> Any:
    """Blend Gaussian j of a batch over rows y0 to y1 of a tile; plane 1 receives its weights."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        with Walk(context, builder, signature, arguments).rows(2) as (planes, _, p):
            share = take_share(load(builder, planes[0]), p)
            store(share.left, planes[0])
            store(share.weight, planes[1])
        return context.get_dummy_value()

    return types.void(state, batch, j, y0, y1), generate
