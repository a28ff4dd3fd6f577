"""Recover the pixel of each row: project every layout that the number of rows allows, and compare; or explain."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from gsmerge.alignment.cameras import describe_reading, other_conventions
from gsmerge.alignment.incomplete import read_incomplete
from gsmerge.alignment.layouts import MAY_BE_UNALIGNED, Layout, depth_layouts, exact_layouts, plain_layout, subsample
from gsmerge.alignment.resection import projective_error
from gsmerge.alignment.score import (
    MARGIN,
    MAX_CHECKED,
    QUICK_SAMPLES,
    SAMPLES,
    Alignment,
    AlignmentInput,
    Reading,
    candidate_similarities,
    check_alignment,
    check_pairs,
    color_error,
    find_correspondences,
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
from gsmerge.geometry import IDENTITY, median
from gsmerge.io.cameras.camera_file import CameraFile, Convention
from gsmerge.io.formats.read import FileInfo
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
SMALLEST_PX = 1e-3  # distances are compared as if none were smaller, pixels
_ORDERS = {  # in which rows may be instead, by the order of their layout
    "view-fastest": "in the order row, column, view (view fastest)",
    "column-major": "in the order view, column, row (column-major)",
    "reversed": "with the views in reverse order",
}


@dataclass(frozen=True)
class Recovery:
    """The best reading of the rows, and how clearly it beats the next best."""

    best: Reading
    runner_up: Reading | None  # the next best; None where the count allows no other
    # how many times nearer the winner's Gaussians are to their pixels than the runner-up's, or than to shuffled pixels
    margin: float
    # how many times farther from the photos the runner-up's colours are, where only that decides between the two; None
    # where the pixels do
    color_margin: float | None = None
    # whether the photos' colours agree with the reading; None where there are no photos, or none that could decide
    confirmed: bool | None = None

    @property
    def description(self) -> str:
        """Description of the reading and its margin in words."""
        other = "shuffled pixels" if self.runner_up is None else self.runner_up.description
        text = f"{self.best.description}: median {self.best.median_px:.2f} px from the pixels, "
        if self.color_margin is None:
            text += f"{min(self.margin, 9999):.0f} times nearer than the next reading ({other})"
        else:
            text += f"and the photos' colours {min(self.color_margin, 9999):.1f} times nearer than under the next"
            text += f" reading ({other}), which fits the pixels as well"
        return text + ("; the photos' colours do not confirm it" if self.confirmed is False else "")


def recover(inputs: AlignmentInput, *, exact_frames: bool = False) -> Recovery | None:
    """Find the reading under which every Gaussian projects into its own pixel; None if no reading stands out.

    ``exact_frames``: only try cameras in the frame of their file and files without missing pixels, which is quick.
    """
    finite = int(inputs.valid.sum())
    if inputs.order == "none" or (finite < ENOUGH and finite < FEW * len(inputs.gaussians)):
        return None
    inputs = _without_same_labellings(inputs)
    plain = _read_plain(inputs)
    recovery = None if plain is None else _accept(inputs, [plain])
    if recovery is not None:
        return recovery
    readings: list[Reading] = []
    for tier in _readings(inputs, exact_frames=exact_frames):
        readings += tier
        if any(reading.ok for reading in readings):
            return _accept(inputs, readings)
    return None


def _read_plain(inputs: AlignmentInput) -> Reading | None:
    """Read the rows in order under the stored cameras, as most files need; None in doubt, for a longer search."""
    cameras, count = inputs.cameras, len(inputs.gaussians)
    expected = len(cameras) * cameras.width * cameras.height
    if inputs.order not in ("auto", "view-major") or inputs.scale is not None or count != expected:
        return None
    layouts = plain_layout(len(cameras), cameras.width, cameras.height).with_views_in(inputs.labellings)
    best, *others = (score_layout(inputs, layout, IDENTITY) for layout in layouts)
    far = SHUFFLED_MARGIN * max(best.worst_px, SMALLEST_PX)
    return best if best.worst_px <= _PLAIN_PX and all(other.worst_px >= far for other in others) else None


def _readings(inputs: AlignmentInput, *, exact_frames: bool) -> Iterator[list[Reading]]:
    """Yield readings, those side by side that cost as much, the cheap first."""
    layouts = possible_layouts(inputs)
    for effort in (0,) if exact_frames or not is_seen(inputs, layouts) else (0, 1, 2):
        yield [reading for layout in layouts for reading in _read_layout(inputs, layout, effort)]
    if not exact_frames:
        yield from ([reading] for reading in read_incomplete(inputs) if reading is not None)


def _accept(inputs: AlignmentInput, readings: Sequence[Reading]) -> Recovery | None:
    """Accept the reading that is nearest to its pixels, by far; None where none is.

    Of readings about equally near, the one whose colours the photos have by far is accepted.
    """
    first, *others = sorted(readings, key=lambda reading: (not reading.ok, reading.worst_px))
    if not first.ok:
        return None
    others = [other for other in others if _differs(other.layout, first.layout)]
    best, runner_up = _refine(inputs, first), min(others, key=lambda other: other.worst_px, default=None)
    close = [other for other in others if other.worst_px < MARGIN * max(best.worst_px, SMALLEST_PX)]
    if close:
        close = [first, *close]
        colors = [color_error(inputs, reading.layout) for reading in close]
        chosen, second = sorted(range(len(close)), key=lambda i: (colors[i], i))[:2]
        best, runner_up = _refine(inputs, close[chosen]), close[second]
    shuffled_px, shuffled_color = score_shuffled(inputs, best)
    px = max(best.worst_px, SMALLEST_PX)
    if not (best.ok and shuffled_px >= SHUFFLED_MARGIN * px):
        return None
    margin = min(shuffled_px, math.inf if runner_up is None else runner_up.worst_px) / px
    if not close:
        confirmed = None  # where colours hardly vary, or there are no photos
        if shuffled_color > _VARIES:
            confirmed = color_error(inputs, best.layout) <= _UNCONFIRMED * shuffled_color
        return Recovery(best, runner_up, margin, None, confirmed)
    color, next_color = colors[chosen], min(colors[second], shuffled_color)  # NaN without photos: nothing is accepted
    if not (next_color > _VARIES and next_color >= COLOR_MARGIN * color):
        return None
    return Recovery(best, runner_up, margin, next_color / max(color, 1e-3), True)


def is_seen(inputs: AlignmentInput, layouts: Sequence[Layout]) -> bool:
    """Return whether some camera, in any frame, could show the rows of one of the layouts in their pixels."""
    return any(_is_seen(inputs, layout) for layout in layouts)


def _is_seen(inputs: AlignmentInput, layout: Layout) -> bool:
    limit = max(_SEEN_LIMITS * pixel_limit(layout.width, layout.height), _SEEN_SHARE * min(layout.width, layout.height))
    count = len(layout.views)
    for block in sorted({0, count // 2, count - 1}):
        part = replace(layout, views=(0,), rows=layout.rows[block : block + 1], pixels=layout.pixels[block : block + 1])
        pairs = inputs.pairs(subsample(part, _SEEN_SAMPLES))
        if projective_error(pairs.points, pairs.pixels) <= limit:
            return True
    return False


def _without_same_labellings(inputs: AlignmentInput) -> AlignmentInput:
    """Drop orders that only exchange views of one pose with equal photos, or without any: either is right."""
    cameras, images, (first, *labellings) = inputs.cameras, inputs.images, inputs.labellings
    facts = np.concatenate([cameras.viewmats[:, :3].reshape(-1, 12), cameras.Ks.reshape(-1, 9)], 1)

    def same(other: Sequence[int]) -> bool:
        moved = [(a, b) for a, b in zip(first, other, strict=True) if a != b]
        alike = images is None or all(np.array_equal(images[a], images[b]) for a, b in moved)
        return alike and all(np.array_equal(facts[a], facts[b]) for a, b in moved)

    return replace(inputs, labellings=[first, *(first if same(other) else other for other in labellings)])


def possible_layouts(inputs: AlignmentInput) -> list[Layout]:
    """List the layouts that fit the number of rows, or the depth maps next to the cameras."""
    cameras, count = inputs.cameras, len(inputs.gaussians)
    layouts = list(exact_layouts(count, len(cameras), cameras.width, cameras.height))
    if count < len(cameras) * cameras.width * cameras.height and inputs.order in ("auto", "view-major"):
        depths = inputs.depths()
        if depths is not None and depths.shape == (len(cameras), cameras.height, cameras.width):
            layouts += depth_layouts(count, depths)
    return [layout for layout in layouts if inputs.order in ("auto", layout.order)]


def _read_layout(inputs: AlignmentInput, layout: Layout, effort: int) -> list[Reading]:
    """Score a layout in its best frame for each likely order of the views; any order with effort 2."""
    layouts = {labelled.views: labelled for labelled in layout.with_views_in(inputs.labellings)}
    lacks_views = len(set(layout.views)) < len(inputs.cameras)
    nearest = _nearest_views(inputs, layout) if (lacks_views or effort == 2) and inputs.scale is None else None
    if nearest is not None:
        layouts.setdefault(nearest, replace(layout, views=nearest))
    return [_best_frame(inputs, labelled, QUICK_SAMPLES, effort) for labelled in layouts.values()]


def _best_frame(inputs: AlignmentInput, layout: Layout, samples: int, effort: int) -> Reading:
    pairs = inputs.pairs(sample_layout(layout, samples))
    frames = candidate_similarities(pairs, inputs.cameras, scale=inputs.scale, effort=effort)
    readings = [score_layout(inputs, layout, frame, pairs) for frame in frames]
    lowest = min(reading.worst_px for reading in readings)
    best = next(reading for reading in readings if reading.worst_px <= max(_SIMPLER * lowest, lowest + _SIMPLER_PX))
    solved = best.ok and best.frame is not IDENTITY and inputs.scale is None
    ok = fits_all_cameras(best.frame, pairs, inputs.cameras) if solved else best.ok
    return replace(best, ok=ok, quick=samples < SAMPLES)


def _refine(inputs: AlignmentInput, reading: Reading) -> Reading:
    """Score a reading again, and solve its frame again, on more Gaussians if they were few."""
    effort = 2 if reading.frame.kind == "other" else 1
    return _best_frame(inputs, reading.layout, SAMPLES, effort) if reading.quick else reading


def _nearest_views(inputs: AlignmentInput, layout: Layout) -> tuple[int, ...] | None:
    """Find for each block the camera into whose pixels it projects best; None where two choose the same."""
    pairs = inputs.pairs(subsample(layout, 300))
    chosen = []
    for block in range(len(layout.views)):
        block_pairs = pairs.select(pairs.blocks == block)
        if not len(block_pairs.rows):
            return None
        views = (np.full(len(block_pairs.rows), view) for view in range(len(inputs.cameras)))
        errors = [median(pixel_errors(replace(block_pairs, views=view_ids), inputs.cameras)) for view_ids in views]
        chosen.append(int(np.argmin(errors)))
    return tuple(chosen) if len(set(chosen)) * layout.per_pixel == len(chosen) else None


def _differs(layout: Layout, other: Layout) -> bool:
    """Return whether two layouts put rows to different pixels, judged by some rows of each block."""
    if layout.views != other.views or [r.size for r in layout.rows] != [r.size for r in other.rows]:
        return True
    a, b = subsample(layout, 200), subsample(other, 200)
    return not all(np.array_equal(x, y) for x, y in zip((*a.rows, *a.pixels), (*b.rows, *b.pixels), strict=True))


def explain_count(ply: FileInfo, inputs: AlignmentInput, camera_file: CameraFile) -> SceneError:
    """Return the SceneError for rows that are not pixels; raise it at once if the cameras are wrong, not the rows."""
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
            is_grid = posed is not None and median(pixel_errors(pairs, posed)) < 4 * alignment.limit_px
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
        return "pixels were dropped or merged: give cameras in the frame of the file, or export all pixels"
    return "give the cameras and images that belong to it"


def misalignment_error(path: str, alignment: Alignment, reason: str | None) -> SceneError:
    """Make the SceneError for rows as many as pixels, that fit no pixels or fit in several ways."""
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
    """Name another reading of cameras or row order that fits the scene; None if none does."""
    pairs = sample_pixels(gaussians, cameras, valid)
    input_viewmats = cameras.viewmats
    frames = candidate_similarities(pairs, cameras, effort=1)
    readings = [
        (describe_reading(poses.convention, convention), poses.viewmats)
        for poses in other_conventions(input_viewmats, convention)
    ]
    transposed = input_viewmats.copy()
    transposed[:, :3, :3] = input_viewmats[:, :3, :3].transpose(0, 2, 1)
    transposed[:, :3, 3] = -matmul(transposed[:, :3, :3], cameras.centres[:, :, None])[..., 0]
    readings.append(("the cameras fit with their rotations transposed", transposed))
    flips = (1, "y axis flipped (rows counted from the bottom)"), (0, "x axis flipped (mirrored images)")
    for axis, words in flips:
        mirrored = input_viewmats.copy()
        mirrored[:, axis] *= -1
        readings.append((f"the cameras fit with the {words}", mirrored))
    scaled = [f for f in frames if f.kind == "scaled"]
    readings += [(f"the cameras fit with their {f.description}", f.move_viewmats(input_viewmats)) for f in scaled]
    for reason, viewmats in readings:
        if check_pairs(pairs, replace(cameras, viewmats=viewmats)).ok:
            return reason
    size = len(cameras), cameras.width, cameras.height
    full = [grid for grid in exact_layouts(len(gaussians), *size) if grid.kind == "full" and grid.per_pixel == 1]
    plain = plain_layout(*size)
    for layout in (*full, replace(plain, order="reversed", views=plain.views[::-1])):
        pairs = find_correspondences(gaussians.means, valid.reshape(-1), subsample(layout, MAX_CHECKED))
        if layout.order in _ORDERS and check_pairs(pairs, cameras).ok:
            return f"the rows fit {_ORDERS[layout.order]}"
    swapped = replace(cameras, width=cameras.height, height=cameras.width)
    if check_alignment(gaussians, swapped, valid).ok:
        return "the cameras fit with width and height swapped"
    return None
