"""Choose cameras for rows without pixels, by the share of Gaussians that they see and by the photos' colours."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from itertools import chain, product
from pathlib import Path

import numpy as np

from gsmerge.errors import SceneError
from gsmerge.frozen import dataclass, replace
from gsmerge.io.cameras.camera_file import Convention
from gsmerge.method.geometry.transforms import (
    IDENTITY,
    Similarity,
    is_inside,
    median,
    medians,
    motion_matrices,
    project_points,
    sh0_to_rgb,
)
from gsmerge.method.kernels.elementary import exp
from gsmerge.method.kernels.matrices import invert, matmul
from gsmerge.reading.alignment.conventions import PosesInConvention, other_conventions
from gsmerge.reading.alignment.frames import axis_turns, describe_frame, exporter_frames
from gsmerge.reading.alignment.grids import Grid, with_poses
from gsmerge.reading.alignment.registration.localise import find_frame, mirror
from gsmerge.reading.alignment.registration.register import compose
from gsmerge.reading.alignment.score import AlignmentInput, photo_colors
from gsmerge.types import Cameras, Gaussians

# Colour error, divided by the colour error of shuffled pixels, above which colours agree no better than at random
RANDOM_SHARE = 0.85
# Least score of another convention, divided by the score of the usual convention: _MARGIN if colours are not compared,
# _COLOR_MARGIN if they are
_COLOR_MARGIN = 1.3
_MARGIN = 2.0
_FRAME_GAIN = 1.1  # least score of another frame, divided by the score of the cameras as they are
# Least score of a scale chosen by colours, divided by the score of a scale two steps away, and of a frame found by
# keypoints, divided by that of a frame that exporters use
_PEAK_GAIN = 1.05
_SEEN_GAUSSIANS = 20_000  # number of Gaussians that are projected, to estimate the share that cameras see
# Number of Gaussians whose colours are compared in other conventions and frames. It gives scores an error of 0.4 %,
# which is small, as the scores of two frames have to differ by 5 % or more
_COMPARED_GAUSSIANS = 5000
MAX_FRONT_RATIO = 0.5  # like RANDOM_SHARE, but only for the foremost Gaussians, in a frame that was chosen by colours
# Colours of the foremost Gaussians in their own frame have ratios of .13 to .44, and of _TURNED times as much or more
# if cameras are turned by _TURN, radians. If cameras are wrong by two degrees, ratios are above _SURE_RATIO, and some
# turn makes them at most 1.25 times as large
_SURE_RATIO = 0.3
_TURN = 0.035
_TURNED = 1.32
# A Gaussian counts as foremost if its depth is at most _FRONT times the least depth in its cell. A cell has _PER_CELL
# Gaussians on average
_FRONT = 1.05
_PER_CELL = 3
# Scales of the cameras' positions, all of which are tried. Programs that write cameras and Gaussians use units that
# differ by factors of up to 1000
_SCALES = np.geomspace(1 / 1300, 1300, 115)
# For each finer search around the best scale: largest change (natural logarithm), number of scales, number of Gaussians
_FINER = ((0.1, 11, 2000), (0.015, 7, 20_000), (0.004, 5, 20_000))
# Places in a picture at which the middle of the Gaussians is tried, to find a shift. A place is x in widths of the
# picture, y in heights, and the logarithm of the depth in radii of the scene. The places are a tenth of a picture
# apart, because colours still agree if the shift is wrong by this much
_PLACES = tuple(np.linspace(*ends).tolist() for ends in ((-0.2, 1.2, 15), (-0.2, 1.2, 15), (-1.5, 2.25, 16)))
# For each finer search around the best places: number of Gaussians, number of places that are kept, size of a step
_SHIFT_STEPS = [(2000 if i < 5 else 20_000, 8 if i < 5 else 1, 0.05 * 0.6**i) for i in range(10)]


MIRRORED = "photos that show the Gaussians as in a mirror"
CROPPED = "if the photos were cropped after the model saw them, name the whole photos, or cameras of crops (--cameras)"
UNMIRROR = "export the Gaussians without the flip of an axis; no option of gsmerge mirrors a scene"


@dataclass(frozen=True)
class CameraCheck:
    """The share of Gaussians that cameras see, and how well the colours agree with the photos."""

    share_seen: float  # share of the Gaussians that project into at least one view
    # colour error of the Gaussians in the photos, divided by the error after shuffling the pixels; NaN without photos,
    # or if the colours hardly vary
    color_ratio: float
    ok: bool  # True if these are probably the cameras of these Gaussians
    num_compared: int = 0  # number of Gaussians whose colours were compared in at least one photo
    ratio_error: float = np.nan  # standard error of the ratio, from sampling alone

    @property
    def score(self) -> float:
        """Score in [0, 1] to rank cameras: the share seen, times 1 minus the colour ratio if it is known."""
        return self.share_seen * (1.0 if np.isnan(self.color_ratio) else max(0.0, 1 - self.color_ratio))

    @property
    def description(self) -> str:
        """Description of the measures in one sentence."""
        return f"the cameras {self.words}"

    @property
    def words(self) -> str:
        """The measures in the words of a sentence about cameras."""
        seen = f"see {100 * self.share_seen:.0f} % of the Gaussians"
        return f"{seen}, whose {self.color_words}" if self.color_words else seen

    @property
    def color_words(self) -> str:
        """The measure of colours in words; empty if it is not known."""
        if np.isnan(self.color_ratio):
            return ""
        return f"colours are {self.color_ratio:.2f} times as far from the photos as from random pixels"


class UnseenError(SceneError):
    """Raised if cameras do not see the Gaussians, or see other colours than the photos have."""

    sight: CameraCheck | None = None  # what the cameras see


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
    """Measure the share of sampled Gaussians that views see, and how well their colours fit ``images [c,h,w,3]``.

    About ``samples`` of the ``valid [n]`` Gaussians are measured. ``images`` may be empty. With ``foremost``, the
    colours of hidden Gaussians do not count. ``hiding`` are further points ``[m,3]`` that hide Gaussians, but have no
    colours themselves.
    """
    # fewer Gaussians are measured if otherwise more than max_projected points would be projected into all cameras
    min_gaussians = 200
    max_projected = 4_000_000
    samples = min(samples, max(min_gaussians, max_projected // len(cameras)))
    rows = np.flatnonzero(valid)
    rows = rows[:: max(1, len(rows) // samples)]
    points = gaussians.means[rows].astype(np.float64)
    if hiding is not None:
        points = np.concatenate([points, hiding[:: max(1, len(hiding) // samples)]])
    colors = sh0_to_rgb(gaussians.sh0[rows, 0]).clip(0, 1)
    # points that lie inside a view, and points whose colours are compared
    visible, compared = np.zeros((2, len(points)), bool)
    errors = list[np.ndarray]()
    shuffled_errors = list[np.ndarray]()
    rng = np.random.default_rng(0)
    views_at_once = 1 + _SEEN_GAUSSIANS // max(1, len(points))
    for first_view in range(0, len(cameras), views_at_once):
        batch = cameras[first_view : first_view + views_at_once]
        with np.errstate(all="ignore"):
            xy, depth = project_points(points[None], batch.viewmats, batch.Ks)
        inside = (depth > 0) & is_inside(xy, cameras)
        visible |= inside.any(0)
        for view in np.flatnonzero(inside.any(1)) if len(images) else ():
            seen = np.flatnonzero(inside[view])
            column, row = xy[view, seen].astype(np.int64).T
            if foremost:
                is_front = _find_foremost(column, row, depth[view, seen], cameras.width * cameras.height)
                is_front &= seen < len(rows)  # the points ``hiding`` have no colours
                seen = seen[is_front]
                column = column[is_front]
                row = row[is_front]
            photo = photo_colors(images, np.full(len(seen), first_view + view), row, column)
            if (photo == photo[:1]).all():  # a view without a photo is black
                continue
            compared[seen] = True
            errors.append(_mean_difference(colors[seen], photo))
            shuffled_errors.append(_mean_difference(colors[seen], rng.permutation(photo)))
    share = float(visible[: len(rows)].sum()) / max(1, len(rows))
    num_compared = int(compared.sum())
    # the mean colour error, divided by the mean colour error of shuffled pixels, and the ratio's standard error
    ratio = error = np.nan
    min_error = 0.01  # colour error of shuffled pixels below which colours vary too little to decide
    if errors and (mean_shuffled := float(np.concatenate(shuffled_errors).mean())) > min_error:
        ratio = float(np.concatenate(errors).mean()) / mean_shuffled
        residuals = np.concatenate(errors) - ratio * np.concatenate(shuffled_errors)  # with a mean of 0
        error = float(np.sqrt(np.square(residuals).mean() / num_compared)) / mean_shuffled
    min_seen = 0.5  # share of the Gaussians that must be in some camera
    return CameraCheck(share, ratio, share >= min_seen and not ratio > RANDOM_SHARE, num_compared, error)


def _mean_difference(colors: np.ndarray, other_colors: np.ndarray) -> np.ndarray:
    """Return the mean absolute difference ``[n]``, over the channels, of two arrays of colours ``[n,3]``."""
    red, green, blue = np.abs(colors - other_colors).T
    return np.asarray((red + green + blue) / 3)


def _find_foremost(column: np.ndarray, row: np.ndarray, depth: np.ndarray, area: int) -> np.ndarray:
    """Return a mask ``[n]`` of the points that are about as near to the camera as the nearest point of their cell.

    ``column [n]`` and ``row [n]`` are the pixels of the points, and ``depth [n]`` their depths. A cell is a square of
    pixels, and so large that it has a few points. The picture has ``area`` pixels.
    """
    if not len(row):
        return np.zeros(0, bool)
    side = max(1, int(np.sqrt(_PER_CELL * area / len(row))))
    column = column // side
    row = row // side
    cells = row * (column.max() + 1) + column
    nearest = np.full(cells.max() + 1, np.inf)
    np.minimum.at(nearest, cells, depth)
    return np.asarray(depth <= _FRONT * nearest[cells])


def choose_poses(
    gaussians: Gaussians, valid: np.ndarray, cameras: Cameras, images: np.ndarray, convention: Convention
) -> tuple[PosesInConvention | None, CameraCheck, str | None]:
    """Choose the pose convention in which the cameras see most Gaussians and the colours fit best.

    ``cameras`` are in the usual ``convention``. ``gaussians``, ``valid`` and ``images`` are as in
    :func:`check_cameras`. Returns:

    - the poses in another convention; None if no other convention is clearly better than the usual convention
    - the check of the chosen poses
    - a note that another convention fits the photos as well; None if no other convention fits
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
    rivals = [usual, *(check for _, check in ranked[1:2])]
    margin = _MARGIN if np.isnan(best.color_ratio) else _COLOR_MARGIN
    if best.score >= margin * max((check.score for check in rivals if check.ok), default=0.0):
        return poses, best, None
    # Without photos there is no note, because in any scene another convention may see as many Gaussians
    as_good = usual.ok and usual.num_compared > 0 and _FRAME_GAIN * best.score >= usual.score
    note = f"the poses fit as well when read as {poses.description}; they are read as the format has them"
    return None, usual, note if as_good else None


