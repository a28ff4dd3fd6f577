"""What a file keeps of positions, where rounding moves Gaussians so far that pictures show it."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from gsmerge.io.formats.read import read_gaussians
from gsmerge.io.formats.table import PLY, output_format
from gsmerge.io.formats.write import write_gaussians
from gsmerge.types import Gaussians, StrPath

# Mean square of what Gaussians are moved by in units of their size, at most 1 each, from which pictures show it: .05 dB
# of 27. In scenes around their origin it is a tenth of that and less.
SHOWN = 0.005
SAMPLE = 1 << 17  # Gaussians that are enough to tell


def rounding_notes(path: StrPath, gaussians: Gaussians) -> list[str]:
    """Describe how far a file's rounding moves Gaussians, and the remedy; empty where pictures do not show it."""
    chosen = output_format(path, levels=True, cameras=True)
    if len(gaussians) == 0:
        return []
    columns, step = gaussians.numpy(), len(gaussians) // SAMPLE + 1
    ends = columns.means.argmin(axis=0), columns.means.argmax(axis=0)  # which formats scale by
    rows = np.unique(np.concatenate([np.arange(0, len(columns), step), *ends]))
    means, sizes = columns.means[rows].astype(np.float64), np.median(columns.scales[rows], axis=1)
    with np.errstate(over="ignore"):
        moves = np.abs(chosen.round_means(means) - means).max(axis=1)
    moved = float(np.square(np.minimum(moves / np.maximum(sizes, 1e-30), 1)).mean())
    if moved <= SHOWN:
        return []
    middle = np.median(means, axis=0)
    shift = ",".join(f"{-float(f'{value:.3g}'):.0f}" for value in middle)
    remedy = f"move the input and its cameras near the origin first: gsmerge convert --translate={shift}"
    if np.abs(middle).max() < np.abs(means - middle).max():  # some are farther from the others than these from it
        remedy = ("" if chosen.round_means is PLY.round_means else "write a .ply, or ") + "crop what is far away"
    lost = f"positions lose digits in {chosen.ending} so far from the origin"
    return [f"{lost}: Gaussians move by some {100 * moved**0.5:.0f} % of their size; {remedy}"]


def as_written(path: StrPath, gaussians: Gaussians) -> Gaussians:
    """Return Gaussians as a file of this name keeps them, read back; as they are where rounding is not shown."""
    if not rounding_notes(path, gaussians):
        return gaussians
    chosen = output_format(path, levels=True, cameras=True)
    name = f"a{chosen.kept_as or chosen.ending}"
    with TemporaryDirectory() as folder:
        write_gaussians(Path(folder) / name, gaussians)
        return read_gaussians(Path(folder) / name).gaussians
