"""The stage of the fit: which Gaussians stay, and which parameters are fitted."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Generic, TypeVar

import numpy as np

from gsmerge.fit.color import draw, fit_colors
from gsmerge.fit.fit_options import FitOptions, FitReport, Fitted, record_fit, report_steps
from gsmerge.fit.fit_state import gaussians_of, grow_to, start_state
from gsmerge.fit.full import Progress, fit_full
from gsmerge.fit.outside import outside_views, score_fog
from gsmerge.fit.photo_sizes import fit_photos
from gsmerge.fit.survey import Survey, survey_photos
from gsmerge.raster import contributions, plan_view, prepare
from gsmerge.raster.photos import Photos, photo_errors, photo_psnr
from gsmerge.runtime.record import choose, note, stage
from gsmerge.runtime.threads import in_turn
from gsmerge.types import Array, Decoded, Gaussians, Scene, as_array

FitResult = tuple[Gaussians, FitReport]
PhotosT = TypeVar("PhotosT")  # photos of one size, where a back end has them
ResultT = TypeVar("ResultT")
CLOSE = 1.0  # dB that the held-out blocks must gain; after less, the whole photos are compared
ALWAYS = float("inf")  # where the full fit failed: it may have begun where another one ended
START = 0.57  # share of the Gaussians that a run which grows begins with


@dataclass(frozen=True)
class FitBackend(Generic[PhotosT]):
    """Functions of the fit and the scores, on the CPU (``ON_CPU``) or on a GPU.

    ``photo_psnr`` takes Gaussians and photos as a caller has them, all others as ``upload`` and
    ``upload_photos`` return them.
    """

    device: str  # "cpu" or "cuda"
    upload: Callable[[Gaussians], Gaussians]
    upload_photos: Callable[[Photos], PhotosT]
    download: Callable[[Gaussians], Gaussians]
    # photos of all sizes and a least weight -> which Gaussians stay, and what the full fit can use of the look
    look_at: Callable[[Gaussians, tuple[PhotosT, ...], float], tuple[Array, Survey | None]]
    fit_full: Callable[..., FitResult]  # see gsmerge.fit.full.fit_full
    fit_colors: Callable[[Gaussians, PhotosT, FitOptions, int], FitResult]  # the last: a seed
    # to a number, see gsmerge.fit.fit_state.grow_to; with the row that each comes from
    grow: Callable[[Gaussians, PhotosT, int], tuple[Gaussians, np.ndarray]]
    photo_error: Callable[[Gaussians, PhotosT], float]  # mean squared error of all photos
    photo_psnr: Callable[..., float]  # see gsmerge.raster.photos.photo_psnr
    memory_errors: tuple[type[Exception], ...] = ()  # of a device whose memory does not suffice


def visible_mask(gaussians: Gaussians, photos: Photos, min_weight: float) -> np.ndarray:
    """Return a mask ``[n]`` of Gaussians with a weight of ``min_weight`` in some photo, or in no photo's frustum."""
    peaks, inside = peak_weights(gaussians, photos)
    return ~inside | (peaks >= min_weight)


def peak_weights(gaussians: Gaussians, photos: Photos) -> tuple[np.ndarray, np.ndarray]:
    """Return the largest blending weights of n Gaussians in some photos, ``[n]``, and which lie in some frustum."""
    splats = prepare(gaussians)

    def one_view(view: int) -> tuple[np.ndarray, np.ndarray]:
        plan = plan_view(splats, **photos.camera(view))
        return plan.ids, contributions(plan)[1]

    peak, inside = np.zeros(len(gaussians), np.float32), np.zeros(len(gaussians), bool)
    for ids, peaks in in_turn(one_view, range(len(photos))):
        inside[ids] = True
        np.maximum(peak, peaks, out=peak)
    return peak, inside