def choose_cameras(
    inputs: AlignmentInput, grid: Grid, frames: Sequence[Similarity], no_pixels: SceneError
) -> tuple[Grid, CameraCheck | None, list[str]]:
    """Choose the cameras that see the Gaussians: unchanged, in another frame, or in another convention.

    ``frames`` are the frames that a file gives, which are tried first. The usual frames of exporters are tried next.
    Returns the grid with these cameras, what they see (None if the photos' colours show another frame), and notes. The
    error ``no_pixels`` explains why the rows have no pixels. If no cameras see the Gaussians, UnseenError says so, with
    a sentence on what was tried.
    """
    rows = inputs.gaussians, inputs.valid
    if frames:
        tried = (IDENTITY, *frames)
        checks = [check_cameras(*rows, frame.move_cameras(inputs.cameras), inputs.images) for frame in tried]
        best = int(np.argmax([check.score * check.ok for check in checks]))
        if best > 0:
            return replace(grid, frame=tried[best]), checks[best], []
    poses, check, note = choose_poses(*rows, inputs.cameras, inputs.images, grid.camera_file.convention)
    frame = _choose_frame(inputs, check, frames)
    if frame is not None:
        _check_colors(inputs, frame.move_cameras(inputs.cameras), frame.description, no_pixels)
        return replace(grid, frame=frame, shown_by="photos' colours"), None, []
    if poses is None and is_mirrored(inputs):  # colours of another convention are checked below
        raise UnseenError(no_pixels.path, f"{no_pixels.problem}; {MIRRORED}", UNMIRROR)
    if not check.ok:
        remedy = f"{no_pixels.remedy}, or write their shift (x y z) to offset.txt beside the file"
        remedy += f", or copy nerfstudio's dataparser_transforms.json to {Path(no_pixels.path).parent}"
        if check.share_seen > 0.5:  # the views see most Gaussians, so only the colours contradict the cameras
            remedy += f"; {CROPPED}; if the cameras are right, the photos or the colours of the file are wrong:"
            remedy += " --images none keeps the cameras, and --hint colors=rgb reads f_dc as RGB"
        unseen = UnseenError(no_pixels.path, f"{no_pixels.problem}; {check.description}", remedy)
        unseen.sight = check
        raise unseen
    if poses is None:
        return grid, check, [note] if note else []
    cameras = replace(inputs.cameras, viewmats=poses.viewmats)
    _check_colors(inputs, cameras, f"read as {poses.description}", no_pixels)
    return with_poses(grid, poses), check, []


