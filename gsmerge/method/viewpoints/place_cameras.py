"""Place cameras in a scene without cameras, or between and around the views of a scene; render pictures for photos."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from gsmerge.errors import count_words
from gsmerge.method.fit.outside import outside_cameras
from gsmerge.method.geometry.transforms import motion_matrices, motion_vectors, nearest_views, normalize
from gsmerge.method.geometry.views import concat_cameras, take_rows
from gsmerge.method.kernels.elementary import cos, power, sin
from gsmerge.method.kernels.matrices import matmul
from gsmerge.method.raster import contributions, make_splats, render, tile_view
from gsmerge.method.raster.images import thin_out
from gsmerge.method.raster.photos import blank_photos
from gsmerge.method.viewpoints.viewer import GOLDEN, find_viewer, spread_directions
from gsmerge.runtime.record import note
from gsmerge.runtime.threads import parallel_map
from gsmerge.types import Cameras, Gaussians, PicturedScene, Scene

NUM_VIEWS = 24  # largest number of cameras that are placed
HELD_OUT = 8  # every HELD_OUT-th placed camera is not used in the fit, but only for scores
FITTED = 16  # cameras of each kind to which a scene without cameras is fitted; on a walk half as many
CANDIDATE_GAUSSIANS = 40_000  # candidates are chosen by pictures of at most this many Gaussians
AROUND_CAMERAS = 40  # candidate cameras around the scene
# distances of cameras around the scene, in its radii
FAR_RADII = 2.0
NEAR_RADII = 1.2
INSIDE = (0.0, -0.5, 0.5)  # positions of cameras inside, along each axis, as a share of half the extent
INSIDE_DIRECTIONS = 8  # directions in which cameras look from each position inside
FIELD = 1.0  # width of the image, divided by the focal length
# Cameras at a viewer's place: width of the image divided by the focal length (80 degrees), and size of a pixel in
# standard deviations of Gaussians
INSIDE_FIELD = 5 / 3
INSIDE_PIXEL = 1.5
PROBE = 96  # pixels per side of the pictures for choosing candidates
# pixels per side
SMALLEST_PIXELS = 96
LARGEST_PIXELS = 640
NEAR_PLANE_SHARE = 0.02  # near plane, as a share of the scene's radius
# A camera is placed between a view and each of its PAIRS nearest views, at the share MIDDLE of the way
PAIRS = 2
MIDDLE = 0.5
WIDEST = np.pi / 4  # the space between two views is unknown if the angle between their directions is larger
# A fit to renders of at most this many views also gets renders between them, because it would memorise so few views
FEW_RENDERED_VIEWS = 24
# number of views from outside as a share of all views, and its maximum
OUTSIDE_SHARE = 0.5
MOST_OUTSIDE = 24
# Bounds of views from outside: step backwards as a share of the depth, rotation to the sides and rotation up or down in
# degrees
OUTSIDE_LOW = (0.0, -15.0, -10.0)
OUTSIDE_HIGH = (0.6, 15.0, 10.0)


VIEWER_VIEWS = (
    "no cameras: the scene was made around a viewer, from whose place it is fitted and scored; --cameras names others"
)
PLACED_VIEWS = "no cameras: views are placed around and inside the scene"
NO_VIEWS = (
    f"{PLACED_VIEWS}, and the result cannot be better than its input;"
    " with cameras and photos it is fitted to them (--cameras, --images)"
)


def add_views(scene: Scene, *, shown: bool = False, placed: str = NO_VIEWS) -> Scene:
    """Keep the finite Gaussians, and place cameras in a scene without cameras; notes say what was left out or placed.

    The arguments are those of :func:`place_views`. Raises ValueError if no Gaussian is finite.
    """
    finite = keep_finite(scene)
    count = len(scene.gaussians) - len(finite.gaussians)
    if count:
        note(describe_dropped(count))
    return place_views(finite, shown=shown, placed=placed)


def keep_finite(scene: Scene) -> Scene:
    """Keep the finite Gaussians of a scene; ValueError if no Gaussian is finite."""
    g = scene.gaussians
    finite = np.ones(len(g), bool)
    for array in vars(g).values():
        is_finite = np.isfinite(array)
        if not is_finite.all():  # rare; row by row the test takes ten times as long
            finite &= is_finite.reshape(len(g), -1).all(1)
    count = int((~finite).sum())
    if count == len(g):
        raise ValueError("expected at least one finite Gaussian, got none")
    if not count:
        return scene
    return take_rows(scene, np.flatnonzero(finite))


def describe_dropped(count: int) -> str:
    """Say that :func:`keep_finite` dropped a number of Gaussians."""
    return f"{count_words(count, 'Gaussian')} not finite: left out"


def place_views(scene: Scene, *, shown: bool = False, placed: str = NO_VIEWS) -> Scene:
    """Place cameras in a scene without cameras, with a note.

    The cameras are placed for a fit, or with ``shown`` for people who look at the scene (:func:`place_viewpoints`).
    ``placed`` is the note about cameras that are not placed at a viewer's place.
    """
    if len(scene):
        return scene
    inside = place_inside(scene.gaussians)
    note(placed if inside is None else VIEWER_VIEWS)
    cameras = inside or (_place_around_and_inside if shown else place_around)(scene.gaussians)
    order = sorted(range(len(cameras)), key=lambda view: (view + 1) % HELD_OUT != 0)  # held-out cameras come first
    cameras = replace(cameras if shown else cameras[order], antialiased=scene.cameras.antialiased)
    return _with_cameras(scene.gaussians, cameras)


def _with_cameras(gaussians: Gaussians, cameras: Cameras) -> Scene:
    """Return a scene of Gaussians and placed cameras, without pictures."""
    return Scene(gaussians, cameras, None, None, tuple(f"placed {view}" for view in range(len(cameras))))


def place_inside(gaussians: Gaussians) -> Cameras | None:
    """Place cameras that look to all sides around a viewer's place; None if the scene was not made around a viewer."""
    viewer = find_viewer(gaussians[:: -(-len(gaussians) // CANDIDATE_GAUSSIANS)])
    if viewer is None:
        return None
    size = int(np.clip(round(INSIDE_FIELD / (INSIDE_PIXEL * viewer.angle)), SMALLEST_PIXELS, LARGEST_PIXELS))
    # cube roots, so that the cameras fill the empty ball evenly
    radii = viewer.free_radius * power(np.arange(NUM_VIEWS) * GOLDEN / np.pi % 1, 1 / 3)
    eyes = viewer.place + radii[:, None] * spread_directions(NUM_VIEWS)[::-1]
    viewmats = np.stack(
        [look_along(eye, direction) for eye, direction in zip(eyes, spread_directions(NUM_VIEWS), strict=True)]
    )
    return Cameras(viewmats, np.repeat(_square_intrinsics(size, INSIDE_FIELD)[None], NUM_VIEWS, 0), size, size)


def place_viewpoints(gaussians: Gaussians) -> Cameras:
    """Place cameras for people to look from, at a viewer's place, or else first around the scene and then inside it."""
    return place_inside(gaussians) or _place_around_and_inside(gaussians)


def _place_around_and_inside(gaussians: Gaussians) -> Cameras:
    """Place cameras for people to look from, first around a scene and then inside it."""
    inside = place_cameras(gaussians, NUM_VIEWS // 2)
    centre, half = _robust_box(thin_out(gaussians, CANDIDATE_GAUSSIANS).means.astype(np.float64))
    angles = 2 * np.pi * np.arange(len(inside)) / len(inside)
    ring_height = -0.25  # height of the ring of viewpoints, in its radii; y points down
    # the first camera sees the front of most models
    ring = np.stack([sin(angles), np.full(len(angles), ring_height), -cos(angles)], 1)
    around = replace(inside, viewmats=_viewmats_around(centre, half, FAR_RADII, normalize(ring)))
    return concat_cameras(around, inside)


def place_around(gaussians: Gaussians, count: int = FITTED) -> Cameras:
    """Place cameras to which a scene without cameras is fitted, and on which results are scored.

    ``count`` cameras are far away, ``count`` are near by, at most ``count`` are where they show most of the scene, and
    ``count / 2`` are on a walk through the scene.
    """
    means = thin_out(gaussians, CANDIDATE_GAUSSIANS).means.astype(np.float64)
    centre, half = _robust_box(means)
    outside = [_viewmats_around(centre, half, radii, spread_directions(count)) for radii in (FAR_RADII, NEAR_RADII)]
    chosen = place_cameras(gaussians, count)
    middle = np.median(means, axis=0)
    # the cameras of the walk look to all sides along the longest axis of the box
    _, side, along = np.eye(3)[np.argsort(half, kind="stable")]
    num_steps = count // 2
    steps = 2 * (np.arange(num_steps) + 0.5) / num_steps - 1
    angles = GOLDEN * np.arange(num_steps)
    directions = cos(angles)[:, None] * along + sin(angles)[:, None] * side
    walk_share = 0.6  # largest distance from the middle, as a share of the longest half axis
    walk = [
        look_along(middle + step * walk_share * half.max() * along, direction)
        for step, direction in zip(steps, directions, strict=True)
    ]
    viewmats = np.concatenate([*outside, chosen.viewmats, walk])
    return replace(chosen, viewmats=viewmats, Ks=np.repeat(chosen.Ks[:1], len(viewmats), 0))


def draw_pictures(scene: Scene) -> PicturedScene:
    """Return a canonical scene with renders as pictures of its views; ``empty`` is 1 minus the renders' opacity."""
    drawn = render(scene.gaussians, scene.cameras)
    pictured = PicturedScene.with_pictures(scene, np.clip(drawn.images, 0, 1, out=drawn.images), None)
    return replace(pictured, empty=1 - drawn.alphas[..., 0])


def draw_around(scene: PicturedScene) -> PicturedScene:
    """Add renders of a scene from outside its views and, if the scene has few views, from between the views.

    The renders come last. A scene with a single view is returned as it is.
    """
    means = scene.gaussians.means
    views = len(scene)
    if views == 1:
        return scene
    count = min(int(OUTSIDE_SHARE * views), MOST_OUTSIDE)
    more = outside_cameras(
        means[:: max(1, len(means) // CANDIDATE_GAUSSIANS)], scene.cameras, count, OUTSIDE_LOW, OUTSIDE_HIGH
    )
    if views <= FEW_RENDERED_VIEWS:
        more = concat_cameras(between_cameras(scene.cameras), more)
    drawn = draw_pictures(_with_cameras(scene.gaussians, more))
    return replace(
        scene,
        cameras=concat_cameras(scene.cameras, more),
        names=(*scene.names, *(f"around {view}" for view in range(len(more)))),
        pixels=None,
        images=np.concatenate([scene.images, drawn.images]),
        empty=np.concatenate([scene.empty, drawn.empty]),
        importance=None,  # all of these pictures are renders
    )


def between_cameras(cameras: Cameras, *further: float) -> Cameras:
    """Place a camera half way between each of two or more views and each of its nearest other views.

    For each of the shares ``further``, each view gets one more camera at this share of the way to its nearest view. A
    camera lies on the screw motion from one view's pose to the other's, so it looks at the point at which both views
    look. Pairs of views with an angle above ``WIDEST`` get no camera.
    """
    viewmats = cameras.viewmats.astype(np.float64)
    nearest = [nearest_views(cameras.centres, view)[:PAIRS] for view in range(len(cameras))]
    # each camera is a pair of views and a share of the way from the first view to the second
    half_way = {(min(view, i), max(view, i)): MIDDLE for view, neighbours in enumerate(nearest) for i in neighbours}
    at_shares = [((view, neighbours[0]), share) for share in further for view, neighbours in enumerate(nearest)]
    pairs, shares = (np.array(column) for column in zip(*half_way.items(), *at_shares, strict=True))
    motions = motion_vectors(viewmats[pairs[:, 0]], viewmats[pairs[:, 1]])
    is_narrow = (motions[:, :3] ** 2).sum(1) <= WIDEST**2
    views = pairs[is_narrow, 0]
    moves = motion_matrices((shares[:, None] * motions)[is_narrow])
    return replace(cameras, viewmats=matmul(viewmats[views], moves), Ks=cameras.Ks[views])


def place_cameras(gaussians: Gaussians, num_views: int = NUM_VIEWS) -> Cameras:
    """Place cameras that see as much of the scene as possible.

    Candidates stand on a sphere around the box of most Gaussians, looking in, and on a grid inside it, looking in all
    directions. At most ``num_views`` candidates are chosen, one by one. The next camera is always the candidate that
    adds most to the opacity that the chosen cameras show, in pictures of a sample of the Gaussians. Images are square
    and grow with the number of Gaussians up to ``LARGEST_PIXELS`` pixels per side. Raises ValueError if there is no
    Gaussian.
    """
    if len(gaussians) == 0:
        raise ValueError("expected at least one Gaussian, got none")
    sample = thin_out(gaussians, CANDIDATE_GAUSSIANS)
    centre, half = _robust_box(sample.means.astype(np.float64))
    inside = [
        look_along(centre + position * half, direction)
        for position in np.stack(np.meshgrid(INSIDE, INSIDE, INSIDE, indexing="ij"), -1).reshape(-1, 3)
        for direction in spread_directions(INSIDE_DIRECTIONS)
    ]
    around = _viewmats_around(centre, half, FAR_RADII, spread_directions(AROUND_CAMERAS))
    viewmats = np.concatenate([around, inside])
    candidates = Cameras(viewmats, np.repeat(_square_intrinsics(PROBE)[None], len(viewmats), 0), PROBE, PROBE)
    least_gain = 1e-3  # a camera is added if it raises the shown opacity by more than this share
    near = NEAR_PLANE_SHARE * float(np.sqrt((half * half).sum()))
    best = choose_candidates(sample, candidates, near, least_gain, num_views)
    size = int(np.clip(round(math.sqrt(len(gaussians))), SMALLEST_PIXELS, LARGEST_PIXELS))
    return Cameras(viewmats[best], np.repeat(_square_intrinsics(size)[None], len(best), 0), size, size)


def _square_intrinsics(size: int, field: float = FIELD) -> np.ndarray:
    """Return the intrinsics ``[3,3]`` of a camera with images of ``size`` pixels per side.

    ``field`` is the width of the image divided by the focal length.
    """
    return np.array([[size / field, 0, size / 2], [0, size / field, size / 2], [0, 0, 1]])


def _robust_box(means: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return centre ``[3]`` and half sides ``[3]`` of the box that contains most of the means ``[n,3]``."""
    extent_quantiles = (0.05, 0.95)  # positions along each axis between which the scene is assumed to lie
    low, high = np.quantile(means, extent_quantiles, axis=0)
    half = (high - low) / 2
    widest = float(half.max()) if half.max() > 0 else 1.0
    return (low + high) / 2, np.maximum(half, 1e-3 * widest)


def _viewmats_around(centre: np.ndarray, half: np.ndarray, radii: float, directions: np.ndarray) -> np.ndarray:
    """Return world-to-camera matrices ``[c,4,4]`` of cameras that look at a box's centre from ``directions [c,3]``.

    ``half [3]`` are half the sides of the box. The distance of the cameras from the centre is ``radii`` times half the
    diagonal of the box.
    """
    distance = radii * float(np.sqrt((half * half).sum()))
    return np.stack([look_along(centre + distance * direction, -direction) for direction in directions])


def look_along(eye: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Return the world-to-camera matrix ``[4,4]``, OpenCV axes, of a camera at ``eye`` that looks along ``direction``.

    ``direction`` has length 1.
    """
    up = np.array([0.0, 1.0, 0.0]) if abs(direction[1]) < 0.9 else np.array([0.0, 0.0, 1.0])
    x = np.cross(up, direction)
    x /= np.sqrt((x * x).sum())
    viewmat = np.eye(4)
    viewmat[:3, :3] = np.stack([x, np.cross(direction, x), direction])
    viewmat[:3, 3] = -matmul(viewmat[:3, :3], eye)
    return viewmat


def choose_candidates(
    sample: Gaussians,
    candidates: Cameras,
    near: float,
    least_added: float,
    num_views: int = NUM_VIEWS,
    counting: np.ndarray | None = None,
) -> list[int]:
    """Choose one to ``num_views`` candidates, always the one that adds most to the opacity shown so far.

    The candidates show a sample of the Gaussians, of which only those in the mask ``counting [n]`` count, by default
    all. ``near`` is the depth of the near plane. The choice ends when no other candidate would add more than the share
    ``least_added``.
    """
    splats, photos = make_splats(sample), blank_photos(candidates)

    def view_shares(view: int) -> np.ndarray:
        """Return the part of each Gaussian's opacity that one candidate shows, ``[n]``."""
        sums, _ = contributions(tile_view(splats, **photos.camera(view), near=near))
        seen_weight = 1.0  # blending weight, summed over pixels, at which a Gaussian counts as seen
        return np.minimum(sums / np.float32(seen_weight), 1) * splats.opacities

    shares = np.stack(parallel_map(view_shares, range(len(candidates))))  # [c,n]
    if counting is not None:
        shares = shares[:, counting]
    seen = np.zeros(shares.shape[1], np.float32)
    chosen = list[int]()
    for _ in range(num_views):
        gains = np.maximum(shares - seen, 0).sum(1, dtype=np.float64)
        best = int(gains.argmax())
        if chosen and gains[best] <= least_added * seen.sum(dtype=np.float64):
            break
        chosen.append(best)
        np.maximum(seen, shares[best], out=seen)
    return chosen
