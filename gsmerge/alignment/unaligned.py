"""Choose cameras that see rows without pixels, by the share of Gaussians they see and by the photos' colours."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from gsmerge.alignment.cameras import Poses, other_conventions
from gsmerge.alignment.centres import check_centres, sample_points
from gsmerge.alignment.frames import exporter_frames
from gsmerge.alignment.grids import Grid, Place, read_as
from gsmerge.alignment.score import MARGIN, RANDOM_SHARE, SAME_COLORS, AlignmentInput, photo_colors
from gsmerge.errors import SceneError
from gsmerge.geometry import IDENTITY, Similarity, is_inside, project_points, sh0_to_rgb
from gsmerge.io.cameras.camera_file import Convention
from gsmerge.kernels.elementary import exp
from gsmerge.types import Cameras, Gaussians

_FRAME_GAIN = 1.1  # times the score of the cameras as given, for another frame; of as good ones those stay as they are
_PEAK_GAIN = 1.05  # times that of a scale two steps of the search beside it, for a scale that colours chose
_SEEN_GAUSSIANS = 20_000  # Gaussians that are projected to see whether cameras see them
# In other conventions and frames, whose scores differ by 5 % and more where it counts; so many have 0.4 % of noise
_COMPARED_GAUSSIANS = 5000
_FEW_GAUSSIANS, _MAX_PROJECTED = 200, 4_000_000  # at least, and times the cameras at most
_MIN_SEEN = 0.5  # share of them that some camera sees
_MAX_FRONT_RATIO = 0.5  # as RANDOM_SHARE, of the foremost ones alone in a frame that colours chose
_FRONT, _PER_CELL = 1.05, 3  # times the depth of the nearest one of its cell; Gaussians of a cell
_SCALES = np.geomspace(1 / 30, 30, 55)  # of the cameras' positions, tried in turn
_SCALE_GAUSSIANS = 2000  # Gaussians that they are tried on
# next, nearer and nearer: reach (natural logarithm), steps, Gaussians
_FINER = ((0.1, 11, 2000), (0.015, 7, 20_000), (0.004, 5, 20_000))
_CENTRED = ((0.02, 81), (5e-4, 51))  # then nearer to centres of pixels: reach and steps


@dataclass(frozen=True)
class CameraCheck:
    """Check of cameras against unaligned Gaussians: the share they see, and how well colours agree."""

    share_seen: float  # share of the Gaussians inside at least one picture
    # distance of their colours from the photos where they are seen, over the distance from the same pixels shuffled;
    # NaN without photos, or where the colours hardly vary
    color_ratio: float
    ok: bool  # whether these are likely the cameras of these Gaussians
    num_compared: int = 0  # Gaussians whose colours were compared, in one picture or several
    ratio_error: float = np.nan  # standard error of the ratio, by chance alone

    @property
    def score(self) -> float:
        """Score in [0, 1] to rank cameras: the share seen, reduced where colours fit hardly better than chance."""
        return self.share_seen * (1.0 if np.isnan(self.color_ratio) else max(0.0, 1 - self.color_ratio))

    @property
    def description(self) -> str:
        """Description of the measures in one sentence."""
        seen = f"the cameras see {100 * self.share_seen:.0f} % of the Gaussians"
        if np.isnan(self.color_ratio):
            return seen
        return f"{seen}, whose colours are {self.color_ratio:.2f} times as far from the photos as any others"


def check_cameras(
    gaussians: Gaussians,
    valid: np.ndarray,
    cameras: Cameras,
    images: np.ndarray,
    samples: int = _SEEN_GAUSSIANS,
    *,
    foremost: bool = False,
    hiding: np.ndarray | None = None,
) -> CameraCheck:
    """Measure the share of sampled Gaussians that views see, and how well colours fit ``images [c,h,w,3]``, if any.

    With ``foremost`` only Gaussians that no other hides count for the colours; ``hiding``: points ``[n,3]`` that hide
    them too.
    """
    samples = min(samples, max(_FEW_GAUSSIANS, _MAX_PROJECTED // len(cameras)))
    rows = np.flatnonzero(valid)
    rows = rows[:: max(1, len(rows) // samples)]
    points = gaussians.means[rows].astype(np.float64)
    if hiding is not None:
        points = np.concatenate([points, hiding[:: max(1, len(hiding) // samples)]])
    colors = sh0_to_rgb(gaussians.sh0[rows, 0]).clip(0, 1)
    visible, compared = np.zeros((2, len(points)), bool)
    errors, shuffled_errors = list[np.ndarray](), list[np.ndarray]()
    rng = np.random.default_rng(0)
    at_once = 1 + _SEEN_GAUSSIANS // max(1, len(points))
    for first in range(0, len(cameras), at_once):
        some = cameras[first : first + at_once]
        with np.errstate(all="ignore"):
            xy, depth = project_points(points[None], some.viewmats, some.Ks)
        inside, x, y = (depth > 0) & is_inside(xy, cameras), xy[..., 0], xy[..., 1]
        visible |= inside.any(0)
        for view in np.flatnonzero(inside.any(1)) if len(images) else ():
            seen = np.flatnonzero(inside[view])
            column, row = x[view, seen].astype(np.int64), y[view, seen].astype(np.int64)
            if foremost:
                front = _are_foremost(column, row, depth[view, seen], cameras.width * cameras.height)
                front &= seen < len(rows)
                seen, column, row = seen[front], column[front], row[front]
            photo = photo_colors(images, np.full(len(seen), first + view), row, column)
            if (photo == photo[:1]).all():  # black, where a view has no photo
                continue
            compared[seen] = True
            errors.append(_mean_apart(colors[seen], photo))
            shuffled_errors.append(_mean_apart(colors[seen], rng.permutation(photo)))
    share, num_compared = float(visible[: len(rows)].sum()) / max(1, len(rows)), int(compared.sum())
    ratio, error = _color_ratio(errors, shuffled_errors, num_compared)
    return CameraCheck(share, ratio, share >= _MIN_SEEN and not ratio > RANDOM_SHARE, num_compared, error)


def _color_ratio(errors: list[np.ndarray], others: list[np.ndarray], count: int) -> tuple[float, float]:
    """Return the ratio of two mean differences, and its standard error of ``count`` Gaussians; NaN where none vary."""
    if not errors or not (other := float(np.concatenate(others).mean())) > SAME_COLORS:
        return np.nan, np.nan
    ratio = float(np.concatenate(errors).mean()) / other
    apart = np.concatenate(errors) - ratio * np.concatenate(others)  # of the mean 0
    return ratio, float(np.sqrt(np.square(apart).mean() / count)) / other


def _mean_apart(colors: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return the mean differences ``[n]`` between colours ``[n,3]``."""
    red, green, blue = np.abs(colors - others).T
    return np.asarray((red + green + blue) / 3)


