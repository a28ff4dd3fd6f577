"""Warn if a format's rounding of positions moves Gaussians so far that renders change visibly."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from gsmerge.arrays import distinct
from gsmerge.geometry.transforms import medians
from gsmerge.io.formats.read_gaussians import read_gaussians
from gsmerge.io.formats.table import PLY, output_format
from gsmerge.io.formats.write import limit_notes, write_gaussians
from gsmerge.types import Gaussians, StrPath

# Limit of the mean square of the distances by which rounding moves Gaussians. Above the limit, renders change visibly;
# at the limit, a PSNR of 27 dB drops by .05 dB. A distance is divided by the Gaussian's size, and a quotient above 1
# counts as 1. In scenes around the origin, the mean square is at most a tenth of the limit.
VISIBLE_MEAN_SQUARE = 0.005
ROUNDING_GAUSSIANS = 1 << 17  # number of Gaussians from which the mean is estimated


def format_notes(path: StrPath, gaussians: Gaussians) -> list[str]:
    """Note what a path's format leaves out, and how far its rounding moves Gaussians; raise UsageError without one."""
    return limit_notes(path, gaussians.sh_degree, len(gaussians)) + rounding_notes(path, gaussians)


def rounding_notes(path: StrPath, gaussians: Gaussians) -> list[str]:
    """Note how far a format's rounding of positions moves Gaussians; no notes if renders do not change visibly."""
    if len(gaussians) == 0:
        return []
    format_, columns = output_format(path), gaussians.numpy()
    # The sample includes the Gaussians at the least and largest positions, by which formats choose the steps of
    # rounding
    extremes = columns.means.argmin(axis=0), columns.means.argmax(axis=0)
    rows = distinct(np.concatenate([np.arange(0, len(gaussians), len(gaussians) // ROUNDING_GAUSSIANS + 1), *extremes]))
    means, scales = columns.means.take(rows, axis=0).astype(np.float64), columns.scales.take(rows, axis=0)
    sizes = np.sort(scales, axis=1)[:, 1]  # a Gaussian is as large as its second largest scale
    with np.errstate(over="ignore"):
        moves = np.abs(format_.round_means(means) - means).max(axis=1)
    mean_square = float(np.square(np.minimum(moves / np.maximum(sizes, 1e-30), 1)).mean())
    if mean_square <= VISIBLE_MEAN_SQUARE:
        return []
    center = medians(means)
    shift = ",".join(f"{-float(f'{coordinate:.3g}'):.0f}" for coordinate in center)
    remedy = f"move the input and its cameras near the origin first, with gsmerge convert --translate={shift}"
    if np.abs(center).max() < np.abs(means - center).max():  # the scene is wider than its distance from the origin
        remedy = ("" if format_.round_means is PLY.round_means else "write a .ply, or ") + "crop far Gaussians"
    problem = f"positions so far from the origin lose digits in {format_.ending}"
    return [f"{problem}, and Gaussians move by about {100 * mean_square**0.5:.0f} % of their size; {remedy}"]


def round_as_written(path: StrPath, gaussians: Gaussians) -> Gaussians:
    """Return Gaussians as they are after writing and reading a file in the format of ``path``.

    Gaussians are written to a temporary file and read from it. If the format cannot be read, only positions are
    rounded. If the rounding of positions is invisible in renders, Gaussians are returned unchanged.
    """
    if not rounding_notes(path, gaussians):
        return gaussians
    format_ = output_format(path)
    if format_.read is None:
        return replace(gaussians, means=format_.round_means(gaussians.numpy().means.astype(np.float64)))
    with TemporaryDirectory() as folder:
        write_gaussians(Path(folder) / f"a{format_.ending}", gaussians)
        return read_gaussians(Path(folder) / f"a{format_.ending}").gaussians
