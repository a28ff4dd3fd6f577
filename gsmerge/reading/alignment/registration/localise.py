"""Find the frame of cameras whose photos show Gaussians that are no pixels, by the keypoints of photos and drawings.

The keypoints of two photos that match are triangulated with their cameras, in the cameras' frame. The keypoints of
drawings of the Gaussians have the drawn depth, in the Gaussians' frame. Where both match, the similarity between the
frames follows as for two scenes (:mod:`gsmerge.reading.alignment.registration.register`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import chain

import cv2
import numpy as np

from gsmerge.io.photo_files import limit_size
from gsmerge.method.geometry.transforms import Similarity, median, medians, motion_matrices, normalize, sh0_to_rgb
from gsmerge.method.geometry.views import even_views, resize_cameras
from gsmerge.method.kernels.elementary import exp, log
from gsmerge.method.kernels.matrices import invert, matmul, solve_symmetric, transform
from gsmerge.method.kernels.pictures import blur, sample_bilinear, sobel
from gsmerge.method.raster import render
from gsmerge.method.viewpoints.place_cameras import look_along
from gsmerge.method.viewpoints.viewer import spread_directions
from gsmerge.reading.alignment.frames import describe_frame
from gsmerge.reading.alignment.registration.keypoints import (
    PhotoKeypoints,
    detect_keypoints,
    match_descriptors,
    match_photos,
    place_keypoints,
    to_bytes,
)
from gsmerge.reading.alignment.registration.register import (
    MIN_MATCHES,
    compose,
    connect,
    invert_similarity,
    round_similarity,
)
from gsmerge.reading.alignment.score import AlignmentInput
from gsmerge.runtime.threads import parallel_map
from gsmerge.types import Cameras, Gaussians

MOST_PHOTOS = 12  # photos whose keypoints are matched
DRAWN_PIXELS = 480  # longer side of drawings, and of the photos that are compared with them
LEAST_PARALLAX = 0.01  # radians between the rays of a keypoint in two photos, from which its depth is known
MOST_ERROR = 0.006  # distance of a triangulated point from its keypoints, in diagonals of the picture
NEAREST, FARTHEST = 1e-3, 1e4  # planes of drawings, in median distances of the Gaussians from their middle
# Colours of Gaussians in a frame of matched keypoints, in distances of wrong pairs: .3 to .85, or if wrong about 1
WRONG_COLORS = 0.93
ABOUT_EQUAL = 0.9  # cosine of 26 degrees between two cameras, up to which keypoints match well
MANY_KEYPOINTS = 300  # in photos, and in drawings: in made scenes a frame was found from 80 to 290
SOLID = 0.5  # opacity of a drawing from which a depth counts
COMPARED = 20_000  # Gaussians whose colours are compared with photos
SIGMAS = (1.0, 0.5)  # pixels by which photos are blurred, one after the other
STEPS = 20  # with each of them
FARTHER = 2.0  # times each step, which is too short: Gaussians choose photos in which they need not move
SIZED = 3000  # Gaussians from whose sizes the viewers' place is searched
DIRECTIONS = 96  # from the middle of the Gaussians
PLACES = 2  # most different ones at which viewers may have been
DISTANCES = (0.5, 1.0, 1.5, 2.5)  # from there, in median distances of the Gaussians


def find_frame(
    inputs: AlignmentInput, measure: Callable[[Similarity], float], fits: Callable[[Similarity], bool]
) -> tuple[Similarity | None, bool]:
    """Find a frame in which the photos show the Gaussians, by their keypoints.

    The Gaussians are drawn from the cameras as they are, and from where their sizes say that viewers were. Textures
    that repeat match at wrong places, too: of matches whose colours, which ``measure`` compares with those of wrong
    pairs, are no better than these, nothing is refined, and a frame has to fit as ``fits`` says.

    Returns the frame, or None, and whether photos and drawings have so many keypoints that a shift would have been
    found: it changes what cameras see less than another scale does.
    """
    views = [view for view in range(len(inputs.cameras)) if inputs.images[view].any()]
    views = [views[i] for i in even_views(len(views), min(len(views), MOST_PHOTOS))]
    cameras, images = _make_small(inputs, views)
    found = parallel_map(lambda image: detect_keypoints(image, 1.0), list(images))
    photos = _triangulate(cameras, found)
    num_points = sum(len(photo.points) for photo in photos)
    if num_points < MIN_MATCHES:  # where two cameras look about the same way, they are not those of the photos
        forward = cameras.viewmats[:, 2, :3].astype(np.float64)
        are_beside = (matmul(forward, forward.T) > ABOUT_EQUAL).sum() > len(cameras)
        return None, are_beside and sum(len(pixels) for pixels, _ in found) >= MANY_KEYPOINTS
    gaussians = inputs.gaussians[np.flatnonzero(inputs.valid)]
    num_drawn = 0
    for viewpoints in chain([cameras], _place_viewers(gaussians, cameras)):
        drawings = _draw_keypoints(gaussians, viewpoints)
        count = sum(len(drawing.points) for drawing in drawings)
        num_drawn = max(num_drawn, count)
        link = connect(match_photos((0, 1), photos, drawings, (cameras.width, cameras.height)))
        if link is None or measure(link[0]) > WRONG_COLORS:
            continue
        frame = min((link[0], _register_colors(images, gaussians, link[0], cameras)), key=measure)
        if fits(frame):
            unit = float(2.0 ** np.frexp(np.abs(frame.shift).max() + 1e-30)[1])
            return describe_frame(round_similarity(frame, unit)), True
    return None, min(num_drawn, num_points) >= MANY_KEYPOINTS


def mirror(inputs: AlignmentInput) -> AlignmentInput:
    """Flip photos and their cameras, as they are of a scene in a mirror, in which x is reversed."""
    flip = np.diag([-1.0, 1, 1, 1])
    cameras = inputs.cameras
    Ks = cameras.Ks.copy()
    Ks[:, 0, 2] = cameras.width - Ks[:, 0, 2]
    viewmats = matmul(flip, matmul(cameras.viewmats.astype(np.float64), flip))
    images = np.ascontiguousarray(inputs.images[:, :, ::-1])
    return replace(inputs, cameras=replace(cameras, viewmats=viewmats, Ks=Ks), images=images)


def _make_small(inputs: AlignmentInput, views: Sequence[int]) -> tuple[Cameras, np.ndarray]:
    """Return the cameras and photos ``[v,h,w,3]`` uint8 of ``views``, at the size at which keypoints are searched."""
    cameras = inputs.cameras[list(views)]
    size = limit_size((cameras.width, cameras.height), DRAWN_PIXELS)
    images = [cv2.resize(to_bytes(inputs.images[view]), size, interpolation=cv2.INTER_AREA) for view in views]
    return resize_cameras(cameras, *size), np.stack(images)


def _triangulate(cameras: Cameras, found: Sequence[tuple[np.ndarray, np.ndarray]]) -> list[PhotoKeypoints]:
    """Find the keypoints of photos that match in another photo, and their points in the frame of the cameras."""
    Ks = cameras.Ks.astype(np.float64)
    viewmats = cameras.viewmats.astype(np.float64)
    centres = -transform(viewmats[:, :3, :3].swapaxes(1, 2), viewmats[:, :3, 3])
    limit = MOST_ERROR * np.sqrt(cameras.width**2 + cameras.height**2)
    rays = list[np.ndarray]()
    for (pixels, _), K, viewmat in zip(found, Ks, viewmats, strict=True):
        ones = np.ones((len(pixels), 1))
        local = matmul(np.concatenate([pixels, ones], 1), invert(K).T)
        rays.append(normalize(matmul(local, viewmat[:3, :3])))
    points = [np.full((len(pixels), 3), np.nan) for pixels, _ in found]
    parallaxes = [np.zeros(len(pixels)) for pixels, _ in found]  # of the pair from which a point is
    for a in range(len(found)):
        for b in range(a + 1, len(found)):
            ids, others = match_descriptors(found[a][1], found[b][1])
            if not len(ids):
                continue
            u = rays[a][ids]
            v = rays[b][others]
            # the middle of the shortest way between the two rays
            across = centres[b] - centres[a]
            cosine = (u * v).sum(1)
            sine2 = np.maximum(1 - cosine * cosine, 1e-12)
            along_u = ((u * across).sum(1) - cosine * (v * across).sum(1)) / sine2
            along_v = (cosine * (u * across).sum(1) - (v * across).sum(1)) / sine2
            place = (centres[a] + along_u[:, None] * u + centres[b] + along_v[:, None] * v) / 2
            errors = [
                _reprojection_errors(place, found[view][0][rows], Ks[view], viewmats[view])
                for view, rows in ((a, ids), (b, others))
            ]
            is_known = (along_u > 0) & (along_v > 0) & (np.maximum(*errors) < limit)
            for view, rows in ((a, ids), (b, others)):
                better = is_known & (sine2 > np.maximum(LEAST_PARALLAX**2, parallaxes[view][rows]))
                points[view][rows[better]] = place[better]
                parallaxes[view][rows[better]] = sine2[better]
    photos = list[PhotoKeypoints]()
    for view, (pixels, descriptors) in enumerate(found):
        known = parallaxes[view] > 0
        photos.append(PhotoKeypoints(pixels[known], points[view][known], descriptors[known], viewmats[view], Ks[view]))
    return photos


def _reprojection_errors(points: np.ndarray, pixels: np.ndarray, K: np.ndarray, viewmat: np.ndarray) -> np.ndarray:
    """Return the distances ``[n]`` of points from their pixels in a photo; large behind the camera."""
    local = matmul(points, viewmat[:3, :3].T) + viewmat[:3, 3]
    depth = np.maximum(local[:, 2], 1e-9)
    offsets = matmul(local / depth[:, None], K.T)[:, :2] - pixels
    return np.asarray(np.where(local[:, 2] > 0, np.sqrt((offsets * offsets).sum(1)), np.inf))


def _draw_keypoints(gaussians: Gaussians, viewpoints: Cameras) -> list[PhotoKeypoints]:
    """Find the keypoints of drawings, and their points in the frame of the Gaussians."""
    unit = float(median(np.abs(gaussians.means - medians(gaussians.means)).max(1))) or 1.0
    drawn = render(gaussians, viewpoints, near=NEAREST * unit, far=FARTHEST * unit, with_depths=True)
    assert drawn.depths is not None
    drawings = list[PhotoKeypoints]()
    for view in range(len(viewpoints)):
        K = viewpoints.Ks[view].astype(np.float64)
        viewmat = viewpoints.viewmats[view].astype(np.float64)
        pixels, descriptors = detect_keypoints(to_bytes(drawn.images[view]), 1.0)
        depths = np.where(drawn.alphas[view, ..., 0] > SOLID, drawn.depths[view, ..., 0], np.inf).astype(np.float64)
        drawings.append(place_keypoints(pixels, descriptors, depths, viewmat, K))
    return drawings


def _register_colors(images: np.ndarray, gaussians: Gaussians, frame: Similarity, cameras: Cameras) -> Similarity:
    """Refine a frame by Gauss-Newton steps, so that photos have the colours of Gaussians where they see them.

    A Gaussian has the colour of a pixel of some photo, whatever its depth, so it is compared with the photo that has
    the most similar colour at its place. Photos ``[v,h,w,3]`` are blurred less and less.
    """
    sample = gaussians[:: -(-len(gaussians) // COMPARED)]
    points = sample.means.astype(np.float64)
    colors = sh0_to_rgb(sample.sh0[:, 0]).clip(0, 1).astype(np.float64)
    Ks = cameras.Ks.astype(np.float64)
    viewmats = cameras.viewmats.astype(np.float64)
    back = invert_similarity(frame)
    for sigma in SIGMAS:
        photos = [blur(image.astype(np.float32) / np.float32(255), sigma) for image in images]
        slopes = [np.concatenate(sobel(photo), -1) / 8 for photo in photos]
        for _ in range(STEPS):
            placed = back.move_points(points)  # in the frame of the cameras
            errors = np.full((len(points), 3), np.inf)
            jacobian = np.zeros((len(points), 3, 3))  # of the errors by the places
            for K, viewmat, photo, slope in zip(Ks, viewmats, photos, slopes, strict=True):
                local = matmul(placed, viewmat[:3, :3].T) + viewmat[:3, 3]
                depth = np.maximum(local[:, 2], 1e-9)
                place = matmul(local / depth[:, None], K.T)[:, :2] - 0.5
                ends = cameras.width - 1, cameras.height - 1
                inside = (local[:, 2] > 0) & (place >= 0).all(1) & (place <= ends).all(1)
                x, y = np.where(inside[:, None], place, 0).astype(np.float32).T
                found = sample_bilinear(photo, x, y) - colors
                is_nearest = inside & (np.abs(found).sum(1) < np.abs(errors).sum(1))
                errors[is_nearest] = found[is_nearest]
                by_pixel = sample_bilinear(slope, x, y)[is_nearest].astype(np.float64).reshape(-1, 2, 3).swapaxes(1, 2)
                z = depth[is_nearest, None, None]
                by_local = by_pixel * (K[0, 0], K[1, 1]) / z
                toward = -(by_local * local[is_nearest, None, :2]).sum(2, keepdims=True) / z
                jacobian[is_nearest] = matmul(np.concatenate([by_local, toward], 2), viewmat[:3, :3])
            seen = np.isfinite(errors[:, 0])
            step = FARTHER * _solve_step(errors[seen], jacobian[seen], placed[seen])
            if not np.isfinite(step).all():
                break
            rotation = motion_matrices(np.concatenate([step[:3], np.zeros(3)])[None])[0, :3, :3]
            back = compose(Similarity(rotation, float(exp(step[6:].clip(-1, 1))[0]), step[3:6]), back)
    return invert_similarity(back)


def _solve_step(errors: np.ndarray, jacobian: np.ndarray, placed: np.ndarray) -> np.ndarray:
    """Solve for the turn, shift and logarithm of the scale ``[7]`` that reduce ``errors [n,3]`` at places ``[n,3]``."""
    by_turn = np.cross(placed[:, None], jacobian)
    slopes = np.concatenate([by_turn, jacobian, (jacobian * placed[:, None]).sum(2, keepdims=True)], 2)
    sizes = np.abs(errors).sum(1)
    weights = 1 / np.maximum(sizes / max(median(sizes), 1e-6), 1) ** 2
    weighted = (slopes * weights[:, None, None]).reshape(-1, 7).T
    normal = matmul(weighted, slopes.reshape(-1, 7))
    normal += 1e-9 * np.trace(normal) * np.eye(7)
    return -solve_symmetric(normal, matmul(weighted, errors.reshape(-1)))


def _place_viewers(gaussians: Gaussians, cameras: Cameras) -> Iterator[Cameras]:
    """Place cameras where the sizes of the Gaussians say that viewers were, which look at them and to the sides.

    A model gives a Gaussian the size of its pixel, so that sizes are in proportion to the distances from a viewer: the
    place is searched from which their quotients vary least, first in all directions, and then in smaller steps.
    """
    sample = gaussians[:: -(-len(gaussians) // SIZED)]
    means = sample.means.astype(np.float64)
    middle = medians(means)
    unit = float(median(np.sqrt(((means - middle) ** 2).sum(1)))) or 1.0
    sizes = log(np.maximum(np.sort(sample.scales, 1)[:, 1:].astype(np.float64).prod(1), 1e-30)) / 2

    def vary(place: np.ndarray) -> float:
        """Return how much the quotients of sizes and distances vary, seen from a place."""
        offsets = means - middle - unit * place
        quotients = sizes - log(np.maximum((offsets * offsets).sum(1), 1e-30)) / 2
        return median(np.abs(quotients - median(quotients)))

    starts = [distance * start for distance in DISTANCES for start in spread_directions(DIRECTIONS)]
    places = list[np.ndarray]()
    for start in sorted(starts, key=vary):
        if all((start * place).sum() < 0.5 * np.sqrt((start**2).sum() * (place**2).sum()) for place in places):
            places.append(_descend(vary, start))
        if len(places) == PLACES:
            break
    for place in places:
        yield _look_around(unit * place + middle, middle, cameras)


def _descend(cost: Callable[[np.ndarray], float], place: np.ndarray) -> np.ndarray:
    """Return the place of the least cost near a place, by smaller and smaller steps along the axes."""
    step = 0.25
    while step > 0.02:
        steps = step * np.sqrt((place * place).sum()) * np.concatenate([np.eye(3), -np.eye(3)])
        nearest = min((place + offset for offset in steps), key=cost)
        if cost(nearest) < cost(place) and np.sqrt((nearest * nearest).sum()) < 2 * DISTANCES[-1]:
            place = nearest
        else:
            step /= 2
    return place


def _look_around(eye: np.ndarray, middle: np.ndarray, cameras: Cameras) -> Cameras:
    """Return cameras with the lens of the first of ``cameras``, which look from a place to the middle and beside it."""
    ahead = normalize((middle - eye)[None])[0]
    side = normalize(np.cross(np.eye(3)[int(np.abs(ahead).argmin())], ahead)[None])[0]
    above = np.cross(ahead, side)
    K = cameras.Ks[:1].astype(np.float64)
    slant = 0.5 * cameras.width / K[0, 0, 0]
    directions = [ahead, *(ahead + slant * sign * way for way in (side, above) for sign in (1, -1))]
    viewmats = np.stack([look_along(eye, normalize(direction[None])[0]) for direction in directions])
    return replace(cameras[[0]], viewmats=viewmats, Ks=np.repeat(K, len(viewmats), 0))
