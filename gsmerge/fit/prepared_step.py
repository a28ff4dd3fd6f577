"""Steps of the fit as few calls: buffers stay, and arguments are checked once.

The same bits as :meth:`gsmerge.fit.steps.Optimiser.step` takes by single calls, which stay for what is not prepared
here: cameras that move, Gaussians that are fixed, harmonics, and views in which most Gaussians are hidden.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from gsmerge.fit.fit_state import FitState
from gsmerge.kernels.raster import image_loss
from gsmerge.kernels.raster.project import CAMERA, CONIC, SUMS, TILE
from gsmerge.kernels.raster.step import PHASES, PIECE, STEP, fit_phase
from gsmerge.kernels.signature import FilledTable
from gsmerge.raster.tiled_view import MANY, MANY_EACH, cache_line_rows
from gsmerge.runtime.threads import parallel_map

SPARE = 1.25  # times the intersections of a view for which there is no room yet
OF_STATE = ("x", "x0", "m", "v", "units", "box_shares", "min_sizes", "colors")
OF_SPLATS = ("means", "quats", "scales", "opacities")
OF_STEP = {"camera": CAMERA, "background": 3, "loss_weights": 2, "rates": 14, "limits": 5, "betas": 2, "regs": 2}


def is_prepared(state: FitState) -> bool:
    """Return whether prepared steps are possible for a state."""
    return len(state.x) > 0 and state.splats.shN.shape[1] == 0 and not state.fixed.any()


@dataclass(eq=False)
class StepTables:
    """Buffers for the steps of a state, with a filled table for each size of the photos."""

    state: FitState
    threads: int
    gaussians: dict[str, np.ndarray] = field(default_factory=dict)  # buffers over Gaussians, and those of a step
    room: dict[str, np.ndarray] = field(default_factory=dict)  # buffers over intersections
    tables: dict[tuple[int, int], tuple[FilledTable, list[Callable[[], None]]]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        n = len(self.state.x)
        widths = {"tints": 3, "sums": SUMS, "g_means": 3, "g_quats": 4, "g_scales": 3, "g_colors": 3}
        self.gaussians |= {name: np.empty((n, width), np.float32) for name, width in widths.items()}
        self.gaussians |= {name: np.empty(n, np.float32) for name in ("depths", "g_opacities")}
        self.gaussians |= {name: np.empty((n, 4), np.int16) for name in ("boxes", "ordered_boxes")}
        self.gaussians |= {name: np.empty(n, np.int32) for name in ("ids", "order")}
        self.gaussians |= {name: np.empty(n, np.uint64) for name in ("keys", "spare")}
        self.gaussians |= {name: np.zeros(size, np.float32) for name, size in OF_STEP.items()}
        self.gaussians |= {"conics": cache_line_rows(n, CONIC), "num_kept": np.empty(-(-n // PIECE), np.int64)}
        self.gaussians |= {name: getattr(self.state, name) for name in OF_STATE}
        self.gaussians |= {name: getattr(self.state.splats, name) for name in OF_SPLATS}
        self._make_room(1)

    def _make_room(self, count: int) -> None:
        """Allocate buffers for ``count`` intersections; tables with the old buffers are dropped."""
        self.tables.clear()
        self.room = {"flatten_ids": np.empty(count, np.int32), "slots": np.empty((count, SUMS), np.float32)}

    def _table(self, photo: np.ndarray, weight: np.ndarray, drawn: np.ndarray) -> FilledTable:
        """Return the table for the size of a photo, filled with the photo, its weights and the drawn opacities."""
        height, width = weight.shape
        if weight.shape not in self.tables:
            columns, lines, line = -(-width // TILE), -(-height // TILE), image_loss.room_of(width)
            spans, tiles, corners = 2 * self.threads, columns * lines, (columns + 1) * (lines + 1)
            shapes: dict[str, tuple[int, ...]] = {
                "image": (height, width, 3), "gradient": (height, width, 3), "transmittance": (height, width),
                "errors": (height,), "terms": (self.threads, image_loss.ROWS, image_loss.TERMS, line),
                "rows": (self.threads, image_loss.EDGE_ROWS, line),
            }  # fmt: skip
            pictures = {name: np.empty(shape, np.float32) for name, shape in shapes.items()}
            counts = {"corners": (spans, corners), "counts": (spans, tiles), "offsets": (tiles + 1,)}
            lists = {name: np.empty(shape, np.int64) for name, shape in counts.items()}
            of_step = {"photo": photo, "weight": weight, "drawn": drawn}
            table = STEP.fill(self.gaussians | self.room | pictures | lists | of_step)
            calls = [fit_phase.prepare(table.values, phase) for phase in range(len(PHASES))]
            self.tables[weight.shape] = table, calls
        table = self.tables[weight.shape][0]
        for name, array in (("photo", photo), ("weight", weight), ("drawn", drawn)):
            table.point(name, array)
        return table

    def take(
        self, number: int, photo: np.ndarray, weight: np.ndarray, drawn: np.ndarray, numbers: dict[str, np.ndarray]
    ) -> float | None:
        """Take step ``number`` on a photo ``[h,w,3]`` with weights ``[h,w]`` and return the sum of squared errors.

        ``drawn [n]`` are the opacities to draw; ``numbers``: camera, background, and the constants of loss and
        optimiser. Returns None and changes nothing if the view has so many intersections that lists must be cut.
        """
        for name, values in numbers.items():
            self.gaussians[name][:] = values
        table = self._table(photo, weight, drawn)
        table["failed"], table["step"] = 0, number
        self._run(weight.shape, PHASES[:3])
        count = table["num_intersections"]
        if count > max(MANY, MANY_EACH * table["num_visible"]):
            return None
        if count > len(self.room["flatten_ids"]):
            self._make_room(int(SPARE * count))
            return self.take(number, photo, weight, drawn, numbers)
        self._run(weight.shape, PHASES[3:])
        return float(table.arrays["errors"].sum(dtype=np.float64))

    def _run(self, size: tuple[int, int], phases: tuple[str, ...]) -> None:
        calls = self.tables[size][1]
        for phase in phases:
            parallel_map(lambda call: call(), [calls[PHASES.index(phase)]] * self.threads)