def is_mirrored(inputs: AlignmentInput) -> bool:
    """Return whether the photos show the Gaussians as in a mirror, and not as they are."""
    if inputs.images.any((1, 2, 3)).sum() < 2 or _fits_exactly(inputs, IDENTITY):
        return False
    mirrored = mirror(inputs)
    frames = (IDENTITY, *axis_turns())
    # a frame in which the views see nothing contradicts no photo
    seen = (frame for frame in frames if np.isfinite(_measure_foremost(mirrored, frame)))
    return any(_fits_exactly(mirrored, frame) for frame in seen)


def _check_colors(inputs: AlignmentInput, cameras: Cameras, name: str, no_pixels: SceneError) -> None:
    """Raise SceneError if the colours of the foremost Gaussians do not fit the photos.

    ``name`` describes the cameras in words. The message begins with the problem of ``no_pixels``.
    """
    ratio = check_cameras(inputs.gaussians, inputs.valid, cameras, inputs.images, foremost=True).color_ratio
    if ratio > MAX_FRONT_RATIO and is_mirrored(inputs):
        raise UnseenError(no_pixels.path, f"{no_pixels.problem}; {MIRRORED}", UNMIRROR)
    if ratio > MAX_FRONT_RATIO:
        measured = (
            f"even with cameras {name} the colours of the foremost Gaussians are {ratio:.2f} times as far from the"
            " photos as from random pixels"
        )
        remedy = "name the exporter with --hint exporter, export all pixels, or give cameras in the file's frame"
        remedy += f"; {CROPPED}"
        raise SceneError(no_pixels.path, f"{no_pixels.problem}; {measured}", remedy)


