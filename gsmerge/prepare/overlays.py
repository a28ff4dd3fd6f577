"""Scene with photos -> the scene without what all photos show at the same pixels: logos, letters, borders, a bonnet.

Another photo predicts the pixels of a photo in two ways: by its own pixel at the same place, and by the pixel at which
its view sees the Gaussian of the first one, as it lies or as far as sky. Of a scene the second is right, or both are
alike, as in a plain sky. Of an overlay the first is right, in every photo. Values that are compared are colours and
slopes of brightness, since a half transparent mark has its own slopes, but no colour of its own.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from gsmerge.arrays import max_columns, mean_columns
from gsmerge.frozen import dataclass, replace
from gsmerge.method.compare.view_pictures import fit_size
from gsmerge.method.geometry.transforms import median, medians, project
from gsmerge.method.geometry.views import even_views, take_rows
from gsmerge.method.kernels.pictures import blur, sample_bilinear, sobel
from gsmerge.method.raster.photos import counting_pixels, pixel_weights
from gsmerge.prepare.photo_change import KEEP
from gsmerge.types import PicturedScene

LEAST_VIEWS = 4  # of fewer photos, chance makes two alike
MOST_VIEWS = 12  # photos that are compared
PARTNERS = 5  # other photos that predict a photo
QUICK_PARTNERS = 2  # of the first look, at every second pixel, which ends the search in nearly all scenes
SIDE = 160  # longer side of the small photos that are compared, pixels
# Two places of one small photo show the same thing if they are nearer (sum of the distances to the right and down,
# small pixels), so that the two predictions cannot be told apart
MOVED = 2.0
BETTER = 2.0  # a prediction is better if the other's error is larger than this multiple of its error, plus noise
# A pixel is a seed if the same pixel predicts it better in SHARE of the pairs of photos that can tell, which are at
# least LEAST_PAIRS of all, and if PURE of the pairs that decide say so
SHARE = 0.4
PURE = 0.95
LEAST_PAIRS = 0.25
LEAST_SEEDS = 0.006  # least share of seeds in a picture; sound captures have up to .0005
OUTLINE = 0.5  # least share of a part's outline with an edge that photos share, and with seeds; sound parts have 0
FAR = 2.0  # depth, in medians of the view, from which on a plain part may be sky, whose depth models guess
MOST_SHARE = 0.5  # most pixels of a picture that an overlay covers; if more are alike, photos show no scene
FAR_AWAY = 1000.0  # multiple of a Gaussian's distance at which it would be as sky, which has no parallax
MOST_BARE = 0.5  # most pixels of a part without a Gaussian, else it is the background of a cut-out object
LEAST_PART_SEEDS = 8  # fewest seeds of a part, small pixels
STROKE = 64  # gaps of a mark up to this size are filled, small pixels
WEAK_STEPS = 6  # width of the strokes of letters into which a part grows along weaker edges, small pixels
BORDER_STEPS = 4  # small pixels by which borders of photos differ at most
ROUNDING = 1 / 255  # levels of a photo are rounded
OPAQUE = 2 / 255  # usual difference of photos at the pixels of an overlay that hides the scene
SMALL = np.ones((3, 3), np.uint8)
BESIDE = np.ones((5, 5), np.uint8)


@dataclass(frozen=True, eq=False)
class _Votes:
    """Pixels of small photos that the same pixel of other photos predicts better than the Gaussians do."""

    seeds: np.ndarray  # [h,w] bool
    denied: np.ndarray  # [h,w] bool: the Gaussians predict better in most of the pairs that decide
    noise: float  # half the usual error of the prediction by Gaussians


def leave_out_overlays(scene: PicturedScene) -> tuple[PicturedScene, np.ndarray | None, str]:
    """Leave out what all photos show at the same pixels, and the Gaussians of these pixels.

    Of Gaussians that views share, those go that are in front at these pixels and at no others. Also returns these
    pixels ``[v,h,w]`` bool, None if there are none, and a sentence about them.
    """
    if len(scene.photo_views) < LEAST_VIEWS or scene.pixels is None:
        return scene, None, ""
    small = find_overlay(scene)
    if small is None:
        return scene, None, ""
    size = scene.cameras.width, scene.cameras.height
    part = _grow(cv2.resize(small.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST), SMALL)
    overlay = _grow_in_photos(scene, part)
    pixels = scene.get_pixels()
    if pixels.own:
        goes = overlay.reshape(-1)[pixels.homes]
    else:
        goes = np.zeros(len(scene.gaussians), bool)
        within = pixels.fronts[:, part]
        beyond = pixels.fronts[:, ~part]
        goes[within[within >= 0]] = True
        goes[beyond[beyond >= 0]] = False
    where = f"{100 * overlay.mean():.1f} % of their pixels ({_describe_place(part)})"
    change = f"all photos show the same at {where}: taken for an overlay, and left out with its Gaussians{KEEP}"
    scene = replace(scene, masks=counting_pixels(scene) & ~overlay)
    return take_rows(scene, np.flatnonzero(~goes)), overlay, change


def _grow_in_photos(scene: PicturedScene, part: np.ndarray) -> np.ndarray:
    """Return the pixels ``[v,h,w]`` of an overlay, which covers the ``part [h,w]`` of all photos, and more of some.

    Borders of photos that were stabilised differ by a few pixels. A pixel beside the part belongs to it if it counts,
    and if it has the same colour, up to the usual difference of photos within the part. A mark through which the scene
    is seen has no colour of its own, and does not grow.
    """
    views = scene.photo_views
    overlay = np.repeat(part[None], len(scene), 0)
    covered = scene.images[views][:, part]
    usual = medians(covered)
    differences = max_columns(np.abs(covered - usual))
    noise = median(differences)
    if noise > OPAQUE:
        return overlay
    least = np.float32(noise + ROUNDING)
    counting = counting_pixels(scene)
    for view, difference in zip(views, differences, strict=True):
        photo = scene.images[view]
        mark = np.zeros(part.shape, bool)  # pixels that show the mark, and not the scene beside it
        mark[part] = difference <= least
        for _ in range(max(1, round(BORDER_STEPS * max(part.shape) / SIDE))):
            low = cv2.erode(np.where(mark[..., None], photo, np.float32(2)), SMALL)
            high = cv2.dilate(np.where(mark[..., None], photo, np.float32(-2)), SMALL)
            mark |= ((photo >= low - least) & (photo <= high + least)).all(-1) & counting[view]
        overlay[view] |= mark
    return overlay


def find_overlay(scene: PicturedScene) -> np.ndarray | None:
    """Find the pixels ``[h,w]`` bool of small photos at which all photos show an overlay; None if there is none."""
    views = scene.photo_views
    views = [views[i] for i in even_views(len(views), min(len(views), MOST_VIEWS))]
    size = fit_size((scene.cameras.width, scene.cameras.height), SIDE)
    photos = np.stack([cv2.resize(scene.images[view], size, interpolation=cv2.INTER_AREA) for view in views])
    inside = pixel_weights(scene.masks, *size)
    counts = np.full(photos.shape[:3], True) if inside is None else inside[views] == 1
    first = _vote(scene, views, photos, counts, step=2, partners=QUICK_PARTNERS)
    slopes = np.stack([np.stack(sobel(mean_columns(photo)), -1) / 8 for photo in photos])
    usual_slopes = medians(slopes)
    near_edge = _grow(_find_edges(slopes, usual_slopes, first.noise), SMALL)
    if (first.seeds & near_edge[::2, ::2]).mean() < LEAST_SEEDS:
        return None
    by_color = _vote(scene, views, photos, counts, step=1, partners=PARTNERS)
    by_slope = _vote(scene, views, slopes, counts, step=1, partners=PARTNERS)
    edges = _find_edges(slopes, usual_slopes, by_slope.noise)
    seeds = by_color.seeds | (by_slope.seeds & edges)
    picture = medians(photos)
    is_constant = mean_columns(np.abs(photos - picture)).mean(0) < by_color.noise / 2
    joined = (seeds | is_constant | (edges & _grow(seeds, BESIDE))) & counts.any(0)
    joined = cv2.morphologyEx(joined.astype(np.uint8), cv2.MORPH_CLOSE, SMALL)
    number, labels = cv2.connectedComponents(joined, connectivity=8)
    texture = mean_columns(np.abs(picture - blur(picture, 1.5)))
    has_row, depths = _describe_rows(scene, views, size)
    near_edge = _grow(edges, SMALL)
    near_seed = _grow(seeds, SMALL)
    part = np.zeros(seeds.shape, bool)
    for label in range(1, number):
        inside = labels == label
        if (seeds & inside).sum() < LEAST_PART_SEEDS:
            continue
        eroded = cv2.erode(inside.astype(np.uint8), SMALL, borderType=cv2.BORDER_CONSTANT, borderValue=1)
        outline = inside & (eroded == 0)
        interior = inside & ~_grow(outline, BESIDE)
        is_plain = not interior.any() or median(texture[interior]) < by_color.noise / 4
        is_sky = is_plain and median(depths[inside]) > FAR
        is_outlined = outline.any() and min(near_edge[outline].mean(), near_seed[outline].mean()) >= OUTLINE
        if is_outlined and not is_sky and has_row[inside].mean() >= 1 - MOST_BARE:
            part |= inside
    if (seeds & part).mean() < LEAST_SEEDS or part.mean() > MOST_SHARE:
        return None
    weak_edges = _find_edges(slopes, usual_slopes, by_slope.noise / 2)
    return _grow_letters(part, weak_edges & ~(by_color.denied | by_slope.denied))


def _vote(
    scene: PicturedScene, views: Sequence[int], values: np.ndarray, counts: np.ndarray, *, step: int, partners: int
) -> _Votes:
    """Compare the two predictions of values ``[v,h,w,c]`` of small photos, at each ``step``-th pixel that counts."""
    count, height, width = values.shape[:3]
    scale = np.array([scene.cameras.width / width, scene.cameras.height / height])
    x, y = np.meshgrid(np.arange(0, width, step, dtype=np.float32), np.arange(0, height, step, dtype=np.float32))
    columns = ((x + 0.5) * scale[0]).astype(int)
    lines = ((y + 0.5) * scale[1]).astype(int)
    offsets = sorted({round(offset) for offset in np.linspace(1, count - 1, min(partners, count - 1))})
    by_rows = list[np.ndarray]()  # errors of the prediction by Gaussians, of each pair of photos
    by_pixel = list[np.ndarray]()  # errors of the prediction by the same pixel
    tells = list[np.ndarray]()  # pixels at which the pair can tell the two apart
    for number, view in enumerate(views):
        rows = scene.get_pixels().fronts[view][lines, columns]
        others = [(number + offset) % count for offset in offsets]
        cameras = scene.cameras[[views[i] for i in others]]
        eye = scene.cameras.centres[view]
        means = scene.gaussians.means[np.maximum(rows, 0)].reshape(-1, 3).astype(np.float64)
        places, depths = project(np.concatenate([means, eye + FAR_AWAY * (means - eye)]), cameras)
        own = values[number, ::step, ::step]
        for other, place, depth in zip(others, places, depths, strict=True):
            with np.errstate(invalid="ignore"):
                u, v = (place / scale - 0.5).astype(np.float32).reshape(2, *x.shape, 2).transpose(3, 0, 1, 2)
                inside = (u >= 0) & (v >= 0) & (u <= width - 1) & (v <= height - 1) & (depth.reshape(u.shape) > 0)
            u = np.where(inside, u, 0)
            v = np.where(inside, v, 0)
            moved = inside & (np.abs(u - x) + np.abs(v - y) > MOVED)
            near_error, far_error = mean_columns(np.abs(own - sample_bilinear(values[other], u, v)))
            tells.append(moved[0] & (rows >= 0) & counts[number, ::step, ::step])
            by_rows.append(np.where(moved[1], np.minimum(near_error, far_error), near_error))
            by_pixel.append(mean_columns(np.abs(own - values[other, ::step, ::step])))
    told = np.stack(tells)
    row_errors = np.stack(by_rows)
    pixel_errors = np.stack(by_pixel)
    nothing = np.zeros(x.shape, bool)
    usual_error = median(row_errors[told])
    if not usual_error < median(pixel_errors[told]):
        return _Votes(nothing, nothing, 1.0)  # photos are too alike, or Gaussians too rough, to tell scene from overlay
    noise = max(1 / 255, usual_error / 2)
    is_same = (told & (row_errors > BETTER * pixel_errors + noise)).sum(0)
    is_scene = (told & (pixel_errors > BETTER * row_errors + noise)).sum(0)
    num_told = told.sum(0)
    enough = num_told >= max(2, LEAST_PAIRS * len(told))
    is_seed = enough & (is_same >= SHARE * num_told) & (is_same >= PURE * (is_same + is_scene))
    return _Votes(is_seed, is_scene > is_same, noise)


def _find_edges(slopes: np.ndarray, usual: np.ndarray, least: float) -> np.ndarray:
    """Find edges ``[h,w]`` at the same place in all photos, from their ``slopes [v,h,w,2]`` and the usual ones."""
    shared = np.abs(usual).sum(-1)
    differences = np.abs(slopes - usual).sum(-1).mean(0)
    return np.asarray((shared > least) & (shared > 2 * differences))


def _grow(mask: np.ndarray, window: np.ndarray) -> np.ndarray:
    """Return the pixels in the window around each pixel of a mask."""
    return np.asarray(cv2.dilate(mask.astype(np.uint8), window) > 0)


def _grow_letters(part: np.ndarray, weak_edges: np.ndarray) -> np.ndarray:
    """Return a part with the strokes beside it: half transparent letters have weaker edges at some places."""
    grown = part
    for _ in range(WEAK_STEPS):
        grown = grown | (weak_edges & _grow(grown, BESIDE))
    closed = cv2.morphologyEx(grown.astype(np.uint8), cv2.MORPH_CLOSE, SMALL)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(1 - closed, connectivity=4)
    return np.asarray((closed > 0) | (stats[labels, cv2.CC_STAT_AREA] <= STROKE))


def _describe_rows(scene: PicturedScene, views: Sequence[int], size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Return the share of ``views`` with a Gaussian at each small pixel ``[h,w]``, and its depth in medians."""
    shares = list[np.ndarray]()
    depths = list[np.ndarray]()
    for view in views:
        fronts = cv2.resize(scene.get_pixels().fronts[view], size, interpolation=cv2.INTER_NEAREST)
        (depth,) = project(scene.gaussians.means[np.maximum(fronts, 0)].reshape(-1, 3), scene.cameras[[view]])[1]
        has_row = fronts >= 0
        depth = depth.reshape(fronts.shape)
        usual = median(depth[has_row]) if has_row.any() else 1.0
        shares.append(has_row)
        depths.append(np.where(has_row, depth / usual, 1))
    return np.mean(shares, 0), medians(np.stack(depths))


def _describe_place(part: np.ndarray) -> str:
    """Say where in the pictures a part lies, such as "lower right"."""
    y, x = np.nonzero(part)
    down = y / part.shape[0]
    right = x / part.shape[1]
    if max(np.ptp(down), np.ptp(right)) > 0.6 and np.std(down) + np.std(right) > 0.5:
        return "around the edges"
    line = {0: "upper", 2: "lower"}.get(int(3 * down.mean()), "")
    column = {0: "left", 2: "right"}.get(int(3 * right.mean()), "")
    return f"{line} {column}".strip() or "in the middle"