def _are_foremost(column: np.ndarray, row: np.ndarray, depth: np.ndarray, area: int) -> np.ndarray:
    """Return which points ``[n]`` in pixels are about as near as the nearest point of their cell."""
    if not len(row):
        return np.zeros(0, bool)
    side = max(1, int(np.sqrt(_PER_CELL * area / len(row))))
    column, row = column // side, row // side
    cells = row * (column.max() + 1) + column
    nearest = np.full(cells.max() + 1, np.inf)
    np.minimum.at(nearest, cells, depth)
    return np.asarray(depth <= _FRONT * nearest[cells])


def choose_poses(
    gaussians: Gaussians, valid: np.ndarray, cameras: Cameras, images: np.ndarray, convention: Convention
) -> tuple[Poses | None, CameraCheck, str | None]:
    """Choose the pose convention whose cameras see the most Gaussians, with the nearest colours.

    ``cameras`` are in the usual convention; other arguments are those of :func:`check_cameras`. Returns the poses, or
    None if no other convention is clearly better than the usual one; the check of the chosen poses; and a note if
    photos fit others as well.
    """
    usual = check_cameras(gaussians, valid, cameras, images)
    candidates = [
        (poses, check_cameras(gaussians, valid, replace(cameras, viewmats=poses.viewmats), images, _COMPARED_GAUSSIANS))
        for poses in other_conventions(cameras.viewmats, convention)
    ]
    ranked = sorted(candidates, key=lambda candidate: -candidate[1].score)
    if not ranked or not ranked[0][1].ok:
        return None, usual, None
    poses, best = ranked[0]
    scores = [check.score for check in (usual, *(check for _, check in ranked[1:2])) if check.ok]
    if best.score >= MARGIN * max(scores, default=0.0):
        return poses, best, None
    # Without photos other readings see as many of any scene that lies before its cameras, which says nothing
    as_good = usual.ok and usual.num_compared > 0 and _FRAME_GAIN * best.score >= usual.score
    note = f"the poses fit as well when read as {poses.description}; they are read as the format has them"
    return None, usual, note if as_good else None


def choose_cameras(
    inputs: AlignmentInput, grid: Grid, frames: Sequence[Similarity], why: SceneError
) -> tuple[Place, list[str]]:
    """Choose cameras that see the Gaussians: unchanged, in another frame, or in another convention; with notes.

    ``frames`` are the frames that a file names; the usual frames of exporters are tried next. If no camera sees the
    Gaussians, a SceneError gives ``why`` there are no pixels.
    """
    rows, stay = (inputs.gaussians, inputs.valid), Place(grid, IDENTITY)
    if frames:
        least = check_cameras(*rows, inputs.cameras, inputs.images).score
        checks = [check_cameras(*rows, frame.move(inputs.cameras), inputs.images) for frame in frames]
        best = max(checks, key=lambda check: check.score)
        if best.ok and best.score > least:
            return replace(stay, frame=frames[checks.index(best)]), []
    poses, check, note = choose_poses(*rows, inputs.cameras, inputs.images, grid.camera_file.convention)
    other = _choose_frame(inputs, check)
    if other is not None:
        _check_colors(inputs, other.move(inputs.cameras), other.description, why)
        return Place(grid, other, "photos' colours"), []
    if not check.ok:
        raise SceneError(why.path, f"{why.problem}; {check.description}", why.remedy)
    if poses is None:
        return stay, [note] if note else []
    _check_colors(inputs, replace(inputs.cameras, viewmats=poses.viewmats), f"read as {poses.description}", why)
    return replace(stay, grid=read_as(grid, poses)), []


