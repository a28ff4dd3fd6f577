"""Efforts: the settings of the stages that a name such as "draft" stands for."""

from __future__ import annotations

from gsmerge.frozen import dataclass
from gsmerge.method.geometry.views import REPORT_VIEWS
from gsmerge.settings.fit import STEPS


@dataclass(frozen=True)
class Effort:
    """Settings of the stages that an effort such as "draft" stands for."""

    steps: int  # Steps of the full fit
    rectangles: float  # Rectangles per superpixel of `rdseg`
    early_sweeps: int  # Sweeps of `rdseg` before rectangles are merged
    merges: bool = True  # Merge Gaussians of different views
    refines: bool = True  # With `checkpoint="auto"`, run all networks, not only the heads
    prunes: bool = True  # Without a fit, leave out Gaussians that no photo shows
    fits_alone: bool = True  # Fit scenes without cameras, to views that gsmerge places
    large_photos: bool = True  # With `photo_scale="auto"`, allow photos larger than the views
    report_views: int = REPORT_VIEWS  # Number of views for scores that only the report needs


EFFORTS = {
    "draft": Effort(
        44, 1.0, 0, merges=False, refines=False, prunes=False, fits_alone=False, large_photos=False, report_views=3
    ),
    "fast": Effort(72, 1.0, 0, refines=False, large_photos=False),
    "default": Effort(STEPS, 2.0, 0),
    "best": Effort(900, 3.0, 1),
}
