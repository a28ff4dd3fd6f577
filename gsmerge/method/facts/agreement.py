"""Shares of a scene's depth that other views confirm, and what follows from them."""

from __future__ import annotations

import math

from gsmerge.frozen import dataclass, field
from gsmerge.settings.budget import parse_share
from gsmerge.settings.stages import SHARE

CONFIRM_PIXELS = 1200  # sampled pixels of a view
# A result is expected to be poor if the share of confirmed pixels is below POOR_SHARE. POOR_SHARE separates the poor
# results of 15 captures from the sound results. If the share of pixels that no other view sees is above LONELY_SHARE, a
# poor result is blamed on too few views
POOR_SHARE = 0.5
LONELY_SHARE = 0.2
# Chance may change a share by CHANCE_ERRORS standard errors. Fewer samples than NORMAL_SAMPLES decide nothing
CHANCE_ERRORS = 2.0
NORMAL_SAMPLES = 30
# The useful number of Gaussians per pixel is MOST_PER_PIXEL if at least SOUND_SHARE of the pixels are confirmed, and
# FEWEST, the usual number, if at most WRONG_SHARE are confirmed. With more Gaussians than are useful, a fit memorises
# the photos (docs/guide/compact.md). With MOST_PER_PIXEL instead of FEWEST, captures whose depth was confirmed lost at
# most .1 dB in photos that the fit had not seen
MOST_PER_PIXEL, FEWEST, SOUND_SHARE, WRONG_SHARE = 0.07, parse_share(SHARE), 0.75, 0.6


@dataclass(frozen=True)
class Agreement:
    """Shares of a scene's pixels whose depth other views confirm or contradict, or that no other view sees."""

    confirmed: float  # A view confirms the depth, and no larger number of views sees through the surface
    contradicted: float  # More views see through the surface than confirm the depth
    alone: float  # No other view sees the position
    num_pixels: int = field(default=CONFIRM_PIXELS, compare=False)  # Number of sampled pixels that count
    # Part of the pictures in which most pixels are contradicted, such as "left third of 4 of 7 views"; empty for none
    contradicted_part: str = field(default="", compare=False)
    alone_part: str = field(default="", compare=False)  # Part whose pixels other views mostly do not see
    # True if the cameras are so close together that no two views show things displaced by ``AGREEMENT_PIXELS``
    from_one_point: bool = field(default=False, compare=False)

    def to_dict(self) -> dict[str, float]:
        """Return the confirmed, contradicted and alone shares, for reports."""
        return {name: round(getattr(self, name), 4) for name in ("confirmed", "contradicted", "alone")}

    @property
    def share(self) -> float:
        """Useful number of Gaussians per pixel; with more Gaussians, new views would not look better."""
        soundness = (self.confirmed - WRONG_SHARE) / (SOUND_SHARE - WRONG_SHARE)
        return FEWEST + (MOST_PER_PIXEL - FEWEST) * min(1.0, max(0.0, soundness))

    @property
    def advice(self) -> str | None:
        """Why a result will be poor and what would help, in one sentence; None if depth is sound."""
        if self.from_one_point:
            return (
                "all photos were taken from one point, like parts of a panorama, so no photo can confirm the depth of"
                " another, and new views from elsewhere show guesses; photos from other places would help most"
            )
        standard_error = math.sqrt(self.confirmed * (1 - self.confirmed) / self.num_pixels)
        if self.confirmed + CHANCE_ERRORS * standard_error >= POOR_SHARE or self.num_pixels < NORMAL_SAMPLES:
            return None
        problem = f"only {100 * self.confirmed:.0f} % of the pixels have a depth that another view confirms"
        if self.alone > LONELY_SHARE:
            cause = f"no other view sees {100 * self.alone:.0f} %, because the photos are too few or too far apart"
            where = f" ({self.alone_part})" if self.alone_part else ""
            return f"{problem}, and {cause}{where}; more photos between these would help most"
        where = f" ({self.contradicted_part})" if self.contradicted_part else ""
        return f"{problem}, so the depth is wrong{where}; an export with better depth would help most"