def _look_at(gaussians: Gaussians, photos: tuple[Photos, ...], min_weight: float) -> tuple[Array, Survey]:
    look = survey_photos(gaussians, photos)
    keep = look.visible(min_weight)
    return keep, look[keep]


def _fit_colors(gaussians: Gaussians, photos: Photos, options: FitOptions, seed: int) -> FitResult:
    return fit_colors(gaussians, draw(gaussians, photos), photos, options, seed)


def _grow(gaussians: Gaussians, photos: Photos, count: int) -> tuple[Gaussians, np.ndarray]:
    state = grow_to(start_state(gaussians), photos, count)
    return gaussians_of(state.x, state.splats.shN), state.origins


def photo_error(gaussians: Gaussians, photos: Photos) -> float:
    """Return the mean squared error of all photos."""

    def score(view: int, image: np.ndarray, _: np.ndarray) -> float:
        return float(((np.clip(image, 0, 1) - photos.images[view]) ** 2).mean(dtype=np.float64))

    return float(np.mean(photo_errors(gaussians, photos, score)))


ON_CPU: FitBackend[Photos] = FitBackend(
    device="cpu",
    upload=lambda gaussians: gaussians,
    upload_photos=lambda photos: photos,
    download=lambda gaussians: gaussians,
    look_at=_look_at,
    fit_full=fit_full,
    fit_colors=_fit_colors,
    grow=_grow,
    photo_error=photo_error,
    photo_psnr=photo_psnr,
)


def fit(
    gaussians: Gaussians,
    photos: tuple[Photos, ...],
    options: FitOptions,
    count: int = 0,
    seed: int = 0,
    progress: Progress | None = None,
    baseline_start: Gaussians | None = None,
    *,
    exact: bool = False,
    fixed: np.ndarray | None = None,
    backend: FitBackend[Any] = ON_CPU,
) -> tuple[Gaussians, FitReport | None]:
    """Leave out what no photo shows, and fit the rest to the photos; a draft without a fit leaves out nothing.

    Where the full fit does not make held-out parts of the photos better, the colour fit is tried.
    ``photos``: see :func:`gsmerge.fit.photo_sizes.fit_photos`; the CPU alone fits to larger
    ones, moves cameras, and leaves Gaussians that are ``fixed [n]`` as they are. ``count``: number
    of Gaussians that the full fit may grow to; if it is ``exact`` and nothing grows, nothing is left
    out either. ``baseline_start``: another start that the full fit may beat instead, see
    :func:`gsmerge.fit.full.judge`. The report is None if nothing was asked for.
    """
    if exact and not options.grows:
        options = replace(options, min_contribution=0.0)
    if not options.needs_photos:  # it costs as much as all that was done before
        return gaussians, None

    outside = None if options.fit == "none" else outside_views(prepare(gaussians), photos[1], options)

    def fit_on(chosen: FitBackend[Any]) -> tuple[Gaussians, FitReport | None]:
        start = chosen.upload(gaussians)
        other = None if baseline_start is None else chosen.upload(baseline_start)
        sizes = tuple(chosen.upload_photos(one_size) for one_size in photos)
        fitted, report = _choose_fit(chosen, start, sizes, options, count, seed, progress, other, fixed, outside)
        fitted = chosen.download(fitted)
        fog = None if report is None or outside is None else score_fog(prepare(fitted), outside)
        return fitted, report and replace(report, device=chosen.device, fog=fog)

    on_cpu = len(photos) > 2 or options.move_cameras or fixed is not None  # what only the CPU's fit can do
    return run_on(ON_CPU if on_cpu else backend, "fit", fit_on)


