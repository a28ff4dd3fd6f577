"""Limits on the number of Gaussians, by which views are cut into superpixels."""

from __future__ import annotations

from gsmerge.errors import UsageError
from gsmerge.frozen import dataclass
from gsmerge.settings.stages import SegmentOptions


@dataclass(frozen=True)
class CountLimits:
    """Limits on the number of Gaussians that follow from the options."""

    per_view: int  # Superpixels of each view that the options ask for
    default: int  # Gaussians that `superpixels` and K give
    min_count: int  # Least number of Gaussians of a result: one for each view
    max_count: int  # Largest number of Gaussians that a budget, a size or a device allows
    exact: int | None  # Gaussians that a budget or a size requests; None if neither is given
    num_pixels: int  # Pixels of all views
    num_input: int  # Gaussians of the scene
    most: int  # Useful number of Gaussians; if it is unknown, all Gaussians of the scene

    @property
    def count(self) -> int | None:
        """Number of Gaussians that a budget, a size or a device sets; None if ``superpixels`` and K decide it."""
        if self.exact is not None:
            return self.exact
        return self.max_count if self.default > self.max_count else None

    @property
    def share(self) -> float:
        """Gaussians per pixel."""
        return (self.count or self.default) / max(1, self.num_pixels)


def count_for(options: SegmentOptions, height: int, width: int) -> int:
    """Return the number of superpixels of a view of ``height`` x ``width`` pixels; UsageError if these are too few."""
    if options.per_view is not None:
        if options.per_view > height * width:
            limit = f"{height * width}, one per pixel of {width} x {height}"
            raise UsageError(f"superpixels: expected at most {limit}, got {options.per_view}")
        return options.per_view
    return max(1, int(options.share * height * width))
