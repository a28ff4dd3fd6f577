"""Make a synthetic scene in memory: a room, its photos, and the Gaussians that a network would predict from them."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from typing import Any

import cv2
import numpy as np

from gsmerge.frozen import asdict, dataclass, replace
from gsmerge.method.geometry.transforms import quat_to_rotmat
from gsmerge.method.kernels.elementary import cos, exp, sin
from gsmerge.method.kernels.matrices import matmul
from gsmerge.method.kernels.pictures import blur
from gsmerge.research.generate.noise import Noise, NoiseOptions, TrueView, draw_noise, pixel_gaussians
from gsmerge.research.generate.objects import build_room
from gsmerge.research.generate.photograph import (
    NO_SURFACE_DEPTH,
    SAMPLE_RAYS,
    Float,
    Hits,
    LitRoom,
    Pinhole,
    Room,
    find_exposure,
    light_room,
    render_light,
    tone_map,
    trace,
)
from gsmerge.research.generate.shapes import Array, invert_motion, norm
from gsmerge.research.generate.textures import Palette
from gsmerge.runtime.threads import parallel_map
from gsmerge.settings.setting import Settings, setting
from gsmerge.types import Cameras, Gaussians

FOCAL = 0.58, 1.75  # range of the focal length, in the longer sides of the photo
SWING = 35  # largest angle, at the focus, between -z and the direction to a camera, degrees
CAMERA_HEIGHTS = 0.9, 1.8  # range of the height of cameras above the ground, metres
PathFunction = Callable[[float], Array]  # from a position along the path, 0 to 1, to a camera-to-world matrix [4,4]


def look_at(eye: Array, target: Array, roll: float = 0.0) -> Array:
    """Compute the camera-to-world matrix ``[4,4]``, OpenCV axes, of a camera at ``eye`` that looks at ``target``.

    The camera is upright (y down) except for ``roll`` radians.
    """
    forward = (target - eye) / norm(target - eye)
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= norm(right)
    down = np.cross(forward, right)
    out = np.eye(4)
    out[:3, 0] = cos(roll) * right + sin(roll) * down
    out[:3, 1] = cos(roll) * down - sin(roll) * right
    out[:3, 2] = forward
    out[:3, 3] = eye
    return out


def draw_path(room: Room, rng: np.random.Generator, num_views: int) -> PathFunction:
    """Draw a random path: an arc around the focus, on which the camera also moves up and down."""
    max_turn = 50  # largest angle between neighbouring views, degrees
    limit = max_turn * max(1, num_views - 1)
    arc_degrees = 15, 60  # range of the angle that a path has around the focus, degrees
    span = rng.uniform(min(arc_degrees[0], limit), min(arc_degrees[1], limit))
    start = rng.uniform(-SWING, SWING - span)
    distance, height = rng.uniform(*room.distance), rng.uniform(*CAMERA_HEIGHTS)
    sway = rng.uniform(0, 0.4) * (CAMERA_HEIGHTS[1] - CAMERA_HEIGHTS[0])  # largest change of the height, metres
    phase, growth = rng.uniform(0, 6.28), rng.uniform(-0.12, 0.12)  # phase of the sway, growth of the distance

    def pose(s: float) -> Array:
        """Return the camera-to-world matrix at a position along the path, 0 to 1."""
        angle = np.deg2rad(start + span * s)
        radius = distance * (1 + growth * s)
        x, _, z = room.focus
        eye = np.array([x + radius * sin(angle), -(height + sway * sin(6 * s + phase)), z - radius * cos(angle)])
        return look_at(eye, room.focus, 0.03 * sin(5 * s + phase))

    return pose


def is_usable(hits: Hits) -> bool:
    """Return True if most of a view's rays hit a shape, and the camera is not too close to any shape."""
    depth = hits.depth[hits.depth < NO_SURFACE_DEPTH]
    min_hits = 0.6  # least share of a usable view's rays that hit a shape
    if depth.size < min_hits * hits.depth.size:
        return False
    nearest = np.percentile(depth, 1)
    # least distance of the nearest shape: in median depths, or in metres
    min_near = 0.22
    min_near_metres = 0.6
    return bool(nearest > min_near * np.median(depth) or nearest > min_near_metres)


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


