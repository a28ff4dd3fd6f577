"""Take the steps of a fit with few calls of the native library, in buffers that many steps share.

Memory is allocated and arguments are checked once for many steps. Tests compare the steps of this module, bit by bit,
with steps that are taken by single calls of the kernels.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from gsmerge.method.fit.fit_state import FitState
from gsmerge.method.kernels.raster import step as kernels
from gsmerge.method.kernels.raster.project import BLOCK, CAMERA, CONIC, POSE, SUMS, TILE
from gsmerge.method.kernels.raster.step import PHASES, STEP, THREAD_GAUSSIANS, fit_phase
from gsmerge.method.kernels.signature import FilledTable
from gsmerge.method.raster.gradient import viewmat_gradient
from gsmerge.method.raster.tiled_view import cache_line_rows, hides_most
from gsmerge.runtime.threads import parallel_map

# The native library reads a table of arrays by name. OF_STATE has names of arrays of a fit's state, and OF_SPLATS has
# names of arrays of the state's splats
OF_STATE = ("x", "x0", "m", "v", "units", "box_shares", "min_sizes", "colors")
OF_SPLATS = ("means", "quats", "scales", "opacities", "sh0", "shN")
# Arrays whose values each step sets, and the lengths of these arrays
OF_STEP = {
    "camera": CAMERA, "eye": 3, "background": 3, "loss_weights": 2, "rates": 14, "limits": 5, "betas": 2, "regs": 2,
}  # fmt: skip


@dataclass(eq=False)
class StepBuffers:
    """Buffers for the steps of one state, and tables of their addresses for the native library."""

    state: FitState
    threads: int
    moves_camera: bool = False  # True if steps compute the gradient of the viewmat
    gaussians: dict[str, np.ndarray] = field(default_factory=dict)  # Arrays with a row for each Gaussian, and OF_STEP
    room: dict[str, np.ndarray] = field(default_factory=dict)  # Arrays with a row for each intersection with a tile
    # Size of the photo -> its table, and a function for each phase of a step that calls the library with the table
    tables: dict[tuple[int, int], tuple[FilledTable, list[Callable[[], None]]]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Allocate arrays whose sizes depend on the number of Gaussians, and use the arrays of the state."""
        n = len(self.state.x)
        widths = {"tints": 3, "sums": SUMS, "g_means": 3, "g_quats": 4, "g_scales": 3, "g_colors": 3}
        self.gaussians |= {name: np.empty((n, width), np.float32) for name, width in widths.items()}
        self.gaussians |= {name: np.empty(n, np.float32) for name in ("depths", "g_opacities")}
        self.gaussians |= {name: np.empty((n, 4), np.int16) for name in ("boxes", "ordered_boxes")}
        self.gaussians |= {name: np.empty(n, np.int32) for name in ("ids", "order")}
        self.gaussians |= {name: np.empty(n, np.uint64) for name in ("keys", "spare")}
        self.gaussians |= {name: np.zeros(size, np.float32) for name, size in OF_STEP.items()}
        self.gaussians |= {
            "conics": cache_line_rows(n, CONIC),
            "num_kept": np.empty(-(-n // THREAD_GAUSSIANS), np.int64),
        }
        self.gaussians |= {"g_poses": np.empty((-(-n // BLOCK) * self.moves_camera, POSE), np.float32)}
        self.gaussians |= {"fixed": self.state.fixed.view(np.uint8)}
        self.gaussians |= {name: getattr(self.state, name) for name in OF_STATE}
        self.gaussians |= {name: getattr(self.state.splats, name) for name in OF_SPLATS}
        self._allocate_intersections(1)

    def take_step(
        self, number: int, photo: np.ndarray, weight: np.ndarray, drawn: np.ndarray, numbers: dict[str, np.ndarray]
    ) -> tuple[float, np.ndarray | None]:
        """Take step ``number`` on a photo ``[h,w,3]`` whose pixels weigh ``weight [h,w]``, and update the state.

        Args:
            drawn: ``[n]`` float32, the opacities to draw.
            numbers: Values of the arrays of ``OF_STEP``: camera, its centre, background, constants of loss and Adam.

        Returns:
            The sum of squared errors, and the gradient ``[4,4]`` of the viewmat, or None if the camera does not move.
        """
        self.state.update_harmonics()
        for name, values in numbers.items():
            self.gaussians[name][:] = values
        table = self._fill_table(photo, weight, drawn)
        table["failed"] = 0
        table["step"] = number
        self._run_phases(weight.shape, "cull", "project", "count")
        is_open = hides_most(table["num_intersections"], table["num_visible"])
        if is_open:  # many Gaussians are hidden, so the list of each tile ends where the tile is opaque
            self._run_phases(weight.shape, "count_open")
        if table["num_intersections"] > len(self.room["flatten_ids"]):
            room_factor = 1.25  # room for more intersections than this view has, so that few views need new buffers
            self._allocate_intersections(int(room_factor * table["num_intersections"]))
            return self.take_step(number, photo, weight, drawn, numbers)
        self._run_phases(weight.shape, "deal_open" if is_open else "deal", "blend", "loss", "backward", "update")
        error = float(table.arrays["errors"].sum(dtype=np.float64))
        if not self.moves_camera:
            return error, None
        poses = self.gaussians["g_poses"][: -(-table["num_visible"] // BLOCK)]
        return error, viewmat_gradient(poses, self.state.splats.origin)

    def _allocate_intersections(self, count: int) -> None:
        """Allocate buffers for ``count`` intersections, and drop the tables, which point to the old buffers."""
        self.tables.clear()
        self.room = {"flatten_ids": np.empty(count, np.int32), "slots": np.empty((count, SUMS), np.float32)}

    def _fill_table(self, photo: np.ndarray, weight: np.ndarray, drawn: np.ndarray) -> FilledTable:
        """Return the table for photos of this size, with the addresses of photo, weights and drawn opacities."""
        of_step = {"photo": photo, "weight": weight, "drawn": drawn}
        if weight.shape not in self.tables:
            height, width = weight.shape
            columns = -(-width // TILE)
            lines = -(-height // TILE)
            line = kernels.room_of(width)
            spans = 2 * self.threads
            tiles = columns * lines
            corners = (columns + 1) * (lines + 1)
            shapes: dict[str, tuple[int, ...]] = {
                "image": (height, width, 3), "gradient": (height, width, 3), "transmittance": (height, width),
                "errors": (height,), "terms": (self.threads, kernels.DERIVATIVE_ROWS, kernels.TERMS, line),
                "rows": (self.threads, kernels.EDGE_ROWS, line), "light": (tiles,),
            }  # fmt: skip
            counts = {"corners": (spans, corners), "counts": (spans, tiles), "offsets": (tiles + 1,)}
            arrays = {name: np.empty(shape, np.float32) for name, shape in shapes.items()}
            arrays |= {name: np.empty(shape, np.int64) for name, shape in counts.items()}
            table = FilledTable(STEP, self.gaussians | self.room | arrays | of_step)
            calls = [fit_phase.prepare(table.values, phase) for phase in range(len(PHASES))]
            self.tables[weight.shape] = table, calls
        table = self.tables[weight.shape][0]
        for name, array in of_step.items():
            table.point(name, array)
        return table

    def _run_phases(self, size: tuple[int, int], *phases: str) -> None:
        """Run ``phases`` of a step one after the other, each on all threads, with the table for photos of ``size``."""
        calls = self.tables[size][1]
        for phase in phases:
            parallel_map(lambda call: call(), [calls[PHASES.index(phase)]] * self.threads)