def _choose_frame(inputs: AlignmentInput, usual: CameraCheck, stated: Sequence[Similarity]) -> Similarity | None:
    """Choose a frame in which the colours fit the photos clearly better than in the frame of the cameras.

    Returns None if no frame fits clearly better. The frames of exporters are tried and, if the cameras as they are do
    not fit, the world turned about its axes, also before and after the frames ``stated`` in a file. ``usual`` is the
    check of the cameras as they are. Colours fit best at the true scale, so the chosen frame must fit better than the
    same frame at nearby scales. If no frame stands out at the scale of the cameras, the scale is solved for, and then,
    unless colours fit exactly at that scale, a shift, which takes seconds.
    """
    if not len(inputs.images):
        return None
    frames = exporter_frames(inputs.cameras)
    turned = list[Similarity]()
    if not usual.ok:
        turned = axis_turns()
        for first, second in chain(product(stated, axis_turns()), product(axis_turns(), stated)):
            words = f"{first.description} and {second.description}"
            turned.append(replace(compose(second, first), description=words))
    best, score = _best_frame(inputs, [*frames, *turned])
    stands_out = _stands_out(inputs, best, score)
    # views without a photo are black and do not count; one photo is too few, because it fits somewhere in any scene
    has_photos = inputs.scale is None and inputs.images.any((1, 2, 3)).sum() > 1
    is_moved = not usual.ok  # or no shift is searched
    if has_photos and not (stands_out and _fits_exactly(inputs, best)):
        measure = partial(_measure_foremost, inputs)
        found, is_sure = find_frame(inputs, measure, partial(_fits_exactly, inputs))
        is_moved &= not is_sure
        if found is not None:  # about right; a frame without its errors is chosen if that explains the photos as well
            found = refine_frame(inputs, found, measure)
            found_score = _score_frame(inputs, found)
            if found_score > _PEAK_GAIN * score or not stands_out:
                best, score = found, found_score
            stands_out = True
    if has_photos and not stands_out:
        # frames of `exporter_frames`: rotated into the first camera, turned to y up, and moved into the first camera
        solved = [_solve_scale(inputs, frame) for frame in (IDENTITY, frames[1], frames[4], frames[-1])]
        best, score = _best_frame(inputs, [best, *solved])
        stands_out = _stands_out(inputs, best, score)
        if is_moved and not (stands_out and _fits_exactly(inputs, best)):
            best, score = _best_frame(inputs, [best, *_solve_shift(inputs)])
            stands_out = _stands_out(inputs, best, score)
    if best is IDENTITY or not stands_out:
        return None
    usual_score = max(_score_frame(inputs, IDENTITY), usual.score if usual.ok else 0.0)
    return best if score > _FRAME_GAIN * usual_score else None


