"""Measure the bytes of a file of Gaussians without writing it."""

from __future__ import annotations

from collections.abc import Sequence

from gsmerge.io.formats.rows import MIP_COMMENT, RESULT_COMMENT
from gsmerge.io.formats.table import Contents, Format
from gsmerge.types import Cameras, Gaussians


def measure_bytes(file: Format, gaussians: Gaussians, cameras: Cameras, names: Sequence[str] = ()) -> int:
    """Return how many bytes a file with these Gaussians and cameras has, or an upper bound if it is a page."""
    comments = RESULT_COMMENT, MIP_COMMENT
    if file.measure is not None:
        return file.measure(gaussians, cameras, comments)
    assert file.encode is not None  # all other formats have a fixed number of bytes for each Gaussian
    contents = Contents([gaussians], comments, cameras if names else cameras[:0], names)
    # Most bytes of the camera that is written if the scene has none, unless it is written to a file beside
    placed_bytes = 700 * (file.first_view and not file.settings and not names)
    return len(file.encode(gaussians, contents)) + placed_bytes
