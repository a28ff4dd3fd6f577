"""Settings of what becomes of a batch of new views."""

from __future__ import annotations

from dataclasses import dataclass

from gsmerge.stages.decode import MAX_CHILDREN


@dataclass(frozen=True)
class OnlineOptions:
    """How new views enter a state.

    Args:
        max_k: Most Gaussians of a group that can be decoded later, 1 to 8; of a state that is there already, its own.
        tolerance: A new group is left out where the state shows its pixels with a colour error (root mean square,
            sRGB in [0, 1], holes counted) below this, or no larger than ``margin`` times that of the new views' own
            Gaussians: what is there already needs no second Gaussian. 0: nothing is left out.
        margin: See ``tolerance``.
        replay: Most photos that are kept, spread evenly over all that came, for a full fit when decoding. The colours
            are solved batch by batch and need none.

    Raises:
        ValueError: If a setting is out of range.
    """

    max_k: int = 4
    tolerance: float = 0.06
    margin: float = 1.0
    replay: int = 96

    def __post_init__(self) -> None:
        if not 1 <= self.max_k <= MAX_CHILDREN:
            raise ValueError(f"max k: expected 1 to {MAX_CHILDREN}, got {self.max_k}")
        if not 0 <= self.tolerance <= 1:
            raise ValueError(f"tolerance: expected 0 to 1, got {self.tolerance}")
        if not self.margin >= 0:
            raise ValueError(f"margin: expected at least 0, got {self.margin}")
        if self.replay < 0:
            raise ValueError(f"replay: expected at least 0, got {self.replay}")
