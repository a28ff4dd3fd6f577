"""One synthetic scene in memory: a stage, its photos, and the Gaussians that a network would predict from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np

from gsmerge.research.generate.noise import Float, TrueView, pixel_gaussians
from gsmerge.research.generate.options import MIXED, GenerateOptions, Noise, draw_noise
from gsmerge.research.generate.paths import PATHS, Pose, is_usable
from gsmerge.research.generate.photograph import (
    FAR,
    SAMPLES,
    Lens,
    LitStage,
    develop,
    find_exposure,
    light_stage,
    radiance,
    trace,
)
from gsmerge.research.generate.shapes import Array
from gsmerge.research.generate.styles import STYLES
from gsmerge.research.generate.textures import Palette
from gsmerge.runtime.threads import parallel_map
from gsmerge.types import Cameras, Gaussians

PATH_TRIES, STAGE_TRIES = 6, 6  # paths per stage, and stages, until all views are usable
SMALL = 8  # views are checked, and exposures computed, at this fraction of the size


@dataclass(frozen=True)
class SyntheticScene:
    """A scene as a network would export it, with held-out views."""

    gaussians: Gaussians  # one for each pixel, view-major and row-major
    cameras: Cameras  # as the network estimates them
    images: tuple[Float, ...]  # the photos, [h,w,3] sRGB in [0, 1] each; larger than the views with a photo_scale
    targets: Cameras  # true cameras half-way between the views, of the photos' size
    target_images: tuple[Float, ...]  # their photos
    style: str
    path: str
    noise: Noise


def make_scene(seed: int, index: int, options: GenerateOptions) -> SyntheticScene:
    """Scene ``index`` of a series; the same arguments give the same bits, on any number of threads."""
    rng = np.random.default_rng([seed, index])
    num_views = int(rng.integers(options.views[0], options.views[1] + 1))
    style = options.style if options.style != MIXED else list(STYLES)[(seed + index) % len(STYLES)]
    path = options.path if options.path != MIXED else list(PATHS)[rng.integers(len(PATHS))]
    noise = draw_noise(options.ranges, rng, options.noise)
    lens = Lens(options.width, options.height, max(options.width, options.height) * rng.uniform(0.58, 1.75))
    large = _scale(lens, options.photo_scale)  # of the photos; the network sees them at the views' size
    view, pose = _find_stage(rng, style, path, large, num_views)
    places = np.linspace(0, 1, 2 * num_views - 1)
    poses = [pose(s) for s in places]
    gain = find_exposure([radiance(view, p, _shrink(lens), 1)[0] for p in poses[::2]], rng.uniform(0.22, 0.62))
    seeds = rng.integers(0, 2**63, len(poses))
    photo = partial(_photo, view, lens, large, noise, gain)
    photos = parallel_map(photo, list(zip(poses, seeds, strict=True)))
    world = np.linalg.inv(poses[0]) if rng.random() < 0.5 else np.eye(4)  # that of many exporters is the first camera
    moved = [_move_pose(pose, world, noise.unit) for pose in poses]
    seen = []
    for (image, depth, normals), true_pose in zip(photos[::2], moved[::2], strict=True):
        if large != lens:
            image = cv2.resize(image, (lens.width, lens.height), interpolation=cv2.INTER_AREA)
        depth = np.minimum(depth, FAR) * noise.unit
        estimate = _perturb_pose(true_pose, noise, float(np.median(depth)), rng)
        rotated = (normals @ world[:3, :3].T).astype(np.float32)
        seen.append((TrueView(image, depth, rotated, estimate), int(rng.integers(2**63))))
    parts = parallel_map(lambda given: pixel_gaussians(given[0], lens, noise, np.random.default_rng(given[1])), seen)
    return SyntheticScene(
        gaussians=Gaussians.concat(parts),
        cameras=_cameras([view.c2w for view, _ in seen], lens),
        images=tuple(image for image, _, _ in photos[::2]),
        targets=_cameras(moved[1::2], large),
        target_images=tuple(image for image, _, _ in photos[1::2]),
        style=style,
        path=path,
        noise=noise,
    )


def _scale(lens: Lens, factor: int) -> Lens:
    return Lens(factor * lens.width, factor * lens.height, factor * lens.focal)


def _shrink(lens: Lens) -> Lens:
    return Lens(max(8, lens.width // SMALL), max(8, lens.height // SMALL), lens.focal / SMALL)


def _find_stage(rng: np.random.Generator, style: str, path: str, lens: Lens, num_views: int) -> tuple[LitStage, Pose]:
    """A stage and a path through it with usable views only, or the last ones tried."""
    size = 1 << int(np.clip(np.log2(1.6 * max(lens.width, lens.height)), 7, 10))
    for _ in range(STAGE_TRIES):
        view = light_stage(STYLES[style](Palette(rng, size)))
        for _ in range(PATH_TRIES):
            pose = PATHS[path](view.stage, rng, num_views)
            views = (trace(view.shapes, pose(s), _shrink(lens), 1) for s in np.linspace(0, 1, 2 * num_views - 1))
            if all(is_usable(hits) for hits in views):
                return view, pose
    return view, pose


def _photo(
    view: LitStage, grid: Lens, lens: Lens, noise: Noise, gain: float, given: tuple[Array, int]
) -> tuple[Float, Array, Float]:
    """The photo from a pose, with the errors of lens, sensor and exposure, and exact depth and normals of the grid."""
    pose, seed = given
    rng = np.random.default_rng(seed)
    linear, _ = radiance(view, pose, lens, SAMPLES)
    gains = gain * np.exp(noise.exposure * rng.normal() + noise.tint * rng.normal(0, 1, 3))
    y, x = np.mgrid[: lens.height, : lens.width] + 0.5
    away = np.hypot(x - lens.width / 2, y - lens.height / 2) / np.hypot(lens.width, lens.height)
    linear = linear * gains.astype(np.float32) * (1 - 0.3 * away**2)[..., None].astype(np.float32)
    image = cv2.GaussianBlur(develop(linear), (0, 0), noise.blur)
    image = np.clip(image + rng.normal(0, 0.004, image.shape), 0, 1).astype(np.float32)
    hits = trace(view.shapes, pose, grid, 1)
    return np.round(image * 255) / np.float32(255), hits.depth, hits.normals


def _perturb_pose(pose: Array, noise: Noise, depth: float, rng: np.random.Generator) -> Array:
    """The pose with the network's error."""
    turn, _ = cv2.Rodrigues(np.deg2rad(noise.turn) * rng.normal(0, 1, 3) / 3**0.5)
    out = pose.copy()
    out[:3, :3] = pose[:3, :3] @ turn
    out[:3, 3] += noise.shift * depth * rng.normal(0, 1, 3) / 3**0.5
    return out


def _move_pose(pose: Array, world: Array, unit: float) -> Array:
    """The pose in the world of the exporter, in its units."""
    out = world @ pose
    out[:3, 3] *= unit
    return out


def _cameras(poses: Sequence[Array], lens: Lens) -> Cameras:
    viewmats = np.stack([np.linalg.inv(pose) for pose in poses])
    return Cameras(viewmats, np.repeat(lens.intrinsics[None], len(poses), 0), lens.width, lens.height)
