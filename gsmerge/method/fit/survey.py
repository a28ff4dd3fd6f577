"""Measure how much photos show of each Gaussian, and score renders of Gaussians against the photos."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gsmerge.frozen import dataclass, fields
from gsmerge.method.fit.fit_state import FitState, start_state
from gsmerge.method.fit.photo_sizes import holdout_psnr
from gsmerge.method.fit.schedule import FitRun
from gsmerge.method.geometry.transforms import project
from gsmerge.method.raster import make_splats, tile_view
from gsmerge.method.raster.composite import list_contributions, survey
from gsmerge.method.raster.photos import NEAR_PLANE, Photos, photo_errors, render_photos
from gsmerge.runtime.threads import in_turn
from gsmerge.types import Cameras, Gaussians

MOST_SCORED = 12  # a fit is scored on at most this many photos
ENOUGH_PHOTOS = 6  # a survey needs no more photos of a Gaussian whose centre is inside ENOUGH_PHOTOS
# A photo is added to a survey if more than FEWER_SHARE of its Gaussians are inside fewer than ENOUGH_PHOTOS photos
FEWER_SHARE = 0.03


@dataclass(frozen=True, eq=False)
class Survey:
    """What half-size photos show of each of the n Gaussians from which a fit starts."""

    score: float  # PSNR (dB) of renders of all n Gaussians on the held-out patches; NaN if none are held out
    inside: np.ndarray  # [n] bool, true for Gaussians that may reach into the frustum of some photo
    peaks: np.ndarray  # [n] float32 largest blending weight in any pixel
    sums: np.ndarray  # [n] float64 blending weights summed over all photos, pixels
    squares: np.ndarray  # [n] float64 squares of the weights summed over a photo, added up for all photos
    pixels: np.ndarray  # [n] float32 size of the finest pixel that shows the Gaussian, world units; inf if none does

    def visible(self, min_weight: float) -> np.ndarray:
        """Return a mask ``[n]`` of Gaussians that weigh ``min_weight`` in some pixel or are outside of all frustums."""
        return ~self.inside | (self.peaks >= min_weight)

    def __getitem__(self, rows: np.ndarray) -> Survey:
        columns = {field.name: getattr(self, field.name)[rows] for field in fields(self) if field.name != "score"}
        return Survey(self.score, **columns)


def survey_photos(gaussians: Gaussians, run: FitRun) -> Survey:
    """Draw Gaussians at the cameras of half-size photos, and measure what each photo shows of each Gaussian.

    :func:`choose_photos` chooses the photos. Sizes of pixels are measured in the largest photos of the fit.
    """
    photos = run.job.photos
    state, half, count = start_state(gaussians), photos[1], len(gaussians)
    colors = state.view_colors()

    def survey_view(view: int) -> tuple[np.ndarray, ...]:
        """Return the ids of the Gaussians in a view, the sizes of its pixels at them, and the result of ``survey``."""
        tiled = tile_view(state.splats, **half.camera(view))
        focal = max(sized.Ks[view][[0, 1], [0, 1]].max() for sized in photos)
        return tiled.ids, tiled.depths / focal, *survey(tiled, colors)

    views = choose_photos(gaussians, half)
    scored_views = choose_scored_photos(len(half))
    images = []  # renders of the scored views
    inside = np.zeros(count, bool)
    peaks = np.zeros(count, np.float32)
    sums = np.zeros(count)
    squares = np.zeros(count)
    pixels = np.full(count, np.inf, np.float32)
    for view, (ids, pixel_sizes, image, weights, view_peaks) in zip(views, in_turn(survey_view, views), strict=True):
        if view in scored_views:
            images.append(image)
        inside[ids] = True
        peaks[ids] = np.maximum(peaks[ids], view_peaks)
        pixels[ids] = np.minimum(pixels[ids], pixel_sizes)
        sums[ids] += weights
        squares[ids] += weights.astype(np.float64) ** 2
    return Survey(
        score_images(images, run, half), inside=inside, peaks=peaks, sums=sums, squares=squares, pixels=pixels
    )


def choose_photos(gaussians: Gaussians, photos: Photos) -> list[int]:
    """Return the indices of the photos for a survey: the scored photos, and others that show something new.

    A photo shows something new if many of its Gaussians are inside fewer than ``ENOUGH_PHOTOS`` of the photos chosen so
    far.
    """
    sample_gaussians = 4096  # a sample of about this many Gaussians, at most twice as many, is projected
    means = gaussians.means[:: max(1, len(gaussians) // sample_gaussians)]
    pixels, depths = project(means, Cameras(photos.viewmats, photos.Ks, photos.width, photos.height))
    inside = (depths > NEAR_PLANE) & ((pixels > 0) & (pixels < (photos.width, photos.height))).all(-1)
    views = choose_scored_photos(len(photos))
    num_photos = inside[views].sum(0)
    for view in spread_views(len(photos)):
        if view not in views and (inside[view] & (num_photos < ENOUGH_PHOTOS)).sum() > FEWER_SHARE * inside[view].sum():
            views.append(view)
            num_photos += inside[view]
    return sorted(views)


def choose_scored_photos(count: int) -> list[int]:
    """Return the indices of the photos that a fit is scored on, at most ``MOST_SCORED`` of ``count``."""
    return sorted(spread_views(count)[:MOST_SCORED])


def spread_views(count: int) -> list[int]:
    """Return the indices of ``count`` views, in an order whose first n views are spread evenly over all, for any n."""
    # the order of the reversed bits of the numbers (van der Corput)
    return sorted(range(count), key=lambda view: f"{view:032b}"[::-1])


def peak_weights(gaussians: Gaussians, photos: Photos) -> tuple[np.ndarray, np.ndarray]:
    """Return each Gaussian's largest blending weight ``[n]``, and a mask ``[n]`` of Gaussians that a camera may see."""
    splats = make_splats(gaussians)

    def view_peaks(view: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the ids of the Gaussians in a view, and their largest blending weights."""
        tiled = tile_view(splats, **photos.camera(view))
        return tiled.ids, list_contributions(tiled)[1]

    peak = np.zeros(len(gaussians), np.float32)
    inside = np.zeros(len(gaussians), bool)
    for ids, peaks in in_turn(view_peaks, range(len(photos))):
        inside[ids] = True
        peak[ids] = np.maximum(peak[ids], peaks)
    return peak, inside


def score_images(images: Sequence[np.ndarray], run: FitRun, half: Photos) -> float:
    """Return the PSNR (dB) of renders of the scored photos on held-out patches, or NaN without such patches."""
    options = run.job.options
    views = choose_scored_photos(len(half))
    if not options.scored:
        return float("nan")
    return holdout_psnr(images, half[views], [run.score_weights[view] for view in views], options.tuning.min_gain)


def score_state(state: FitState, run: FitRun, half: Photos) -> float:
    """Return the PSNR (dB) of a state on the held-out patches of the half-size photos; see :func:`score_images`."""
    views = choose_scored_photos(len(half))
    return score_images(render_photos(state.splats, half, colors=state.view_colors(), views=views), run, half)


def photo_mses(gaussians: Gaussians, photos: Photos) -> np.ndarray:
    """Return the mean squared error ``[v]`` of the render of each whole photo, always above 0 for use as a divisor."""

    def measure_mse(view: int, image: np.ndarray, _: np.ndarray) -> float:
        return float(((np.clip(image, 0, 1) - photos.images[view]) ** 2).mean(dtype=np.float64))

    return np.array(photo_errors(gaussians, photos, measure_mse)) + np.finfo(np.float32).tiny
