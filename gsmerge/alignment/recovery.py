"""Recover the pixel of each row: project every layout that the number of rows allows, and compare; or explain."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from gsmerge.alignment.cameras import other_conventions
from gsmerge.alignment.incomplete import score_incomplete
from gsmerge.alignment.layouts import MAY_BE_UNALIGNED, Layout, depth_layouts, exact_layouts, plain_layout, subsample
from gsmerge.alignment.resection import projective_error
from gsmerge.alignment.score import (
    MARGIN,
    QUICK_SAMPLES,
    SAMPLES,
    Alignment,
    AlignmentInput,
    AlignmentScore,
    candidate_similarities,
    check_alignment,
    check_pairs,
    color_error,
    fits_all_cameras,
    pixel_errors,
    pixel_limit,
    sample_layout,
    sample_pixels,
    score_layout,
    score_shuffled,
    solve_pose,
)
from gsmerge.errors import SceneError
from gsmerge.geometry import IDENTITY
from gsmerge.io.cameras.camera_file import CameraFile, Convention
from gsmerge.io.formats.read import FileInfo as PlyInfo
from gsmerge.io.photo_files import ASPECT_TOLERANCE
from gsmerge.kernels.matrices import matmul
from gsmerge.types import Cameras, Gaussians

SHUFFLED_MARGIN = 5.0  # and by which it must beat shuffled pixels
COLOR_MARGIN = 1.5  # by which the colours must beat the next reading's and shuffled ones, where pixels do not decide
ENOUGH, FEW = 24, 0.05  # finite rows that decide between readings; fewer will do where they are no such small share
_UNCONFIRMED = 0.9  # of the colours' distance from shuffled pixels: as good as random
_VARIES = 0.01  # mean distance of colours from shuffled pixels below which photos say nothing
_SIMPLER = 1.15  # a simpler frame wins unless it is worse than this factor ...
_SIMPLER_PX = 0.02  # ... and this many pixels
_PLAIN_PX = 0.5  # a file whose rows are the grid as they are is not searched if it is this near to its pixels
# pixels from which no camera sees the rows of a layout: times the limit, and share of the shorter side
_SEEN_LIMITS, _SEEN_SHARE = 2.0, 0.03
_SEEN_SAMPLES = 200  # Gaussians of a view that it is judged by
_SMALLEST_PX = 1e-3  # distances are compared as if none were smaller, pixels


@dataclass(frozen=True)
class Recovery:
    """The winning reading of the rows, with its margin."""

    best: AlignmentScore
    runner_up: AlignmentScore | None  # the next best; None where the count allows no other
    # how many times nearer the winner's Gaussians are to their pixels than the runner-up's, or than to shuffled pixels
    margin: float
    # how many times farther from the photos the runner-up's colours are, where only that decides between the two; None
    # where the pixels do
    color_margin: float | None = None
    # whether the photos' colours agree with the reading; None where there are no photos, or none that could decide
    confirmed: bool | None = None

    @property
    def description(self) -> str:
        """Words for the reading and its margin."""
        other = "shuffled pixels" if self.runner_up is None else self.runner_up.description
        text = f"{self.best.description}: median {self.best.median_px:.2f} px from the pixels, "
        if self.color_margin is None:
            text += f"{min(self.margin, 9999):.0f} times nearer than the next reading ({other})"
        else:
            text += f"and the photos' colours {min(self.color_margin, 9999):.1f} times nearer than under the next"
            text += f" reading ({other}), which fits the pixels as well"
        return text + ("; the photos' colours do not confirm it" if self.confirmed is False else "")


def recover(inputs: AlignmentInput, *, exact_frames: bool = False) -> Recovery | None:
    """Find the reading under which every Gaussian projects into its own pixel; None where none stands out.

    Of readings about equally near to the pixels, the photos' colours choose one. With ``exact_frames`` only cameras
    in the frame of their file and files without missing pixels are considered: quick.
    """
    finite = int(inputs.valid.sum())
    if inputs.order == "none" or (finite < ENOUGH and finite < FEW * len(inputs.gaussians)):
        return None
    inputs = _without_same_labellings(inputs)
    plain = _recover_plain(inputs)
    if plain is not None:
        return plain
    scores: list[AlignmentScore] = []
    layouts = possible_layouts(inputs)
    searched = (0,) if exact_frames or not is_seen(inputs, layouts) else (0, 1, 2)
    for effort in searched:
        if not any(score.ok for score in scores):
            scores += [score for layout in layouts for score in _score_labellings(inputs, layout, effort)]
    if not (exact_frames or any(score.ok for score in scores)):
        scores += score_incomplete(inputs)
    scores.sort(key=lambda score: (not score.ok, score.worst_px))
    if not scores or not scores[0].ok:
        return None
    first, *others = scores
    others = [other for other in others if _differs(other.layout, first.layout)]
    best = _refine(inputs, first)
    close = [other for other in others if other.worst_px < MARGIN * max(best.worst_px, _SMALLEST_PX)]
    if close:
        return _choose_by_colors(inputs, [first, *close])
    runner_up = min(others, key=lambda e: e.worst_px, default=None)
    return _accept(inputs, best, runner_up)


def is_seen(inputs: AlignmentInput, layouts: Sequence[Layout]) -> bool:
    """Return whether any camera at all, in any frame, could show the rows of one of the layouts in their pixels."""
    return any(_is_seen(inputs, layout) for layout in layouts)


def _is_seen(inputs: AlignmentInput, layout: Layout) -> bool:
    limit = max(_SEEN_LIMITS * pixel_limit(layout.width, layout.height), _SEEN_SHARE * min(layout.width, layout.height))
    count = len(layout.views)
    for block in sorted({0, count // 2, count - 1}):
        one = replace(layout, views=(0,), rows=layout.rows[block : block + 1], pixels=layout.pixels[block : block + 1])
        pairs = inputs.pairs(subsample(one, _SEEN_SAMPLES))
        if projective_error(pairs.points, pairs.pixels) <= limit:
            return True
    return False


def _without_same_labellings(inputs: AlignmentInput) -> AlignmentInput:
    """Drop orders that only exchange views of one pose with equal photos, or without any: either is right."""
    cameras, images, (first, *others) = inputs.cameras, inputs.images, inputs.labellings
    facts = np.concatenate([cameras.viewmats[:, :3].reshape(-1, 12), cameras.Ks.reshape(-1, 9)], 1)

    def same(other: Sequence[int]) -> bool:
        moved = [(a, b) for a, b in zip(first, other, strict=True) if a != b]
        alike = images is None or all(np.array_equal(images[a], images[b]) for a, b in moved)
        return alike and all(np.array_equal(facts[a], facts[b]) for a, b in moved)

    return replace(inputs, labellings=[first, *(first if same(other) else other for other in others)])


def _accept(inputs: AlignmentInput, best: AlignmentScore, runner_up: AlignmentScore | None) -> Recovery | None:
    """Accept a reading that the pixels alone decide for; None where shuffled pixels are about as near."""
    shuffled_px, shuffled_color = score_shuffled(inputs, best)
    if not _stands_out(best, shuffled_px):
        return None
    next_px = min(shuffled_px, math.inf if runner_up is None else runner_up.worst_px)
    margin = next_px / max(best.worst_px, _SMALLEST_PX)
    confirmed = None  # where colours hardly vary, or there are no photos
    if shuffled_color > _VARIES:
        confirmed = color_error(inputs, best.layout) <= _UNCONFIRMED * shuffled_color
    return Recovery(best, runner_up, margin, None, confirmed)


def _recover_plain(inputs: AlignmentInput) -> Recovery | None:
    """Take the rows in order under the stored cameras, as most files need; None in doubt, for a longer search."""
    cameras, count = inputs.cameras, len(inputs.gaussians)
    expected = len(cameras) * cameras.width * cameras.height
    if inputs.order not in ("auto", "view-major") or inputs.scale is not None or count != expected:
        return None
    layout = plain_layout(len(cameras), cameras.width, cameras.height)
    best, *others = (
        score_layout(inputs, replace(layout, views=views), IDENTITY)
        for views in dict.fromkeys(map(tuple, inputs.labellings))
    )
    distance = max(best.worst_px, _SMALLEST_PX)
    if best.worst_px > _PLAIN_PX or any(other.worst_px < SHUFFLED_MARGIN * distance for other in others):
        return None
    return _accept(inputs, best, None)


def _choose_by_colors(inputs: AlignmentInput, close: list[AlignmentScore]) -> Recovery | None:
    """Choose the reading whose colours the photos have by far, of several about equally near to their pixels."""
    ranked = sorted((color_error(inputs, score.layout), i) for i, score in enumerate(close))
    (color, first), (next_color, second) = ranked[:2]
    best, runner_up = _refine(inputs, close[first]), close[second]
    shuffled_px, shuffled_color = score_shuffled(inputs, best)
    others = min(next_color, shuffled_color)  # NaN without photos, which no comparison holds for
    if not (_stands_out(best, shuffled_px) and others > _VARIES and others >= COLOR_MARGIN * color):
        return None
    margin = min(shuffled_px, runner_up.worst_px) / max(best.worst_px, _SMALLEST_PX)
    return Recovery(best, runner_up, margin, others / max(color, 1e-3), True)


def _stands_out(best: AlignmentScore, shuffled_px: float) -> bool:
    """Return whether a reading is near to its pixels, and shuffled pixels are far from them."""
    return best.ok and shuffled_px >= SHUFFLED_MARGIN * max(best.worst_px, _SMALLEST_PX)


def possible_layouts(inputs: AlignmentInput) -> list[Layout]:
    """List the layouts that the number of rows allows, or the depth maps next to the cameras."""
    cameras, count = inputs.cameras, len(inputs.gaussians)
    layouts = list(exact_layouts(count, len(cameras), cameras.width, cameras.height))
    if count < len(cameras) * cameras.width * cameras.height and inputs.order in ("auto", "view-major"):
        depths = inputs.depths()
        if depths is not None and depths.shape == (len(cameras), cameras.height, cameras.width):
            layouts += depth_layouts(count, depths)
    return [layout for layout in layouts if inputs.order in ("auto", layout.order)]


def _score_labellings(inputs: AlignmentInput, layout: Layout, effort: int) -> list[AlignmentScore]:
    """Score the layout under the best frame for each likely order of the views; any order with effort 2."""
    out: dict[tuple[int, ...], AlignmentScore] = {}
    labellings = [[labelling[view] for view in layout.views] for labelling in inputs.labellings]
    lacks_views = len(set(layout.views)) < len(inputs.cameras)
    if (lacks_views or effort == 2) and inputs.scale is None:
        labellings.append(_nearest_views(inputs, layout) or [])
    for labelling in labellings:
        views = tuple(labelling)
        if views and views not in out:
            out[views] = _best_frame(inputs, replace(layout, views=views), QUICK_SAMPLES, effort)
    return list(out.values())


def _best_frame(inputs: AlignmentInput, layout: Layout, samples: int, effort: int) -> AlignmentScore:
    pairs = inputs.pairs(sample_layout(layout, samples))
    frames = candidate_similarities(pairs, inputs.cameras, scale=inputs.scale, effort=effort)
    scores = [score_layout(inputs, layout, frame, pairs) for frame in frames]
    lowest = min(score.worst_px for score in scores)
    best = next(score for score in scores if score.worst_px <= max(_SIMPLER * lowest, lowest + _SIMPLER_PX))
    if best.ok and best.frame is not IDENTITY and inputs.scale is None:
        return replace(best, ok=fits_all_cameras(best.frame, pairs, inputs.cameras))
    return best


def _refine(inputs: AlignmentInput, score: AlignmentScore) -> AlignmentScore:
    """Score the winner again, and solve its frame again, on more Gaussians."""
    if score.layout.kind == "pruned":
        return score
    return _best_frame(inputs, score.layout, SAMPLES, 2 if score.frame.kind == "other" else 1)


def _nearest_views(inputs: AlignmentInput, layout: Layout) -> list[int] | None:
    """Find for each block the camera into whose pixels it projects best; None where two choose the same."""
    pairs = inputs.pairs(subsample(layout, 300))
    chosen = []
    for block in range(len(layout.views)):
        own = pairs.select(pairs.blocks == block)
        if not len(own.rows):
            return None
        views = (np.full(len(own.rows), view) for view in range(len(inputs.cameras)))
        errors = [np.median(pixel_errors(replace(own, views=some), inputs.cameras)) for some in views]
        chosen.append(int(np.argmin(errors)))
    return chosen if len(set(chosen)) * layout.per_pixel == len(chosen) else None


def _differs(one: Layout, other: Layout) -> bool:
    """Return whether two layouts put rows to different pixels, judged by some rows of each block."""
    if one.views != other.views or [r.size for r in one.rows] != [r.size for r in other.rows]:
        return True
    a, b = subsample(one, 200), subsample(other, 200)
    return not all(np.array_equal(x, y) for x, y in zip((*a.rows, *a.pixels), (*b.rows, *b.pixels), strict=True))


def explain_count(ply: PlyInfo, inputs: AlignmentInput, camera_file: CameraFile) -> SceneError:
    """Make the SceneError of rows that are no pixels; raise it where other cameras would make pixels of them."""
    cameras, count = inputs.cameras, len(inputs.gaussians)
    views, width, height = len(cameras), cameras.width, cameras.height
    expected = f"{views} x {height} x {width} = {views * height * width} (views x height x width)"
    problem = f"expected one Gaussian per pixel, {expected}, found {ply.count}"
    if inputs.order not in MAY_BE_UNALIGNED:
        if count == views * width * height:
            rows = inputs.gaussians, cameras, inputs.valid
            alignment = check_alignment(*rows)
            reason = explain_misalignment(*rows, camera_file.convention)
            pairs = sample_pixels(*rows)
            pairs = pairs.select(pairs.views == 0)
            pose = None if reason else solve_pose(pairs, 0, cameras.Ks[0])
            # a pose that takes up most of wrong intrinsics, too, shows that the rows are pixels of some camera
            posed = None if pose is None else replace(cameras[:1], viewmats=pose[None])
            is_grid = posed is not None and np.median(pixel_errors(pairs, posed)) < 4 * alignment.limit_px
            if reason or is_grid:
                raise misalignment_error(camera_file.path, alignment, reason)
            problem = f"expected one Gaussian per pixel, found {ply.count} rows that are in no known order"
        elif count > views * width * height and count % (width * height) == 0:
            size = views * width * height
            first = replace(inputs, gaussians=inputs.gaussians[:size], valid=inputs.valid[:size], order="view-major")
            if recover(first) is not None:  # more views than cameras, the first in order
                raise SceneError(ply.path, problem, _count_remedy(ply.count, cameras))
    return SceneError(ply.path, problem, _count_remedy(ply.count, cameras))


def _count_remedy(count: int, cameras: Cameras) -> str:
    """Name the simple reading that the number of Gaussians has instead."""
    views, width, height = len(cameras), cameras.width, cameras.height
    pixels = width * height
    if count % (views * pixels) == 0:
        return f"that is {count // (views * pixels)} Gaussians per pixel"
    if count % pixels == 0:
        return f"that is {count // pixels} views of this size: give the cameras of just those"
    if count == views * (width - 16) * (height - 16):
        return f"that is {height - 16} x {width - 16} per view: 8 pixels were trimmed at every border"
    each = count / views
    guess = round((each * width / height) ** 0.5)
    for w in range(max(1, guess - 14), guess + 15):
        h = each / w
        if h == round(h) and h and abs(w * height / (h * width) - 1) < ASPECT_TOLERANCE:
            return f"that is {round(h)} x {w} per view: give cameras and images of that size"
    if count < views * pixels:
        return "pixels were dropped or merged by the exporter, which is not supported"
    return "give the cameras and images that belong to it"


def misalignment_error(path: str, alignment: Alignment, reason: str | None) -> SceneError:
    """Make the SceneError of enough rows that lie on no pixels' rays, or as well on those of others."""
    if alignment.ok:
        problem = f"expected rows that fit the pixels in one way, found several that do, to {alignment.worst_px:.1f} px"
        return SceneError(path, problem, "name the order of the rows with --hint order=NAME")
    problem = (
        f"expected every view's Gaussians within {alignment.limit_px:g} px of their own pixels, "
        f"found a median of up to {alignment.worst_px:.1f} px and "
        f"{100 * alignment.share_in_front:.0f} % in front of their camera"
    )
    unknown = "no other convention fits either: give the cameras that belong to the Gaussians"
    return SceneError(path, problem, f"{reason}: convert one to the other" if reason else unknown)