def fit_scene(
    decoded: Decoded, scene: Scene, views: Sequence[int], options: FitOptions, seed: int, backend: FitBackend[Any]
) -> Fitted:
    """Fit decoded Gaussians to the photos of some views of a canonical scene, if there are any and it is asked for."""
    if scene.images is None or not options.needs_photos:
        return Fitted(decoded.gaussians, scene.cameras, None)
    with stage("fit"):
        photos = fit_photos(scene, options, views)
        choose(start_count=len(decoded.gaussians))
        gaussians, report = fit(
            decoded.gaussians, photos, options, decoded.count, seed, report_steps, decoded.baseline_start,
            exact=decoded.exact, fixed=decoded.fixed, backend=backend,
        )  # fmt: skip
        record_fit(report)
    cameras = scene.cameras
    if report is not None and report.viewmats is not None:
        viewmats = cameras.viewmats.astype(np.float64)
        viewmats[list(views)] = report.viewmats
        cameras = replace(cameras, viewmats=viewmats)
    return Fitted(gaussians, cameras, report)


def run_on(backend: FitBackend[Any], name: str, work: Callable[[FitBackend[Any]], ResultT]) -> ResultT:
    """Do some work on a back end, or on the CPU with a note if the back end's memory does not suffice."""
    try:
        return work(backend)
    except backend.memory_errors:
        note(f"the memory of the GPU did not suffice for the {name}: the CPU did it")
    return work(ON_CPU)


def _choose_fit(
    backend: FitBackend[PhotosT],
    gaussians: Gaussians,
    photos: tuple[PhotosT, ...],
    options: FitOptions,
    count: int,
    seed: int,
    progress: Progress | None,
    baseline_start: Gaussians | None,
    fixed: np.ndarray | None,
    outside: Photos | None,
) -> tuple[Gaussians, FitReport | None]:
    """Run :func:`fit` on a back end, with Gaussians and photos of its own."""
    full, half = photos[:2]
    keep, look = backend.look_at(gaussians, photos, options.min_contribution)
    kept, rows = gaussians[keep], np.flatnonzero(as_array(keep))
    if options.fit == "none":
        return kept, None
    fitted, report = backend.fit_full(
        kept, photos, options, count, seed, progress, baseline_start=baseline_start, look=look,
        fixed=None if fixed is None else fixed[rows], outside=outside,
    )  # fmt: skip
    fitted, report = _better_of(backend, full, kept, fitted, report, CLOSE)
    if report.accepted:
        assert report.origins is not None
        return fitted, replace(report, origins=rows[report.origins])
    if not options.judged:
        return kept, replace(report, origins=rows)
    if options.grows:  # the stages before left room for a growth that did not happen
        grown, sources = backend.grow(kept, half, count)
        fitted, report = backend.fit_colors(grown, half, options, seed)
        if report.accepted:
            fitted, report = _better_of(backend, full, kept, fitted, report, ALWAYS)
        if report.accepted:
            return fitted, replace(report, origins=rows[sources])
        return kept, replace(report, origins=rows)
    fitted, report = backend.fit_colors(gaussians, half, options, seed)
    fitted, report = _better_of(backend, full, kept, fitted[keep], report, ALWAYS)
    return fitted, replace(report, origins=rows)


def _better_of(
    backend: FitBackend[PhotosT], photos: PhotosT, before: Gaussians, after: Gaussians, report: FitReport, close: float
) -> FitResult:
    """Return the fitted Gaussians, or their start if held-out blocks hardly gained and whole photos lost.

    Gaussians that were fitted already are where steps of the default size only scatter. After a
    gain of ``close`` dB or more the photos are not compared.
    """
    if not report.accepted or report.holdout_after - report.holdout_before >= close:
        return after, report
    moved: PhotosT = photos if report.viewmats is None else replace(photos, viewmats=report.viewmats)  # type: ignore
    if backend.photo_error(after, moved) <= backend.photo_error(before, photos):
        return after, report
    why = "the photos as a whole were shown worse"
    return before, replace(report, method="none", accepted=False, stopped=why, viewmats=None)


def start_share(options: FitOptions) -> float:
    """Return the share of the requested Gaussians with which the fit starts."""
    return START if options.grows else 1.0
