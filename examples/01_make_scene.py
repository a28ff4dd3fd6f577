"""Make a small per-pixel Gaussian scene, the way a feed-forward backbone exports one.

    python examples/01_make_scene.py made

A furnished room is ray-cast from an arc of views: textured floor and walls, one flat untextured wall, a box, a
sphere, poles one to three pixels wide. Every pixel of every view becomes one Gaussian whose depth carries the
errors of a learned depth: a scale bias per view, a slow drift, fine noise, edges that bleed. The folder gets

    scene.ply          one Gaussian per pixel, 17 columns, view-major and row-major
    transforms.json    the cameras (nerfstudio: camera to world, OpenGL axes)
    images/            the photos
    targets/           photos and cameras half-way between the views, for measuring
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
SH_C0 = 0.28209479177387814
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])  # OpenGL camera axes <-> OpenCV camera axes
LIGHT = np.array([-0.45, -0.8, -0.4]) / np.linalg.norm([-0.45, -0.8, -0.4])  # towards the light; y points down
SUBSAMPLES = 3  # rays per pixel and axis for the colours; depth is the centre ray's
COLUMNS = [
    *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"),
    *("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
]


@dataclass(frozen=True)
class Surface:
    """Something a ray can hit: ``intersect(origin, directions) -> t [n], normals [n,3]``, inf where it misses."""

    intersect: Callable[[Array, Array], tuple[Array, Array]]
    paint: Callable[[Array, Array], Array]  # (points [n,3], normals [n,3]) -> rgb [n,3]


def noise_texture(rng: np.random.Generator, size: int = 512, octaves: int = 7) -> Array:
    """``[size,size]`` detail at every scale, mean 0.5: a sum of resized random images."""
    out = np.zeros((size, size))
    for octave in range(octaves):
        cells = 4 << octave
        layer = cv2.resize(rng.uniform(-1, 1, (cells, cells)), (size, size), interpolation=cv2.INTER_CUBIC)
        out += layer * 0.75**octave
    return np.clip(0.5 + 0.2 * out, 0, 1)


def lookup(texture: Array, u: Array, v: Array, scale: float) -> Array:
    """Bilinear sample of a texture that repeats, mirrored, ``scale`` times per world unit."""
    size = len(texture)
    at = [((size - 1) * np.abs(np.mod(c * scale, 2) - 1)).astype(np.float32)[:, None] for c in (u, v)]
    rows = 16384  # cv2.remap takes at most 32767 rows
    parts = [
        cv2.remap(texture, at[0][i : i + rows], at[1][i : i + rows], cv2.INTER_LINEAR) for i in range(0, len(u), rows)
    ]
    return np.concatenate(parts)[:, 0] if parts else np.zeros(0)


def mix(low: tuple[float, ...], high: tuple[float, ...], amount: Array) -> Array:
    """Colour between two colours."""
    return np.asarray(low) + (np.asarray(high) - np.asarray(low)) * amount[:, None]


def plane(axis: int, at: float) -> Callable[[Array, Array], tuple[Array, Array]]:
    """The plane where one coordinate equals ``at``."""

    def intersect(origin: Array, directions: Array) -> tuple[Array, Array]:
        with np.errstate(divide="ignore"):
            t = (at - origin[axis]) / directions[:, axis]
        normals = np.zeros_like(directions)
        normals[:, axis] = -np.sign(directions[:, axis])
        return np.where(t > 1e-6, t, np.inf), normals

    return intersect


def box(low: tuple[float, ...], high: tuple[float, ...]) -> Callable[[Array, Array], tuple[Array, Array]]:
    """An axis-aligned box, by slabs."""

    def intersect(origin: Array, directions: Array) -> tuple[Array, Array]:
        with np.errstate(divide="ignore", invalid="ignore"):
            a, b = (np.asarray(low) - origin) / directions, (np.asarray(high) - origin) / directions
        near, far = np.minimum(a, b), np.maximum(a, b)
        axis = near.argmax(1)
        t = near.max(1)
        hit = (t < far.min(1)) & (t > 1e-6)
        normals = np.zeros_like(directions)
        rows = np.arange(len(directions))
        normals[rows, axis] = -np.sign(directions[rows, axis])
        return np.where(hit, t, np.inf), normals

    return intersect


def sphere(centre: tuple[float, ...], radius: float) -> Callable[[Array, Array], tuple[Array, Array]]:
    """A sphere."""

    def intersect(origin: Array, directions: Array) -> tuple[Array, Array]:
        offset = origin - np.asarray(centre)
        a, b = (directions**2).sum(1), directions @ offset
        root = b * b - a * (offset @ offset - radius**2)
        t = (-b - np.sqrt(np.maximum(root, 0))) / a
        t = np.where((root > 0) & (t > 1e-6), t, np.inf)
        points = offset + directions * np.where(np.isfinite(t), t, 0)[:, None]
        return t, points / radius

    return intersect


def pole(x: float, z: float, radius: float, top: float, bottom: float) -> Callable[..., tuple[Array, Array]]:
    """An upright cylinder between two heights (y points down, so ``top < bottom``)."""

    def intersect(origin: Array, directions: Array) -> tuple[Array, Array]:
        offset, flat = origin[[0, 2]] - np.array([x, z]), directions[:, [0, 2]]
        a, b = (flat**2).sum(1), flat @ offset
        root = b * b - a * (offset @ offset - radius**2)
        t = (-b - np.sqrt(np.maximum(root, 0))) / a
        height = origin[1] + directions[:, 1] * t
        t = np.where((root > 0) & (t > 1e-6) & (height > top) & (height < bottom), t, np.inf)
        points = offset + flat * np.where(np.isfinite(t), t, 0)[:, None]
        return t, np.stack([points[:, 0], np.zeros(len(t)), points[:, 1]], 1) / radius

    return intersect


def furnish(rng: np.random.Generator) -> list[Surface]:
    """The room: x to the right, y down, z away from the cameras; about 6 x 3.4 x 6 units."""
    grain, cloud, speckle = (noise_texture(rng) for _ in range(3))

    def floor(p: Array, _: Array) -> Array:
        tiles = (np.floor(p[:, 0] * 1.6) + np.floor(p[:, 2] * 1.6)) % 2
        return mix((0.42, 0.30, 0.22), (0.82, 0.74, 0.62), 0.45 * tiles + 0.55 * lookup(grain, p[:, 0], p[:, 2], 0.35))

    def flat(p: Array, _: Array) -> Array:
        return np.broadcast_to([0.78, 0.80, 0.76], p.shape)

    def bricks(p: Array, _: Array) -> Array:
        row = np.floor(p[:, 1] * 5)
        joint = (np.mod(p[:, 1] * 5, 1) < 0.12) | (np.mod(p[:, 2] * 2.5 + 0.5 * (row % 2), 1) < 0.06)
        stone = mix((0.45, 0.20, 0.15), (0.75, 0.42, 0.30), lookup(grain, p[:, 2], p[:, 1], 0.5))
        return np.where(joint[:, None], 0.72, stone)

    def paper(p: Array, _: Array) -> Array:
        stripes = np.mod(p[:, 2] * 4, 1) < 0.4
        return mix((0.20, 0.34, 0.42), (0.62, 0.70, 0.66), 0.5 * stripes + 0.5 * lookup(cloud, p[:, 2], p[:, 1], 0.25))

    def crate(p: Array, n: Array) -> Array:
        across = np.where(np.abs(n[:, 0]) > 0.5, p[:, 2], p[:, 0])
        down = np.where(np.abs(n[:, 1]) > 0.5, p[:, 2], p[:, 1])
        return mix((0.10, 0.16, 0.40), (0.95, 0.85, 0.45), lookup(speckle, across, down, 0.6))

    def ball(_: Array, n: Array) -> Array:
        return mix((0.12, 0.40, 0.16), (0.90, 0.62, 0.20), lookup(cloud, np.arctan2(n[:, 0], n[:, 2]), n[:, 1], 0.3))

    def dark(p: Array, _: Array) -> Array:
        return mix((0.08, 0.08, 0.10), (0.80, 0.25, 0.15), (np.mod(p[:, 1] * 3, 1) < 0.5).astype(float))

    return [
        Surface(plane(1, 1.4), floor),
        Surface(plane(1, -2.0), flat),
        Surface(plane(2, 3.0), flat),
        Surface(plane(0, -3.0), bricks),
        Surface(plane(0, 3.0), paper),
        Surface(box((-1.5, 0.3, 0.2), (-0.3, 1.4, 1.3)), crate),
        Surface(box((0.9, -1.2, 2.6), (2.2, 0.2, 3.0)), crate),
        Surface(sphere((0.8, 0.75, -0.1), 0.65), ball),
        Surface(pole(-1.9, -0.3, 0.030, -2.0, 1.4), dark),
        Surface(pole(0.05, 0.1, 0.014, -0.9, 1.4), dark),
        Surface(pole(1.9, 0.6, 0.022, -1.3, 1.4), dark),
    ]


def look_at(position: Array, target: Array) -> Array:
    """``[4,4]`` camera to world, OpenCV axes, with the image's down as near to +y as it gets."""
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right)
    out = np.eye(4)
    out[:3, :3] = np.stack([right, np.cross(forward, right), forward], 1)
    out[:3, 3] = position
    return out


