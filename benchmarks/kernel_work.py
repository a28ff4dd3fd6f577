"""Operations and bytes of each kernel, counted in its source: a part of limit.py.

A slot is one instruction in one lane of a vector: an add, a multiplication, a comparison, a selection, a minimum, a
rounding or a bitwise operation, or a multiply-add, which is two operations in one slot. A division or a square root
takes as many slots as the machine makes multiply-adds in its time. Loads, stores, shuffles, addresses and loops are not
counted: an ideal processor does them beside. Bytes are those that have to come or go once for each call: a tile's
planes and a block's planes stay in the first cache.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

FLOAT, ROW = 4, 14 * 4  # bytes of a number, and of a row of the optimiser's state
# Bytes of a Gaussian's mean, quaternion, scales and opacity; of its conic with its colour; and of a row of slots
SPLAT, CONIC, SLOT = 11 * FLOAT, (8 + 3) * FLOAT, 9 * FLOAT


@dataclass(frozen=True)
class Cost:
    """What a kernel does for each unit of a count."""

    kernel: str
    unit: str  # A count of a step; "pair" is a visited or a needed pair
    plain: float  # Slots with one operation
    fused: float  # Multiply-adds
    divisions: float  # Divisions and square roots
    bytes: float
    why: str

    def slots(self, division: float) -> float:
        return self.plain + self.fused + division * self.divisions

    def operations(self, division: float) -> float:
        return self.plain + 2 * self.fused + 2 * division * self.divisions


NARROW = "transpose of the conic, narrow_rows: two axes of the ellipse, their ends, whole numbers"
TRACE = "trace: base and top of sixteen rows, and the columns of a row"
COSTS = (
    Cost("cull", "n", 42, 12, 3, 7 * FLOAT, "depth, two coordinates and their limits, two reaches, seven comparisons"),
    Cost("cull", "num_visible", 0, 0, 0, FLOAT, "its id"),
    Cost("project", "num_visible", 134, 63, 9, FLOAT + SPLAT + 8 * FLOAT + FLOAT + 8 + 6 * FLOAT,
         "position 12, Jacobian 26, rotation 34, two half axes 24, covariance 22, logarithm 20, box 41, conic 18"),
    Cost("bin", "num_visible", 0, 0, 0, 4 + 4 + 8 + 3 * 16 + 12 + 20 + 12,
         "sort: keys, three passes that read and write them, order; boxes in that order; dealt. Scalar: bytes alone"),
    Cost("bin", "listed", 0, 0, 0, FLOAT, "its place in a tile's list"),
    Cost("blend", "pair", 13, 9, 0, 0,
         "exponent 2, exp: polynomial 5, squares 3, cut and clamp 3; share of the light 6, three colours"),
    Cost("blend", "walked", 70, 10, 8, 0, NARROW),
    Cost("blend", "shown", 64, 32, 0, 0, TRACE),
    Cost("blend", "listed", 0, 0, 0, FLOAT, "its row"),
    Cost("blend", "num_visible", 0, 0, 0, CONIC, "conic and colour"),
    Cost("blend", "pixels", 1, 3, 0, 4 * FLOAT, "background; image and transmittance"),
    Cost("loss", "pixels", 375, 37.5, 3, 10 * FLOAT,
         "three values: means over windows 21, SSIM's derivatives 56, their means 10, gradient 32, edges 19"),
    Cost("backward", "pair", 25, 12, 1, 0,
         "alpha and share of the light as in blend, 20; g.c 3, what is left behind 5, six sums 9"),
    Cost("backward", "walked", 70, 10, 8, 0, NARROW),
    Cost("backward", "shown", 264, 32, 0, 0, TRACE + "; add_columns: moments with x, sums of nine vectors"),
    Cost("backward", "listed", 0, 0, 0, FLOAT + SLOT, "its row; its slot"),
    Cost("backward", "num_visible", 0, 0, 0, CONIC, "conic and colour"),
    Cost("backward", "pixels", 1, 3, 0, 6 * FLOAT, "g.C; image and gradient"),
    Cost("gather_slots", "listed", 9, 0, 0, FLOAT + SLOT, "its row, its slot"),
    Cost("gather_slots", "num_visible", 0, 0, 0, 2 * SLOT, "sums, zeroed and written"),
    Cost("project_backward", "num_visible", 213, 134, 6, FLOAT + SPLAT + SLOT + SPLAT,
         "position and Jacobian 34, rotation and half axes 62, conic 55, scales 33, quaternion 58, mean 70, pose 30"),
    Cost("adam", "num_visible", 809, 96, 37, 4 * ROW + 3 * ROW + 5 * FLOAT + 4 * FLOAT + ROW + ROW,
         "a row is sixteen lanes: moments and step 27 each with root and division, box 24; four exponentials 80"),
)  # fmt: skip
KERNELS = tuple(dict.fromkeys(cost.kernel for cost in COSTS))
OF_LISTS = "walked", "shown", "listed"  # units of tile lists, which the task itself does not ask for


@dataclass(frozen=True)
class Work:
    """Slots, operations and bytes."""

    slots: float
    operations: float
    bytes: float


def work_of(kernel: str, counts: Mapping[str, float], *, needed: bool, division: float) -> Work:
    """Return the work of a kernel at the counts of a step: of the task alone (``needed``), or of this algorithm."""
    slots = operations = num_bytes = 0.0
    for cost in COSTS:
        if cost.kernel != kernel or (needed and cost.unit in OF_LISTS):
            continue
        count = counts["needed" if needed else "visited"] if cost.unit == "pair" else counts[cost.unit]
        slots += count * cost.slots(division)
        operations += count * cost.operations(division)
        num_bytes += count * cost.bytes
    return Work(slots, operations, num_bytes)