def refine_frame(inputs: AlignmentInput, frame: Similarity, measure: Callable[[Similarity], float]) -> Similarity:
    """Turn, move and scale a frame about the middle of the Gaussians until ``measure`` gains nothing.

    Small pictures have few keypoints, and a frame of these is wrong by half a degree, which is a pixel.
    """
    points = inputs.gaussians.means[inputs.valid].astype(np.float64)
    middle = medians(points)
    unit = median(np.sqrt(((points - middle) ** 2).sum(1)))

    def move(step: np.ndarray) -> Similarity:
        """Return the frame after a turn, a shift and a change of the scale ``[7]``, in hundredths."""
        rotation = motion_matrices(np.concatenate([step[:3], np.zeros(3)])[None] / 100)[0, :3, :3]
        scale = float(exp(step[6:] / 100)[0])
        shift = middle - scale * matmul(middle[None], rotation.T)[0] + step[3:6] * unit / 100
        return compose(Similarity(rotation, scale, shift), frame)

    best = measure(frame)
    place = np.zeros(7)
    size = 1.0 if best > _SURE_RATIO else 0.0
    while size > 1 / 16:  # half a pixel of small pictures
        steps = (place + sign * size * axis for axis in np.eye(7) for sign in (1, -1))
        costs = [(measure(move(step)), step) for step in steps]
        least, step = min(costs, key=lambda cost: cost[0])
        if least < best:
            best = least
            place = step
        else:
            size /= 2
    return describe_frame(move(place)) if place.any() else frame


