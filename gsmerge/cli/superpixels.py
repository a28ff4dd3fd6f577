"""Segmentation options from the command line, checked against the pictures' size."""

from __future__ import annotations

from typing import TYPE_CHECKING

from gsmerge.errors import UsageError

if TYPE_CHECKING:
    from gsmerge.segment import SegmentOptions


def superpixels_per_view(options: SegmentOptions, width: int, height: int) -> int:
    """Superpixels that each view will get.

    Raises:
        UsageError: If there are more than pixels, or none.
    """
    from gsmerge.segment import count_for

    try:
        return count_for(options, height, width)
    except ValueError as error:
        raise UsageError(str(error)) from error