def arc(places: Array) -> list[Array]:
    """Cameras on an arc around the room's middle; ``places`` from 0 (left end) to 1 (right end)."""
    angles = np.deg2rad(-16 + 32 * places)
    heights = -0.35 + 0.15 * np.cos(5 * places)
    centre = np.array([0.0, 0.35, 0.8])
    return [
        look_at(np.array([4.4 * np.sin(a), h, 0.8 - 4.4 * np.cos(a)]), centre)
        for a, h in zip(angles, heights, strict=True)
    ]


def cast(room: list[Surface], c2w: Array, pixels: Array, K: Array) -> tuple[Array, Array, Array]:
    """Depth along z ``[n]``, normals ``[n,3]`` and colours ``[n,3]`` seen at pixel positions ``[n,2]``."""
    local = np.concatenate([(pixels - K[:2, 2]) / K[[0, 1], [0, 1]], np.ones((len(pixels), 1))], 1)
    directions, origin = local @ c2w[:3, :3].T, c2w[:3, 3]
    depth, which = np.full(len(pixels), np.inf), np.zeros(len(pixels), int)
    normals = np.zeros_like(directions)
    for i, surface in enumerate(room):
        t, n = surface.intersect(origin, directions)
        nearer = t < depth
        depth[nearer], which[nearer], normals[nearer] = t[nearer], i, n[nearer]
    points = origin + directions * depth[:, None]
    colours = np.zeros_like(points)
    for i, surface in enumerate(room):
        mine = which == i
        colours[mine] = surface.paint(points[mine], normals[mine])
    shade = 0.62 + 0.38 * np.clip(normals @ LIGHT, 0, 1)
    return depth, normals, np.clip(colours * shade[:, None], 0, 1)


