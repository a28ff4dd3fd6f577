"""Search for the parts of a view's picture in a photo, to decide whether the photo was taken from the view's camera.

Neighbouring views have similar pictures as a whole, but the same part is in different places. So each part of the
view's picture is searched for around the same place in the photo. The offset of a part counts if the part fits its best
place clearly better than all other places. Offsets are zero if the photo is the view's, but not if it is a neighbour's.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np

from gsmerge.frozen import dataclass
from gsmerge.method.compare.similarity import NOISE_MARGIN, find_contrast, fisher_z
from gsmerge.method.compare.view_pictures import ViewPictures
from gsmerge.method.geometry.transforms import NORMAL_SPREAD
from gsmerge.method.raster.photos import shrink_pictures

OFFSET_PIXELS = 256  # pixels of the longer side of both pictures
# pixels: side of a part, and largest offset that is searched
PART_PIXELS = 32
MOST_OFFSET = 12
CONTRAST_PIXELS = 30  # pixels: side of the square whose mean is subtracted to get contrast
TAPS = 64  # size of the Fourier transforms, at least PART_PIXELS + 2 MOST_OFFSET
ZERO_OFFSET = 1  # pixels: smaller and equal offsets count as zero, since the peak of a correlation has this width
NEAR_PIXELS = 3  # pixels: parts that move together differ by at most this in their offsets, since their depths differ


@dataclass(frozen=True, eq=False)
class PhotoOffsets:
    """Offsets of the n parts of a view's picture whose best places in a photo stand out from all other places."""

    offsets: np.ndarray  # [n,2] pixels down and right
    similarity: float  # mean of Fisher's z of all parts at offset zero
    tolerance: float = ZERO_OFFSET  # pixels: smaller and equal offsets count as zero

    @cached_property
    def distances(self) -> np.ndarray:
        """Length ``[n]`` of the offsets in pixels, as the larger of both components."""
        return np.abs(self.offsets).max(1)

    @property
    def num_in_place(self) -> int:
        """Number of parts whose offset counts as zero."""
        return int((self.distances <= self.tolerance).sum())

    @property
    def num_moved_together(self) -> int:
        """Largest number of displaced parts with about the same offset."""
        displaced = self.offsets[self.distances > self.tolerance]
        return int((np.abs(displaced[:, None] - displaced).max(2) <= NEAR_PIXELS).sum(1).max(initial=0))

    @property
    def verdict(self) -> bool | None:
        """True if the photo was taken from the view, False if it was taken from elsewhere, None in doubt.

        The number of parts in place is compared with the number of parts that moved together. The larger number decides
        if it exceeds the other by more than the square root of their sum, the standard error of a fair coin's tosses.
        """
        in_place = self.num_in_place
        together = self.num_moved_together
        return in_place > together if abs(in_place - together) > np.sqrt(in_place + together) else None


def correlate_parts(shown: ViewPictures, view: int, photo: np.ndarray) -> np.ndarray:
    """Return Fisher's z ``[n]`` of the correlation of each part of a view's picture with the same part of a photo."""
    weight = shown.weights[view]
    height, width = weight.shape
    photo_contrast = find_contrast(shrink_pictures(photo[None], width, height)[0], None, CONTRAST_PIXELS)
    view_contrast = find_contrast(shown.pictures[view], weight, CONTRAST_PIXELS)
    starts = [np.arange(0, side, max(1, PART_PIXELS * max(height, width) // OFFSET_PIXELS)) for side in (height, width)]

    def sum_parts(values: np.ndarray) -> np.ndarray:
        """Add weighted values ``[h,w,3]`` over each part."""
        return np.add.reduceat(np.add.reduceat(values.sum(-1) * weight, starts[0], 0), starts[1], 1).reshape(-1)

    squares = sum_parts(photo_contrast * photo_contrast) * sum_parts(view_contrast * view_contrast)
    return fisher_z(sum_parts(photo_contrast * view_contrast) / np.sqrt(np.maximum(squares, 1e-12)))


def find_offsets(shown: ViewPictures, view: int, photo: np.ndarray) -> PhotoOffsets | None:
    """Search for the parts of a view's picture in an upright ``photo [h,w,3]``, which may have any size.

    ``shown`` are pictures of all views with up to :data:`OFFSET_PIXELS` pixels on the longer side. None if these
    pictures are too small to be cut into parts.
    """
    weight = shown.weights[view]
    height, width = weight.shape
    if min(height, width) < 2 * PART_PIXELS:
        return None
    photo_contrast = find_contrast(shrink_pictures(photo[None], width, height)[0], None, CONTRAST_PIXELS)
    view_contrast = find_contrast(shown.pictures[view], weight, CONTRAST_PIXELS)
    padded = np.pad(photo_contrast, ((MOST_OFFSET, MOST_OFFSET), (MOST_OFFSET, MOST_OFFSET), (0, 0)))
    scores = _correlate_offsets(padded, view_contrast, weight)
    middle = np.median(scores, 1)
    noise = NORMAL_SPREAD * np.median(np.abs(scores - middle[:, None]), 1) + 1e-6
    stand_out = scores.max(1) - middle > NOISE_MARGIN * noise
    offsets = np.stack(np.divmod(scores[stand_out].argmax(1), 2 * MOST_OFFSET + 1), 1) - MOST_OFFSET
    return PhotoOffsets(offsets, float(scores[:, scores.shape[1] // 2].mean()))


def _correlate_offsets(photo: np.ndarray, picture: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return Fisher's z ``[n,(2 MOST_OFFSET + 1)^2]`` of each part of a picture at every offset in a padded photo."""
    rows, columns = (
        np.arange(0, side - PART_PIXELS + 1, PART_PIXELS) + (side % PART_PIXELS) // 2 for side in weight.shape
    )
    corners = [(top, left) for top in rows for left in columns]

    def transform_parts(array: np.ndarray, side: int) -> np.ndarray:
        """Cut the parts, squares of ``side`` pixels, out of ``array``, and return their Fourier transforms."""
        parts = np.stack([array[top : top + side, left : left + side] for top, left in corners])
        return np.fft.rfft2(np.moveaxis(parts, -1, 1) if parts.ndim == 4 else parts, (TAPS, TAPS))

    shifts = slice(0, 2 * MOST_OFFSET + 1)
    searched = PART_PIXELS + 2 * MOST_OFFSET  # side of the square of the photo in which a part is searched
    weighted = picture * weight[..., None]
    photo_squares = (photo * photo).sum(-1)
    spectrum = transform_parts(photo, searched) * transform_parts(weighted, PART_PIXELS).conj()
    products = np.fft.irfft2(spectrum.sum(1))[:, shifts, shifts]
    photo_spectrum = transform_parts(photo_squares, searched) * transform_parts(weight, PART_PIXELS).conj()
    photo_energies = np.fft.irfft2(photo_spectrum)[:, shifts, shifts]
    picture_squares = (weighted * picture).sum(-1)
    picture_energies = np.stack([
        picture_squares[top : top + PART_PIXELS, left : left + PART_PIXELS].sum() for top, left in corners
    ])  # fmt: skip
    lengths = np.sqrt(np.maximum(photo_energies, 1e-9) * np.maximum(picture_energies, 1e-9)[:, None, None])
    return fisher_z(products / lengths).reshape(len(corners), -1)
