"""Which row is which pixel, decided by measuring: every layout that the count allows is projected and compared."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from torch import Tensor

from gsmerge.io.alignment import pixel_limit
from gsmerge.io.frame import SAME, Frame, Sightings, candidate_frames, explains, pixel_errors
from gsmerge.io.interleaved import interleaved_layout
from gsmerge.io.layouts import Layout, depth_layout, exact_layouts, relabelled, thinned
from gsmerge.io.pruned import pruned_layout, refined_scale, rough_frames
from gsmerge.types import SH_C0, Cameras, Gaussians

MARGIN = 2.0  # by which the best reading must beat the next one
SHUFFLED_MARGIN = 5.0  # and by which it must beat pixels dealt out at random
_SIMPLER = 1.15  # a simpler frame wins unless it is worse than this factor ...
_SIMPLER_PX = 0.02  # ... and this many pixels
QUICK_SAMPLES, SAMPLES, MIN_SAMPLES = 1500, 6000, 60  # Gaussians that a reading is measured on; per view at least


@dataclass(frozen=True)
class Evidence:
    """One reading of a file, measured.

    Args:
        layout: Which row belongs to which pixel.
        frame: Where the cameras stand in the frame of the Gaussians.
        median_px: Median distance of the projected Gaussians from their pixels; inf where most are behind.
        worst_px: The same of the worst view.
        color_error: Mean distance of the base colours from the photos, 0 to 1; NaN without photos.
        ok: Whether it is near enough to be true.
    """

    layout: Layout
    frame: Frame
    median_px: float
    worst_px: float
    color_error: float
    ok: bool

    @property
    def words(self) -> str:
        """What it is, for people."""
        return ", ".join(part for part in (self.layout.words, self.frame.words) if part)


@dataclass(frozen=True)
class Recovery:
    """The reading that won.

    Args:
        best: The winner.
        runner_up: The next best; None where the count allows no other.
        margin: How many times nearer the winner's Gaussians are to their pixels than the runner-up's, or than
            those of pixels dealt out at random.
    """

    best: Evidence
    runner_up: Evidence | None
    margin: float

    @property
    def words(self) -> str:
        """Which reading won and by how much."""
        other = "pixels dealt out at random" if self.runner_up is None else self.runner_up.words
        return (
            f"{self.best.words}: median {self.best.median_px:.2f} px from the pixels,"
            f" {min(self.margin, 9999):.0f} times nearer than the next reading ({other})"
        )


@dataclass(frozen=True)
class Clues:
    """What there is to recover the pixels from.

    Args:
        gaussians: The file's rows.
        valid: ``[n]`` bool.
        cameras: All cameras at the grid's size, in their own world.
        images: ``[c,h,w,3]``, or None.
        labellings: Orders that the views may be in: the file's, that of the names.
        depths: Reads ``[c,h,w]`` depth maps beside the cameras; None where there are none.
        order: The order of the rows where it is told, otherwise "auto".
        scale: Size of the Gaussians' world in units of the cameras', where it is told.
    """

    gaussians: Gaussians
    valid: Tensor
    cameras: Cameras
    images: Tensor | None
    labellings: Sequence[Sequence[int]]
    depths: Callable[[], np.ndarray | None]
    order: str = "auto"
    scale: float | None = None

    @property
    def viewmats(self) -> np.ndarray:
        """``[c,4,4]`` float64."""
        return np.asarray(self.cameras.viewmats.double().numpy())

    @property
    def Ks(self) -> np.ndarray:  # noqa: N802 - the field's name
        """``[c,3,3]`` float64."""
        return np.asarray(self.cameras.Ks.double().numpy())


def recover(clues: Clues, *, exact_frames: bool = False) -> Recovery | None:
    """The reading under which every Gaussian projects into its own pixel; None where none stands out.

    Args:
        clues: What there is.
        exact_frames: Only look where the cameras stand where their file has them and no pixel is missing: quick.
    """
    if clues.order == "none":
        return None
    layouts = list(_exact(clues))
    found: list[Evidence] = []
    for effort in (0,) if exact_frames else (0, 1, 2):
        if not any(evidence.ok for evidence in found):
            found += [evidence for layout in layouts for evidence in _measured(clues, layout, effort)]
    if not (exact_frames or any(evidence.ok for evidence in found)) and clues.order in ("auto", "view-major"):
        found += _pruned(clues)
    if not (exact_frames or any(evidence.ok for evidence in found)) and clues.order in ("auto", "view-fastest"):
        found += _interleaved(clues)
    found.sort(key=lambda evidence: (not evidence.ok, evidence.worst_px))
    if not found or not found[0].ok:
        return None
    rest = [e for e in found[1:] if _differs(e.layout, found[0].layout)]
    best = _refined(clues, found[0])
    runner_up = min(rest, key=lambda e: e.worst_px, default=None)
    shuffled = _shuffled_px(clues, best)
    floor = max(best.worst_px, 1e-3)
    margin = min(shuffled, math.inf if runner_up is None else runner_up.worst_px) / floor
    if not best.ok or shuffled < SHUFFLED_MARGIN * floor or margin < MARGIN:
        return None
    return Recovery(best, runner_up, margin)


def _exact(clues: Clues) -> Iterator[Layout]:
    cameras, count = clues.cameras, len(clues.gaussians)
    for layout in exact_layouts(count, len(cameras), cameras.width, cameras.height):
        if clues.order in ("auto", layout.order):
            yield layout
    if count < len(cameras) * cameras.width * cameras.height and clues.order in ("auto", "view-major"):
        depths = clues.depths()
        if depths is not None and depths.shape == (len(cameras), cameras.height, cameras.width):
            masked = depth_layout(count, depths)
            if masked is not None:
                yield masked


def _measured(clues: Clues, layout: Layout, effort: int) -> list[Evidence]:
    """The layout under the best frame, for each order that the views may be in.

    Any order at all is tried with the most effort, or where the file lacks views.
    """
    out: dict[tuple[int, ...], Evidence] = {}
    labellings = [[labelling[view] for view in layout.views] for labelling in clues.labellings]
    some = len(set(layout.views)) < len(clues.cameras)
    if (some or effort == 2) and clues.scale is None:
        labellings.append(_nearest_views(clues, layout) or [])
    for views in labellings:
        if views and tuple(views) not in out:
            out[tuple(views)] = _best_frame(clues, relabelled(layout, views), QUICK_SAMPLES, effort)
    return list(out.values())


def _best_frame(clues: Clues, layout: Layout, samples: int, effort: int) -> Evidence:
    seen, colors = sightings(clues, thinned(layout, max(MIN_SAMPLES, samples // len(layout.views))))
    frames = candidate_frames(seen, clues.viewmats, clues.Ks, scale=clues.scale, effort=effort)
    tried = [_evidence(clues, layout, frame, seen, colors) for frame in frames]
    best = min(e.worst_px for e in tried)
    found = next(e for e in tried if e.worst_px <= max(_SIMPLER * best, best + _SIMPLER_PX))
    if found.ok and found.frame is not SAME and clues.scale is None:
        return replace(found, ok=explains(found.frame, seen, clues.viewmats, clues.Ks))
    return found


def _refined(clues: Clues, found: Evidence) -> Evidence:
    """The winner measured again, and its frame solved again, on more Gaussians."""
    if found.layout.kind == "pruned":
        return found
    return _best_frame(clues, found.layout, SAMPLES, 2 if found.frame.kind == "other" else 1)


def sightings(clues: Clues, layout: Layout, *, colored: bool = True) -> tuple[Sightings, np.ndarray | None]:
    """The rows of a layout with their pixels and views, and how far their colours are from the photos."""
    rows, pixels = np.concatenate(layout.rows), np.concatenate(layout.pixels)
    blocks = np.repeat(np.arange(len(layout.views)), [len(some) for some in layout.rows])
    good = clues.valid.numpy()[rows]
    rows, pixels, blocks = rows[good], pixels[good], blocks[good]
    views = np.array(layout.views)[blocks]
    y, x = np.divmod(pixels, layout.width)
    points = clues.gaussians.means.numpy()[rows].astype(np.float64)
    colors = None
    if colored and clues.images is not None:
        base = 0.5 + SH_C0 * clues.gaussians.sh0.numpy()[rows, 0]
        colors = np.abs(base.clip(0, 1) - clues.images.numpy()[views, y, x]).mean(1)
    return Sightings(points, np.stack([x, y], 1) + 0.5, views, blocks), colors


def color_error(clues: Clues, layout: Layout) -> float:
    """Mean distance of the base colours from the photos at a layout's pixels, 0 to 1; NaN without photos."""
    _, colors = sightings(clues, thinned(layout, max(MIN_SAMPLES, SAMPLES // len(layout.views))))
    return math.nan if colors is None or not len(colors) else float(colors.mean())


def _evidence(clues: Clues, layout: Layout, frame: Frame, seen: Sightings, colors: np.ndarray | None) -> Evidence:
    errors = pixel_errors(seen, frame.move_cameras(clues.viewmats), clues.Ks)
    bounds = np.concatenate([[0], np.cumsum(np.bincount(seen.blocks, minlength=len(layout.views)))])
    medians = [float(np.median(errors[a:b])) for a, b in itertools.pairwise(bounds) if b > a]
    median = float(np.median(errors)) if len(errors) else math.inf
    limit = pixel_limit(layout.width, layout.height)
    color_error = math.nan if colors is None or not len(colors) else float(colors.mean())
    ok = bool(medians) and max(medians) < limit and bool(np.isfinite(errors).mean() > 0.5)
    return Evidence(layout, frame, median, max(medians, default=math.inf), color_error, ok)


def _nearest_views(clues: Clues, layout: Layout) -> list[int] | None:
    """For each block the camera into whose pixels it projects best; None where two want the same."""
    small = thinned(layout, 300)
    seen, _ = sightings(clues, replace(small, views=tuple(range(len(small.views)))), colored=False)
    viewmats, Ks = clues.viewmats, clues.Ks
    chosen = []
    for block in range(len(small.views)):
        mine = seen.blocks == block
        if not mine.any():
            return None
        some = Sightings(seen.points[mine], seen.pixels[mine], seen.views[mine], seen.blocks[mine])
        errors = [
            np.median(pixel_errors(replace(some, views=np.full(int(mine.sum()), view)), viewmats, Ks))
            for view in range(len(viewmats))
        ]
        chosen.append(int(np.argmin(errors)))
    distinct = len(set(chosen)) * layout.per_pixel == len(chosen)
    return chosen if distinct else None


def _pruned(clues: Clues) -> list[Evidence]:
    """Readings of a file that lacks pixels, nobody knows which."""
    cameras, n = clues.cameras, len(clues.gaussians)
    valid = np.flatnonzero(clues.valid.numpy())
    if n >= len(cameras) * cameras.width * cameras.height:
        return []
    points = clues.gaussians.means.double().numpy()[valid]
    out = []
    for frame in rough_frames(points, clues.viewmats, clues.Ks, cameras.width, cameras.height, clues.scale):
        for _ in range(1 if frame is SAME or clues.scale else 3):
            moved = frame.move_cameras(clues.viewmats)
            layout = pruned_layout(points, moved, clues.Ks, cameras.width, cameras.height)
            if layout is None:
                break
            layout = replace(layout, rows=tuple(valid[rows] for rows in layout.rows))
            seen, colors = sightings(clues, thinned(layout, max(MIN_SAMPLES, SAMPLES // len(layout.views))))
            out.append(_evidence(clues, layout, frame, seen, colors))
            finer = None if frame is SAME or clues.scale else refined_scale(seen, clues.viewmats, clues.Ks)
            if finer is None:
                break
            frame = finer
        if out and out[-1].ok:
            break
    return out


def _interleaved(clues: Clues) -> list[Evidence]:
    """The reading of a file that lacks pixels and has the views of one pixel side by side."""
    cameras = clues.cameras
    valid = np.flatnonzero(clues.valid.numpy())
    if len(clues.gaussians) >= len(cameras) * cameras.width * cameras.height:
        return []
    frame = SAME if clues.scale is None else Frame(np.eye(3), clues.scale, np.zeros(3), "scaled, as told", "scaled")
    points = clues.gaussians.means.double().numpy()[valid]
    layout = interleaved_layout(points, frame.move_cameras(clues.viewmats), clues.Ks, cameras.width, cameras.height)
    if layout is None:
        return []
    layout = replace(layout, rows=tuple(valid[rows] for rows in layout.rows))
    seen, colors = sightings(clues, thinned(layout, max(MIN_SAMPLES, SAMPLES // len(layout.views))))
    return [_evidence(clues, layout, frame, seen, colors)]


def _differs(one: Layout, other: Layout) -> bool:
    """Whether two layouts put rows to different pixels; looked at in some rows of each block."""
    if one.views != other.views or [r.size for r in one.rows] != [r.size for r in other.rows]:
        return True
    a, b = thinned(one, 200), thinned(other, 200)
    return not all(np.array_equal(x, y) for x, y in zip((*a.rows, *a.pixels), (*b.rows, *b.pixels), strict=True))


def _shuffled_px(clues: Clues, best: Evidence) -> float:
    """Median distance in pixels if the winner's pixels were dealt out at random within each view."""
    seen, _ = sightings(clues, thinned(best.layout, max(MIN_SAMPLES, SAMPLES // len(best.layout.views))))
    rng, pixels = np.random.default_rng(0), seen.pixels.copy()
    for view in np.unique(seen.views):
        mine = np.flatnonzero(seen.views == view)
        pixels[mine] = pixels[rng.permutation(mine)]
    errors = pixel_errors(replace(seen, pixels=pixels), best.frame.move_cameras(clues.viewmats), clues.Ks)
    return float(np.median(errors))


__all__ = ["MARGIN", "Clues", "Evidence", "Recovery", "color_error", "recover", "sightings"]