def _fits_exactly(inputs: AlignmentInput, frame: Similarity) -> bool:
    """Return whether photos have the colours of the foremost Gaussians in a frame, and less so if cameras are turned.

    If cameras are wrong by two degrees or more, some turn of all of them fits about as well, or better.
    """
    ratio = _measure_foremost(inputs, frame)
    if not ratio > _SURE_RATIO:
        return True
    return ratio <= MAX_FRONT_RATIO and all(
        _measure_foremost(inputs, frame, axis, turn) > _TURNED * ratio for axis in (0, 1) for turn in (_TURN, -_TURN)
    )


def _measure_foremost(inputs: AlignmentInput, frame: Similarity, axis: int = 0, radians: float = 0.0) -> float:
    """Return the colour ratio of the foremost Gaussians in a frame, if cameras are turned about one of their axes."""
    cameras = frame.move_cameras(inputs.cameras)
    motion = np.zeros((1, 6))
    motion[0, axis] = radians
    cameras = replace(cameras, viewmats=matmul(motion_matrices(motion)[0], cameras.viewmats.astype(np.float64)))
    checked = inputs.gaussians, inputs.valid, cameras, inputs.images, _COMPARED_GAUSSIANS
    return check_cameras(*checked, foremost=True).color_ratio


def _score_frame(inputs: AlignmentInput, frame: Similarity, samples: int = _COMPARED_GAUSSIANS) -> float:
    """Return the score of the cameras in a frame, see :class:`CameraCheck`; 0 if colours cannot be compared.

    ``samples`` is the number of Gaussians that are compared.
    """
    # the first camera does not count, because it may see all Gaussians at any scale
    later = slice(1 if len(inputs.cameras) > 1 else 0, None)
    cameras = frame.move_cameras(inputs.cameras)[later]
    check = check_cameras(inputs.gaussians, inputs.valid, cameras, inputs.images[later], samples)
    return 0.0 if np.isnan(check.color_ratio) or not check.ok else check.score


def _best_frame(
    inputs: AlignmentInput, frames: Iterable[Similarity], samples: int = _COMPARED_GAUSSIANS
) -> tuple[Similarity, float]:
    """Return the frame with the highest score, the first of several, and this score."""
    scored = ((frame, _score_frame(inputs, frame, samples)) for frame in frames)
    return max(scored, key=lambda frame_and_score: frame_and_score[1])


def _stands_out(inputs: AlignmentInput, frame: Similarity, score: float) -> bool:
    """Return True if the ``score`` of a frame is clearly higher than its scores at scales two steps of _SCALES away."""
    two_steps = float(_SCALES[2] / _SCALES[0])
    neighbour_scores = (_score_frame(inputs, _scale_frame(frame, factor)) for factor in (1 / two_steps, two_steps))
    return all(score > _PEAK_GAIN * neighbour_score for neighbour_score in neighbour_scores)


def _scale_frame(frame: Similarity, factor: float) -> Similarity:
    """Return a frame scaled by ``factor``, about the origin of the Gaussians."""
    scale = factor * frame.scale
    text = f"positions scaled by {scale:.4g} (--hint scene_scale={scale:.4g})"
    name = frame.description.partition("positions scaled")[0].removesuffix(", ")
    words = f"{name or 'in another scale'}, {text}"
    return replace(frame, scale=scale, shift=factor * frame.shift, description=words)


