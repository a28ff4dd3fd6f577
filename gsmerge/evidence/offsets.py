"""Where the parts of a photo lie in what a view shows: in their places, or moved, as a neighbour's photo has them.

Pictures of neighbouring views are alike as a whole. Parts of one are looked up around their places in the other: where
one place stands out of all those tried, it says whether the photo was taken from there.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from gsmerge.evidence.pictures import ViewPictures
from gsmerge.evidence.scores import MARGIN, NORMAL, find_contrast, fisher_z
from gsmerge.raster.photos import shrink_pictures

SIDE = 256  # pixels of the longer side of both pictures
PART, REACH = 32, 12  # pixels of the side of a part, and how far around its place it is looked up
AROUND = 30  # pixels of the square whose mean contrast is taken from
TAPS = 64  # of the Fourier transforms, at least PART + 2 REACH
SAME = 1  # pixels to which a place is one: those of a correlation's peak
NEAR_PIXELS = 3  # pixels to which parts moved alike: what different depths leave of a motion


@dataclass(frozen=True, eq=False)
class PhotoOffsets:
    """Where the parts of a photo that say where they are lie: in their places, or elsewhere."""

    moves: np.ndarray  # [n,2] pixels down and right to where the parts that say it lie
    alike: float  # mean of Fisher's z of all parts in their places
    same: float = SAME  # pixels of a move to which a place is one

    @cached_property
    def distances(self) -> np.ndarray:
        """Pixels ``[n]`` that the parts moved, along the side along which they moved more."""
        return np.abs(self.moves).max(1)

    @property
    def here(self) -> int:
        """Number of parts in their places."""
        return int((self.distances <= self.same).sum())

    @property
    def elsewhere(self) -> int:
        """Number of parts elsewhere."""
        return len(self.moves) - self.here

    @property
    def together(self) -> int:
        """The most of the parts elsewhere that moved alike."""
        far = self.moves[self.distances > self.same]
        return int((np.abs(far[:, None] - far).max(2) <= NEAR_PIXELS).sum(1).max(initial=0))

    @property
    def verdict(self) -> bool | None:
        """Whether the photo was taken from there; None in doubt.

        It was if more parts lie here than moved alike, and it was not if more lie elsewhere, by more than the standard
        error of a fair coin.
        """
        if self.here - self.together > np.sqrt(self.here + self.together):
            return True
        return False if self.elsewhere - self.here > np.sqrt(self.elsewhere + self.here) else None


def correlate_parts(shown: ViewPictures, view: int, photo: np.ndarray) -> np.ndarray:
    """Return Fisher's z of the correlations ``[n]`` of a photo's parts with those in the same places of a view."""
    weight = shown.weights[view]
    height, width = weight.shape
    near = find_contrast(shrink_pictures(photo[None], width, height)[0], None, AROUND)
    own = find_contrast(shown.pictures[view], weight, AROUND)
    starts = [np.arange(0, side, max(1, PART * max(height, width) // SIDE)) for side in (height, width)]

    def add(values: np.ndarray) -> np.ndarray:
        return np.add.reduceat(np.add.reduceat(values.sum(-1) * weight, starts[0], 0), starts[1], 1).reshape(-1)

    return fisher_z(add(near * own) / np.sqrt(np.maximum(add(near * near) * add(own * own), 1e-12)))


def find_offsets(shown: ViewPictures, view: int, photo: np.ndarray) -> PhotoOffsets | None:
    """Look up the parts of an upright ``photo [h,w,3]`` in a view of ``shown``, which has up to :data:`SIDE` pixels.

    None if these are so few that there are no parts.
    """
    weight = shown.weights[view]
    height, width = weight.shape
    if min(height, width) < 2 * PART:
        return None
    near = find_contrast(shrink_pictures(photo[None], width, height)[0], None, AROUND)
    own = find_contrast(shown.pictures[view], weight, AROUND)
    scores = _look_up(np.pad(near, ((REACH, REACH), (REACH, REACH), (0, 0))), own, weight)
    middle = np.median(scores, 1)
    noise = NORMAL * np.median(np.abs(scores - middle[:, None]), 1) + 1e-6
    decided = scores.max(1) - middle > MARGIN * noise
    moves = np.stack(np.divmod(scores[decided].argmax(1), 2 * REACH + 1), 1) - REACH
    return PhotoOffsets(moves, float(scores[:, scores.shape[1] // 2].mean()))


def _look_up(photo: np.ndarray, picture: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return Fisher's z ``[n,(2 REACH + 1)^2]`` of a picture's parts and those around them in a padded photo."""
    rows, columns = (np.arange(0, side - PART + 1, PART) + (side % PART) // 2 for side in weight.shape)
    corners = [(top, left) for top in rows for left in columns]

    def cut(array: np.ndarray, side: int) -> np.ndarray:
        parts = np.stack([array[top : top + side, left : left + side] for top, left in corners])
        return np.fft.rfft2(np.moveaxis(parts, -1, 1) if parts.ndim == 4 else parts, (TAPS, TAPS))

    shifts = slice(0, 2 * REACH + 1)
    heavy, squares = picture * weight[..., None], (photo * photo).sum(-1)
    products = np.fft.irfft2((cut(photo, PART + 2 * REACH) * cut(heavy, PART).conj()).sum(1))[:, shifts, shifts]
    energies = np.fft.irfft2(cut(squares, PART + 2 * REACH) * cut(weight, PART).conj())[:, shifts, shifts]
    power = (heavy * picture).sum(-1)
    own = np.stack([power[top : top + PART, left : left + PART].sum() for top, left in corners])
    sizes = np.sqrt(np.maximum(energies, 1e-9) * np.maximum(own, 1e-9)[:, None, None])
    return fisher_z(products / sizes).reshape(len(corners), -1)