def photograph(room: list[Surface], c2w: Array, K: Array, width: int, height: int) -> tuple[Array, Array, Array]:
    """Image ``[h,w,3]`` (box-filtered), and depth ``[h,w]`` and normals ``[h,w,3]`` of the centre rays."""
    s = SUBSAMPLES
    x, y = np.meshgrid((np.arange(width * s) + 0.5) / s, (np.arange(height * s) + 0.5) / s)
    depth, normals, colours = cast(room, c2w, np.stack([x.ravel(), y.ravel()], 1), K)
    image = colours.reshape(height, s, width, s, 3).mean((1, 3))
    middle = (slice(s // 2, None, s), slice(s // 2, None, s))
    return image, depth.reshape(height * s, width * s)[middle], normals.reshape(height * s, width * s, 3)[middle]


def learned_depth(depth: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """Depth as a network predicts it, and its confidence in [0, 1], both ``[h,w]``."""
    height, width = depth.shape
    inverse = 1 / depth  # networks smooth inverse depth, so near things grow fat
    soft = cv2.GaussianBlur(inverse, (0, 0), 1.0)
    edge = np.clip(np.abs(soft * depth - 1) / 0.05, 0, 1)
    bled = 1 / (inverse + 0.4 * (soft - inverse) * edge)
    drift = cv2.resize(rng.normal(0, 0.01, (4, 5)), (width, height), interpolation=cv2.INTER_CUBIC)
    bias = rng.normal(0, 0.01)
    return bled * (1 + bias) * (1 + drift) * (1 + rng.normal(0, 0.003, depth.shape)), 1 - 0.7 * edge


def pixel_gaussians(
    image: Array, depth: Array, normals: Array, c2w: Array, K: Array, rng: np.random.Generator
) -> Array:
    """``[h·w,17]`` rows of the PLY, one Gaussian per pixel in row-major order."""
    height, width = depth.shape
    n = height * width
    noisy, confidence = (a.reshape(-1) for a in learned_depth(depth, rng))
    v, u = np.mgrid[:height, :width].reshape(2, -1) + 0.5 + rng.uniform(-0.25, 0.25, (2, n))
    local = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones(n)], 1) * noisy[:, None]
    means = local @ c2w[:3, :3].T + c2w[:3, 3]
    # discs: the thin third axis along the normal; the shortest rotation from +z to it
    normal = normals.reshape(-1, 3) + rng.normal(0, 0.1, (n, 3))
    normal *= np.where(normal[:, 2:] < 0, -1, 1) / np.linalg.norm(normal, axis=1, keepdims=True)
    quats = np.stack([1 + normal[:, 2], -normal[:, 1], normal[:, 0], np.zeros(n)], 1)
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    scales = (noisy / K[0, 0])[:, None] * np.array([0.75, 0.75, 0.25]) * np.exp(rng.normal(0, 0.25, (n, 3)))
    oversized = rng.random(n) < 0.003
    scales[oversized] *= rng.uniform(3, 10, (oversized.sum(), 1))
    opacities = np.clip(0.25 + 0.7 * confidence + rng.normal(0, 0.05, n), 0.02, 0.995)
    colours = np.clip(image.reshape(-1, 3) + rng.normal(0, 0.01, (n, 3)), 0, 1)
    logits = np.log(opacities / (1 - opacities))[:, None]
    return np.concatenate([means, np.zeros((n, 3)), (colours - 0.5) / SH_C0, logits, np.log(scales), quats], 1)


def write_columns(path: Path, rows: Array) -> None:
    """Binary little-endian PLY of float32 columns."""
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    header += [*(f"property float {name}" for name in COLUMNS), "end_header", ""]
    path.write_bytes("\n".join(header).encode() + np.ascontiguousarray(rows, dtype="<f4").tobytes())


def write_views(folder: Path, images: list[Array], poses: list[Array], K: Array) -> None:
    """``images/*.png`` and ``transforms.json`` below ``folder``."""
    (folder / "images").mkdir(parents=True, exist_ok=True)
    frames = []
    for i, (image, c2w) in enumerate(zip(images, poses, strict=True)):
        name = f"images/view_{i:02d}.png"
        cv2.imwrite(str(folder / name), np.round(image[..., ::-1] * 255).astype(np.uint8))
        frames.append({"file_path": name, "transform_matrix": (c2w @ FLIP).tolist()})
    height, width = images[0].shape[:2]
    shared = {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "w": width, "h": height}
    (folder / "transforms.json").write_text(json.dumps({"camera_model": "PINHOLE", **shared, "frames": frames}))


def make_scene(out: str | Path, *, num_views: int = 6, width: int = 240, height: int = 160, seed: int = 0) -> Path:
    """Write the scene folder and return it.

    Args:
        out: Folder to write to; made where it does not exist.
        num_views: Views with Gaussians, at least 2; the targets are one fewer.
        width: Image width, pixels.
        height: Image height, pixels.
        seed: Seeds the textures and every error; the same seed writes the same bytes.
    """
    out, rng = Path(out), np.random.default_rng(seed)
    room = furnish(rng)
    K = np.array([[0.95 * width, 0, width / 2], [0, 0.95 * width, height / 2], [0, 0, 1]])
    places = np.linspace(0, 1, num_views)
    poses, between = arc(places), arc((places[1:] + places[:-1]) / 2)
    views = [photograph(room, c2w, K, width, height) for c2w in poses]
    targets = [photograph(room, c2w, K, width, height)[0] for c2w in between]
    write_views(out, [image for image, _, _ in views], poses, K)
    write_views(out / "targets", targets, between, K)
    rows = [pixel_gaussians(*view, c2w, K, rng) for view, c2w in zip(views, poses, strict=True)]
    write_columns(out / "scene.ply", np.concatenate(rows))
    return out


def main() -> None:
    """Parse the command line and make the scene."""
    parser = argparse.ArgumentParser(description="Make a small per-pixel Gaussian scene.")
    parser.add_argument("out", type=Path)
    parser.add_argument("--views", type=int, default=6)
    parser.add_argument("--width", type=int, default=240)
    parser.add_argument("--height", type=int, default=160)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    out = make_scene(args.out, num_views=args.views, width=args.width, height=args.height, seed=args.seed)
    print(f"{out / 'scene.ply'}: {args.views * args.width * args.height} Gaussians, {args.views} views")


if __name__ == "__main__":
    main()