def _check_colors(inputs: AlignmentInput, cameras: Cameras, name: str, why: SceneError) -> None:
    """Raise the SceneError ``why`` if the photos differ much from the colours of the rows that they should show."""
    ratio = check_cameras(inputs.gaussians, inputs.valid, cameras, inputs.images, foremost=True).color_ratio
    if ratio > _MAX_FRONT_RATIO:
        found = (
            f"even with cameras {name} the colours of the foremost Gaussians are {ratio:.2f} times as far from the"
            " photos as any"
        )
        remedy = "name the exporter with --hint exporter, export all pixels, or give cameras in the file's frame"
        raise SceneError(why.path, f"{why.problem}; {found} others", remedy)


def _choose_frame(inputs: AlignmentInput, usual: CameraCheck) -> Similarity | None:
    """Choose the exporter's frame in which the colours fit the photos clearly better; None without one.

    At any scale but the true one the colours fit less well. The scale is solved for if no frame stands out at the scale
    of the cameras.
    """
    if not len(inputs.images):
        return None
    frames = exporter_frames(inputs.cameras)
    best, score = _best_frame(inputs, frames)
    stands_out = _stands_out(inputs, best, score)
    if inputs.scale is None and not stands_out:
        solved = (_solve_scale(inputs, frame) for frame in (IDENTITY, frames[1], frames[-1]))
        best, score = _best_frame(inputs, [best, *solved])
        stands_out = _stands_out(inputs, best, score)
    if best is IDENTITY or not stands_out:
        return None
    enough = max(_score_frame(inputs, IDENTITY), usual.score if usual.ok else 0.0)
    return best if score > _FRAME_GAIN * enough else None


def _score_frame(inputs: AlignmentInput, frame: Similarity, samples: int = _COMPARED_GAUSSIANS) -> float:
    """Score what the cameras see in a frame; 0 where the photos cannot tell."""
    # the first camera may see all Gaussians at any scale
    seen = slice(1 if len(inputs.cameras) > 1 else 0, None)
    cameras = frame.move(inputs.cameras)[seen]
    check = check_cameras(inputs.gaussians, inputs.valid, cameras, inputs.images[seen], samples)
    return 0.0 if np.isnan(check.color_ratio) or not check.ok else check.score


def _best_frame(
    inputs: AlignmentInput, frames: Iterable[Similarity], samples: int = _COMPARED_GAUSSIANS
) -> tuple[Similarity, float]:
    """Return the frame with the highest score, the first of equal ones, and its score."""
    scored = ((frame, _score_frame(inputs, frame, samples)) for frame in frames)
    return max(scored, key=lambda each: each[1])


def _stands_out(inputs: AlignmentInput, frame: Similarity, score: float) -> bool:
    """Return whether the ``score`` of a frame is clearly higher than that of the same frame at nearby scales."""
    away = float(_SCALES[2] / _SCALES[0])
    beside = (_score_frame(inputs, _scaled(frame, factor)) for factor in (1 / away, away))
    return all(score > _PEAK_GAIN * other for other in beside)


def _scaled(frame: Similarity, factor: float) -> Similarity:
    """Return a frame with another scale, about the origin of the Gaussians."""
    scale = factor * frame.scale
    text = f"positions scaled by {scale:.4g}"
    name = frame.description.partition("positions scaled")[0].removesuffix(", ")
    words = f"{name}, {text}" if name else text
    return replace(frame, scale=scale, shift=factor * frame.shift, description=words)


def _solve_scale(inputs: AlignmentInput, frame: Similarity) -> Similarity:
    """Find the scale at which the colours are nearest to the photos, and of those about it the Gaussians to centres."""
    best, _ = _best_frame(inputs, (_scaled(frame, float(scale)) for scale in _SCALES), _SCALE_GAUSSIANS)
    for reach, steps, samples in _FINER:
        factors = exp(np.linspace(-reach, reach, steps))
        best, _ = _best_frame(inputs, [_scaled(best, float(factor)) for factor in factors], samples)
    points = sample_points(inputs.gaussians.means, inputs.valid)
    for reach, steps in _CENTRED:
        scales = [_scaled(best, float(factor)) for factor in exp(np.linspace(-reach, reach, steps))]
        checks = [check_centres(points, scaled.move(inputs.cameras)) for scaled in scales]
        nearest = min(range(steps), key=lambda number: checks[number].px)
        best = scales[nearest] if checks[nearest].ok else best
    return best