def explain_misalignment(
    gaussians: Gaussians, cameras: Cameras, valid: np.ndarray, convention: Convention
) -> str | None:
    """Name another reading of cameras or row order under which the scene fits; None without one."""
    pairs = sample_pixels(gaussians, cameras, valid)
    given = cameras.viewmats
    frames = candidate_similarities(pairs, cameras, effort=1)
    others = [(poses.describe(convention), poses.viewmats) for poses in other_conventions(given, convention)]
    transposed = given.copy()
    transposed[:, :3, :3] = given[:, :3, :3].transpose(0, 2, 1)
    transposed[:, :3, 3] = -matmul(transposed[:, :3, :3], cameras.centres[:, :, None])[..., 0]
    others.append(("the cameras fit with their rotations transposed", transposed))
    flips = (1, "y axis flipped (rows counted from the bottom)"), (0, "x axis flipped (mirrored images)")
    for axis, words in flips:
        mirrored = given.copy()
        mirrored[:, axis] *= -1
        others.append((f"the cameras fit with the {words}", mirrored))
    scaled = [f for f in frames if f.kind == "scaled"]
    others += [(f"the cameras fit with their {f.description}", f.move_viewmats(given)) for f in scaled]
    for reason, viewmats in others:
        if check_pairs(pairs, replace(cameras, viewmats=viewmats)).ok:
            return reason
    views, height, width = len(cameras), cameras.height, cameras.width
    rows = np.arange(views * height * width)
    by_pixel, by_column = rows.reshape(height, width, views), rows.reshape(views, width, height)
    for reason, order in (
        ("in the order row, column, view (view fastest)", by_pixel.transpose(2, 0, 1)),
        ("in the order view, column, row (column-major)", by_column.transpose(0, 2, 1)),
        ("with the views in reverse order", rows.reshape(views, -1)[::-1]),
    ):
        order = order.reshape(-1)
        if check_alignment(gaussians[order], cameras, valid.reshape(-1)[order]).ok:
            return f"the rows fit {reason}"
    swapped = replace(cameras, width=cameras.height, height=cameras.width)
    if check_alignment(gaussians, swapped, valid).ok:
        return "the cameras fit with width and height swapped"
    return None