@dataclass(frozen=True, eq=False)
class _PhotoSession:
    """A lit room with the poses of cameras, and the settings of its photos and of the simulated network."""

    lit: LitRoom
    poses: list[Array]  # camera to world, in metres, along the path: even indices: views, odd indices: held-out views
    to_export: Array  # [4,4] world of the room -> world of the exporter, without its unit
    lens: Pinhole  # camera of the views
    photo_lens: Pinhole  # camera of the photos
    noise: Noise
    gain: float  # exposure of the photos

    def exported_pose(self, place: int) -> Array:
        """Return the camera-to-world matrix of a place on the path, in the world and the units of the exporter."""
        pose = matmul(self.to_export, self.poses[place])
        pose[:3, 3] *= self.noise.unit
        return pose

    def take_photo(self, place: int, seed: int) -> Float:
        """Take the photo ``[h,w,3]`` of a place on the path, with the errors of lens and sensor."""
        rng = np.random.default_rng(seed)
        lens = self.photo_lens
        noise = self.noise
        linear = render_light(self.lit, self.poses[place], lens, SAMPLE_RAYS)
        gains = self.gain * exp(noise.exposure * rng.normal() + noise.tint * rng.normal(0, 1, 3))
        y, x = np.mgrid[: lens.height, : lens.width] + 0.5
        square_radius = ((x - lens.width / 2) ** 2 + (y - lens.height / 2) ** 2) / (lens.width**2 + lens.height**2)
        vignette = 0.3  # share of light lost at one diagonal from the middle; it grows with the squared distance
        linear = linear * gains.astype(np.float32) * (1 - vignette * square_radius)[..., None].astype(np.float32)
        image = blur(tone_map(linear), noise.blur)
        sensor_noise = 0.004  # standard deviation of the noise of a photo, sRGB
        image = np.clip(image + rng.normal(0, sensor_noise, image.shape), 0, 1).astype(np.float32)
        return np.round(image * 255) / np.float32(255)

    def predict(self, place: int, photo: Float, deviation: Array, seed: int) -> tuple[Array, Gaussians]:
        """Simulate the network for the photo of a place on the path.

        Return the pose and the Gaussians that the network would estimate.
        ``deviation [2,3]`` has standard normal numbers for the errors of rotation and position, which are multiplied by
        the sizes of these errors, ``noise.turn`` and ``noise.shift``.
        """
        hits = trace(self.lit.shapes, self.poses[place], self.lens, 1)
        depth = np.minimum(hits.depth, NO_SURFACE_DEPTH) * self.noise.unit
        pose = self.exported_pose(place)
        rotation = np.deg2rad(self.noise.turn) * deviation[0] / 3**0.5
        angle = np.sqrt((rotation * rotation).sum())
        quat = np.array([cos(angle / 2), *(sin(angle / 2) / max(angle, 1e-12) * rotation)])
        pose[:3, :3] = matmul(pose[:3, :3], quat_to_rotmat(quat))
        pose[:3, 3] += self.noise.shift * float(np.median(depth)) * deviation[1] / 3**0.5
        normals = matmul(hits.normals, self.to_export[:3, :3].T).astype(np.float32)
        size = self.lens.width, self.lens.height
        image = photo if self.photo_lens == self.lens else cv2.resize(photo, size, interpolation=cv2.INTER_AREA)
        view = TrueView(image, depth, normals, pose)
        return pose, pixel_gaussians(view, self.lens, self.noise, np.random.default_rng(seed))