def _solve_scale(inputs: AlignmentInput, frame: Similarity) -> Similarity:
    """Return a frame at the scale at which its colours fit the photos best.

    All scales of _SCALES are tried. Finer searches begin at the scale whose score exceeds the scores two steps away by
    most. This score need not be the highest: far from the true scale all cameras may be in one place, so that scores
    are high, but equal.
    """
    scaled = [_scale_frame(frame, float(scale)) for scale in _SCALES]
    scale_gaussians = 2000  # Gaussians that the scales are tried on
    scores = np.array([_score_frame(inputs, candidate, scale_gaussians) for candidate in scaled])
    two_steps_away = np.maximum(scores[:-4], scores[4:])
    best = scaled[2 + int(np.argmax(scores[2:-2] - two_steps_away))]
    for max_change, num_scales, samples in _FINER if scores.any() else ():
        factors = exp(np.linspace(-max_change, max_change, num_scales))
        best, _ = _best_frame(inputs, [_scale_frame(best, float(factor)) for factor in factors], samples)
    return best


def _solve_shift(inputs: AlignmentInput) -> list[Similarity]:
    """Solve for a shift of the cameras with which the photos show the Gaussians; return a list with one frame, or [].

    The middle of the Gaussians is searched in the picture of the middle camera, at many depths.
    """
    max_views = 4  # views that shifts are tried on
    # number of Gaussians of the first search, and of places that it keeps
    first_samples = 300
    first_places = 8
    some_views = slice(None, None, -(-len(inputs.cameras) // max_views))
    rows = (inputs.gaussians, inputs.valid)
    cameras = inputs.cameras[some_views]
    images = inputs.images[some_views]
    to_world = invert(cameras.viewmats)
    centres, points = to_world[:, :3, 3], inputs.gaussians.means[inputs.valid].astype(np.float64)
    view = int(np.argmin(np.linalg.norm(centres - np.median(centres, 0), axis=1)))
    middle = np.median(points, 0)
    radius = np.median(np.linalg.norm(points - middle, axis=1))
    to_ray = radius * matmul(to_world[view, :3, :3], invert(cameras.Ks[view]))

    def make_frame(place: Sequence[float]) -> Similarity:
        """Return the frame in which the middle of the Gaussians is at a place in the picture; see _PLACES."""
        pixel = np.array([place[0] * cameras.width, place[1] * cameras.height, 1.0])
        shift = middle - centres[view] - matmul(to_ray, pixel) * exp(np.array(place[2]))
        return Similarity(np.eye(3), 1.0, shift, f"moved by {', '.join(f'{number:.10g}' for number in shift)}")

    def score(place: Sequence[float], samples: int) -> float:
        """Return the score of the cameras in the frame of a place, see _PLACES; 0 without colours to compare."""
        check = check_cameras(*rows, make_frame(place).move_cameras(cameras), images, samples)
        return float(np.nan_to_num(check.share_seen * (1 - check.color_ratio)))

    places = sorted(product(*_PLACES), key=lambda place: -score(place, first_samples))
    best: list[tuple[float, ...]] = places[:first_places]
    for samples, count, step in _SHIFT_STEPS:
        # each place is tried, and so are the places one step away along each axis
        offsets = step * np.concatenate([np.zeros((1, 3)), np.diag((1, 1, 2.5)), -np.diag((1, 1, 2.5))])
        around = {tuple((place + offset).tolist()) for place in best for offset in offsets}
        best = sorted(sorted(around), key=lambda place: -score(place, samples))[:count]
    frame = make_frame(best[0])
    views = [(frame.move_cameras(cameras[view : view + 1]), images[view : view + 1]) for view in range(len(cameras))]
    ratios = [check_cameras(*rows, *camera_and_image, foremost=True).color_ratio for camera_and_image in views]
    known = [ratio for ratio in ratios if not np.isnan(ratio)]
    return [frame] if len(known) > 1 and max(known) <= RANDOM_SHARE and np.mean(known) <= MAX_FRONT_RATIO else []
