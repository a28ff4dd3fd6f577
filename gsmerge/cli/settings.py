"""What the library would refuse, told as wrong usage."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from gsmerge.errors import UsageError

if TYPE_CHECKING:
    from gsmerge.segment import SegmentOptions


def superpixels_per_view(options: SegmentOptions, width: int, height: int) -> int:
    """Superpixels that each view will get.

    Raises:
        UsageError: If there are more than pixels.
    """
    from gsmerge.segment import count_for

    count = count_for(options, height, width)
    if count > width * height:
        raise UsageError(
            f"--superpixels: expected at most {width * height}, one per pixel of {width} x {height}, got {count}"
        )
    return count


@contextmanager
def told_as_usage() -> Iterator[None]:
    """Settings that the library refuses are wrong usage of the command."""
    try:
        yield
    except ValueError as error:
        raise UsageError(str(error)) from error
