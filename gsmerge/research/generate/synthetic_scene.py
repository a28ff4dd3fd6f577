"""Make a synthetic scene in memory: a room, its photos, and the Gaussians that a network would predict from them."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import cv2
import numpy as np

from gsmerge.geometry import quat_to_rotmat
from gsmerge.kernels.elementary import cos, exp, sin
from gsmerge.kernels.matrices import matmul
from gsmerge.kernels.pictures import blur
from gsmerge.research.generate.noise import Noise, NoiseOptions, TrueView, draw_noise, pixel_gaussians
from gsmerge.research.generate.objects import room
from gsmerge.research.generate.photograph import (
    FAR,
    SAMPLE_RAYS,
    Float,
    Hits,
    LitStage,
    Pinhole,
    Stage,
    develop,
    find_exposure,
    light_stage,
    radiance,
    trace,
)
from gsmerge.research.generate.shapes import Array, invert, norm
from gsmerge.research.generate.textures import Palette
from gsmerge.runtime.threads import parallel_map
from gsmerge.settings.setting import Settings, setting
from gsmerge.types import Cameras, Gaussians

PATH_TRIES, STAGE_TRIES = 6, 6  # most paths per stage, and most stages, that are tried until all views are usable
SMALL = 8  # views are checked, and exposures computed, at this fraction of the size
FOCAL = 0.58, 1.75  # range of the focal length, in the longer sides of the photo
MIN_NEAR = 0.22  # first percentile of the depths, as a share of their median
MAX_TURN = 50  # degrees between neighbouring views
ARC = 15, 60  # range of the angle that a path has around the focus, degrees
SWING = 35  # largest angle of cameras to either side of -z, seen from the focus, degrees
HEIGHT = 0.9, 1.8  # range of the height of cameras above the ground, metres
Pose = Callable[[float], Array]  # camera to world at 0, the start of a path, to 1


def look_at(eye: Array, target: Array, roll: float = 0.0) -> Array:
    """Compute a camera-to-world matrix ``[4,4]``, OpenCV axes, upright (y down) except for ``roll`` radians."""
    forward = (target - eye) / norm(target - eye)
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= norm(right)
    down = np.cross(forward, right)
    out = np.eye(4)
    out[:3, 0] = cos(roll) * right + sin(roll) * down
    out[:3, 1] = cos(roll) * down - sin(roll) * right
    out[:3, 2], out[:3, 3] = forward, eye
    return out


def draw_path(stage: Stage, rng: np.random.Generator, num_views: int) -> Pose:
    """Draw an arc around the focus that sways up and down."""
    limit = MAX_TURN * max(1, num_views - 1)
    span = rng.uniform(min(ARC[0], limit), min(ARC[1], limit))
    start = rng.uniform(-SWING, SWING - span)
    distance, height = rng.uniform(*stage.distance), rng.uniform(*HEIGHT)
    swing = rng.uniform(0, 0.4) * (HEIGHT[1] - HEIGHT[0])
    phase, closer = rng.uniform(0, 6.28), rng.uniform(-0.12, 0.12)

    def pose(s: float) -> Array:
        angle, away = np.deg2rad(start + span * s), distance * (1 + closer * s)
        x, _, z = stage.focus
        eye = np.array([x + away * sin(angle), -(height + swing * sin(6 * s + phase)), z - away * cos(angle)])
        return look_at(eye, stage.focus, 0.03 * sin(5 * s + phase))

    return pose


def is_usable(hits: Hits) -> bool:
    """Return True if a view is outside all shapes and not too close to any."""
    depth = hits.depth[hits.depth < FAR]
    if depth.size < 0.6 * hits.depth.size:
        return False
    return bool(np.percentile(depth, 1) > MIN_NEAR * np.median(depth) or np.percentile(depth, 1) > 0.6)


@dataclass(frozen=True)
class GenerateOptions(Settings):
    """Settings of synthetic scenes."""

    views: int = setting(
        6, "Number of views in a scene.", "One target is between any two neighbours.", least=2, most=1000
    )
    width: int = setting(320, "Width of the views.", least=16, most=2048, unit="pixels")
    height: int = setting(240, "Height of the views.", least=16, most=2048, unit="pixels")
    photo_scale: int = setting(1, "Times the views' size that the photos have; the network sees the views' own.",
        least=1, most=8)  # fmt: skip
    noise: float = setting(1.0, "Factor on the simulated errors of the network.", least=0, most=10)
    ranges: NoiseOptions = setting(NoiseOptions(), "The errors and habits.")

    def to_dict(self) -> dict[str, Any]:
        """Convert all settings to JSON types."""
        return dict(json.loads(json.dumps(asdict(self))))


@dataclass(frozen=True)
class SyntheticScene:
    """A scene as a feed-forward network would export it, with held-out views."""

    gaussians: Gaussians  # one for each pixel, view-major and row-major
    cameras: Cameras  # as the network estimates them
    images: tuple[Float, ...]  # photos [h,w,3], sRGB in [0, 1]; larger than the views by ``photo_scale``
    targets: Cameras  # true cameras half-way between neighbouring views, at the size of the photos
    target_images: tuple[Float, ...]  # photos of these cameras
    noise: Noise


def make_scene(seed: int, index: int, options: GenerateOptions) -> SyntheticScene:
    """Generate scene ``index`` of a series; the same arguments give the same bits on any number of threads."""
    rng = np.random.default_rng([seed, index])
    num_views = options.views
    noise = draw_noise(options.ranges, rng, options.noise)
    focal = max(options.width, options.height) * rng.uniform(*FOCAL)
    lens = Pinhole(options.width, options.height, focal)
    scale = options.photo_scale
    large = Pinhole(scale * lens.width, scale * lens.height, scale * lens.focal)  # camera of the photos
    scene, pose = _find_stage(rng, large, num_views)
    places = np.linspace(0, 1, 2 * num_views - 1)
    poses = [pose(s) for s in places]
    gain = find_exposure([radiance(scene, p, _shrink(lens), 1) for p in poses[::2]], rng.uniform(0.22, 0.62))
    seeds = rng.integers(0, 2**63, len(poses))
    world = invert(poses[0]) if rng.random() < 0.5 else np.eye(4)  # many exporters use the frame of the first camera
    moved = [matmul(world, pose) for pose in poses]  # in the world and the units of the exporter
    for estimate in moved:
        estimate[:3, 3] *= noise.unit
    views = range(0, len(poses), 2)
    errors = {i: (rng.normal(0, 1, (2, 3)), int(rng.integers(2**63))) for i in views}

    def take(i: int) -> tuple[Float, Array, Gaussians | None]:
        """Take the photo at one place of the path; at the place of a view also estimate its pose and Gaussians."""
        image = _photo(scene, poses[i], large, noise, gain, seeds[i])
        if i not in errors:
            return image, moved[i], None
        deviation, seed = errors[i]
        hits = trace(scene.shapes, poses[i], lens, 1)
        depth = np.minimum(hits.depth, FAR) * noise.unit
        estimate = _perturb_pose(moved[i], noise, float(np.median(depth)), deviation)
        normals = matmul(hits.normals, world[:3, :3].T).astype(np.float32)
        seen = image if large == lens else cv2.resize(image, (lens.width, lens.height), interpolation=cv2.INTER_AREA)
        predicted = pixel_gaussians(TrueView(seen, depth, normals, estimate), lens, noise, np.random.default_rng(seed))
        return image, estimate, predicted

    shots = parallel_map(take, [*views, *range(1, len(poses), 2)])
    return SyntheticScene(
        gaussians=Gaussians.concat([gaussians for _, _, gaussians in shots if gaussians is not None]),
        cameras=_cameras([pose for _, pose, _ in shots[:num_views]], lens),
        images=tuple(image for image, _, _ in shots[:num_views]),
        targets=_cameras([pose for _, pose, _ in shots[num_views:]], large),
        target_images=tuple(image for image, _, _ in shots[num_views:]),
        noise=noise,
    )


def _shrink(lens: Pinhole) -> Pinhole:
    return Pinhole(max(8, lens.width // SMALL), max(8, lens.height // SMALL), lens.focal / SMALL)


def _find_stage(rng: np.random.Generator, lens: Pinhole, num_views: int) -> tuple[LitStage, Pose]:
    """Draw a room and a path on which all views are usable; after too many tries, return the last ones."""
    side = 1 << min(max(int(1.6 * max(lens.width, lens.height)).bit_length() - 1, 7), 10)  # side of textures, pixels
    for _ in range(STAGE_TRIES):
        scene = light_stage(room(Palette(rng, side)))
        for _ in range(PATH_TRIES):
            pose = draw_path(scene.stage, rng, num_views)
            poses = (pose(s) for s in np.linspace(0, 1, 2 * num_views - 1))
            if all(is_usable(trace(scene.shapes, at, _shrink(lens), 1)) for at in poses):
                return scene, pose
    return scene, pose


def _photo(scene: LitStage, pose: Array, lens: Pinhole, noise: Noise, gain: float, seed: int) -> Float:
    """Take a photo with the errors of lens, sensor and exposure."""
    rng = np.random.default_rng(seed)
    linear = radiance(scene, pose, lens, SAMPLE_RAYS)
    gains = gain * exp(noise.exposure * rng.normal() + noise.tint * rng.normal(0, 1, 3))
    y, x = np.mgrid[: lens.height, : lens.width] + 0.5
    away = ((x - lens.width / 2) ** 2 + (y - lens.height / 2) ** 2) / (lens.width**2 + lens.height**2)
    linear = linear * gains.astype(np.float32) * (1 - 0.3 * away)[..., None].astype(np.float32)
    image = blur(develop(linear), noise.blur)
    image = np.clip(image + rng.normal(0, 0.004, image.shape), 0, 1).astype(np.float32)
    return np.round(image * 255) / np.float32(255)


def _perturb_pose(pose: Array, noise: Noise, depth: float, deviation: Array) -> Array:
    """Add the network's error to a pose; ``deviation [2,3]`` is of rotation and position, in units of their errors."""
    turn = np.deg2rad(noise.turn) * deviation[0] / 3**0.5
    angle = np.sqrt((turn * turn).sum())
    quat = np.array([cos(angle / 2), *(sin(angle / 2) / max(angle, 1e-12) * turn)])
    out = pose.copy()
    out[:3, :3] = matmul(pose[:3, :3], quat_to_rotmat(quat))
    out[:3, 3] += noise.shift * depth * deviation[1] / 3**0.5
    return out


def _cameras(poses: Sequence[Array], lens: Pinhole) -> Cameras:
    viewmats = np.stack([invert(pose) for pose in poses])
    return Cameras(viewmats, np.repeat(lens.intrinsics[None], len(poses), 0), lens.width, lens.height)