def make_synthetic_scene(seed: int, index: int, options: GenerateOptions) -> SyntheticScene:
    """Generate scene ``index`` of a series; the same arguments give the same bits on any number of threads.

    Places along the path of the camera are alternately input views and held-out views.
    """
    rng = np.random.default_rng([seed, index])
    session = _plan_session(rng, options)
    num_places = len(session.poses)
    photo_seeds = rng.integers(0, 2**63, num_places)
    # Half of the scenes have the first camera at the origin, as the files of many exporters do
    session = replace(session, to_export=invert_motion(session.poses[0]) if rng.random() < 0.5 else np.eye(4))
    views = range(0, num_places, 2)
    targets = range(1, num_places, 2)
    errors = {view: (rng.normal(0, 1, (2, 3)), int(rng.integers(2**63))) for view in views}  # deviation and seed

    def take_view(place: int) -> tuple[Float, Array, Gaussians | None]:
        """Return the photo, the pose and the Gaussians of a place; held-out views have no Gaussians."""
        photo = session.take_photo(place, photo_seeds[place])
        if place in targets:
            return photo, session.exported_pose(place), None
        return photo, *session.predict(place, photo, *errors[place])

    photos, poses, gaussians = zip(*parallel_map(take_view, [*views, *targets]), strict=True)
    num_views = len(views)
    return SyntheticScene(
        gaussians=Gaussians.concat(list(gaussians[:num_views])),
        cameras=_to_cameras(poses[:num_views], session.lens),
        images=photos[:num_views],
        targets=_to_cameras(poses[num_views:], session.photo_lens),
        target_images=photos[num_views:],
        noise=session.noise,
    )


def _plan_session(rng: np.random.Generator, options: GenerateOptions) -> _PhotoSession:
    """Draw the errors, cameras, room, path and exposure of a scene, in the world of the room."""
    noise = draw_noise(options.ranges, rng, options.noise)
    focal = max(options.width, options.height) * rng.uniform(*FOCAL)
    lens = Pinhole(options.width, options.height, focal)
    scale = options.photo_scale
    photo_lens = Pinhole(scale * lens.width, scale * lens.height, scale * lens.focal)
    lit, path = _find_room(rng, photo_lens, options.views)
    poses = [path(s) for s in np.linspace(0, 1, 2 * options.views - 1)]
    previews = [render_light(lit, pose, _shrink_lens(lens), 1) for pose in poses[::2]]
    brightness = 0.22, 0.62  # range of the mean of a scene's photos, sRGB
    gain = find_exposure(previews, rng.uniform(*brightness))
    return _PhotoSession(
        lit, poses=poses, to_export=np.eye(4), lens=lens, photo_lens=photo_lens, noise=noise, gain=gain
    )


def _shrink_lens(lens: Pinhole) -> Pinhole:
    """Return a smaller camera for previews, which show whether views are usable, and how bright they are."""
    divisor = 8  # the sides of a preview are the sides of a view divided by this
    return Pinhole(max(8, lens.width // divisor), max(8, lens.height // divisor), lens.focal / divisor)


def _find_room(rng: np.random.Generator, lens: Pinhole, num_views: int) -> tuple[LitRoom, PathFunction]:
    """Draw a room and a path on which all views are usable. After too many tries, return the last room and path."""
    power = int(1.6 * max(lens.width, lens.height)).bit_length() - 1
    side = 2 ** min(max(power, 7), 10)  # side of textures, pixels: a power of two near the photo's side
    # most paths per room, and most rooms
    path_tries = 6
    room_tries = 6
    for _ in range(room_tries):
        lit = light_room(build_room(Palette(rng, side)))
        for _ in range(path_tries):
            path = draw_path(lit.room, rng, num_views)
            poses = (path(s) for s in np.linspace(0, 1, 2 * num_views - 1))
            if all(is_usable(trace(lit.shapes, pose, _shrink_lens(lens), 1)) for pose in poses):
                return lit, path
    return lit, path


def _to_cameras(poses: Sequence[Array], lens: Pinhole) -> Cameras:
    """Return cameras with one lens at camera-to-world poses."""
    viewmats = np.stack([invert_motion(pose) for pose in poses])
    return Cameras(viewmats, np.repeat(lens.intrinsics[None], len(poses), 0), lens.width, lens.height)
