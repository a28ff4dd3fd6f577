"""Render photos and exact depth of a stage: rays, textures, light with shadows, exposure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from gsmerge.kernels.cast import BLOB, BOX, CONE, ELLIPSOID, add_light, cast
from gsmerge.kernels.elementary import arctan2, cos, power, sin
from gsmerge.kernels.matrices import matmul
from gsmerge.research.generate.shapes import Array, Shape, ShapeArrays, bounds, norm, pack, rotate
from gsmerge.research.generate.textures import Picture, pyramid

FAR = 1e6  # depth of pixels without a surface
NEAR_PLANE = 1e-3
SAMPLE_RAYS = 2  # rays per pixel and axis for the colours; depth is that of the pixel's centre
KEY_MAPS, KEY_SIZE = 5, 640  # number of shadow maps of the direct light, for soft shadows, and their side in pixels
AMBIENT_MAPS, AMBIENT_SIZE = 24, 256  # the same for the light from all sides
BEHIND = 1000.0  # distance of a shadow map's camera in radii, so that its rays are nearly parallel
GLOW = 0.7  # brightness of glowing shapes, relative to a white wall in full light
FROM_BELOW = 0.5  # light from below, relative to that from above

Float: TypeAlias = NDArray[Any]  # float32


@dataclass(frozen=True)
class Light:
    """The lights of a scene."""

    towards: Array  # [3] unit vector to the light
    lamp: Array  # [3] position, near which surfaces are brighter
    key: Array  # [3] linear colour of the direct light
    ambient: Array  # [3] linear colour of the light from all sides
    softness: float  # half width of the light, radians


@dataclass(frozen=True)
class Stage:
    """Shapes, textures and light of a scene; y points down, and the cameras look along +z."""

    shapes: tuple[Shape, ...]
    textures: tuple[Picture, ...]  # indexed by the shapes' materials
    light: Light
    focus: Array  # [3] point at which cameras are aimed
    distance: tuple[float, float]  # range of the distance of cameras from the focus


@dataclass(frozen=True)
class Pinhole:
    """Image size and focal length of a camera, pixels."""

    width: int
    height: int
    focal: float

    @property
    def intrinsics(self) -> Array:
        """Intrinsics ``[3,3]`` with the principal point in the middle."""
        return np.array([[self.focal, 0, self.width / 2], [0, self.focal, self.height / 2], [0, 0, 1.0]])


@dataclass(frozen=True)
class Hits:
    """First hits of a view's rays, h x w samples."""

    depth: Array  # [h,w] along the camera's z
    ids: NDArray[np.int32]  # [h,w] shape, -1 without any
    points: Float  # [h,w,3] in the shape's frame
    normals: Float  # [h,w,3] world, towards the camera


@dataclass(frozen=True)
class LitStage:
    """A stage with shadow maps, ready to be rendered."""

    stage: Stage
    shapes: ShapeArrays
    mips: tuple[list[Picture], ...]  # mipmaps of every texture
    axes: Array  # [k,3,3] axes of the lights, direct ones first
    middle: Array  # [3] middle of the shadow maps
    radius: float  # half side of the shadow maps
    key: Float  # shadow maps of the direct light
    ambient: Float  # shadow maps of the light from all sides
    weights: Array  # [k] weights of the ambient maps


def screen_boxes(shapes: ShapeArrays, c2w: Array, lens: Pinhole, samples: int) -> NDArray[np.int32]:
    """Compute boxes x0, y0, x1, y1 ``[m,4]``, in samples, that contain each shape's image."""
    half = bounds(shapes)
    signs = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1], indexing="ij"), -1).reshape(-1, 3)
    corners = matmul(half[:, None] * signs, shapes.rotations.swapaxes(1, 2)) + shapes.centres[:, None]
    local = matmul(corners - c2w[:3, 3], c2w[:3, :3])
    edges = np.array([(i, i | bit) for bit in (1, 2, 4) for i in range(8) if not i & bit])
    a, b = local[:, edges[:, 0]], local[:, edges[:, 1]]
    with np.errstate(divide="ignore", invalid="ignore"):  # for edges that cross the near plane
        crossing = a + (b - a) * ((NEAR_PLANE - a[..., 2:]) / (b[..., 2:] - a[..., 2:]))
    crosses = (a[..., 2] < NEAR_PLANE) != (b[..., 2] < NEAR_PLANE)
    points = np.concatenate([local, np.where(crosses[..., None], crossing, 0.0)], 1)
    seen = np.concatenate([local[..., 2] >= NEAR_PLANE, crosses], 1)[..., None]
    at = points[..., :2] / np.where(seen, points[..., 2:], 1) * lens.focal + [lens.width / 2, lens.height / 2]
    limits = np.array([lens.width, lens.height]) * samples
    low = np.where(seen, np.floor(at * samples) - 1, np.inf).min(1)
    high = np.where(seen, np.ceil(at * samples) + 1, -np.inf).max(1)
    return np.concatenate([np.clip(low, 0, limits), np.clip(high, 0, limits)], 1).astype(np.int32)


def trace(shapes: ShapeArrays, c2w: Array, lens: Pinhole, samples: int) -> Hits:
    """Cast ``samples`` x ``samples`` rays for each pixel."""
    h, w = lens.height * samples, lens.width * samples
    hits = Hits(np.full((h, w), FAR), np.full((h, w), -1, np.int32), *np.zeros((2, h, w, 3), np.float32))
    intrinsics = np.array([lens.focal, lens.focal, lens.width / 2, lens.height / 2])
    c2w = np.ascontiguousarray(c2w, dtype=np.float64)
    eye, axes = c2w[:3, 3].copy(), c2w[:3, :3].copy()
    table = shapes.kinds, shapes.rotations, shapes.centres, shapes.sizes, shapes.waves
    rects = screen_boxes(shapes, c2w, lens, samples)
    cast(eye, axes, intrinsics, 1.0 / samples, *table, rects, hits.depth, hits.ids, hits.points, hits.normals)
    return hits


def _axes(towards: Array) -> Array:
    """Compute the rows right, down, forward ``[3,3]`` of light that comes from a direction."""
    forward = -towards / norm(towards)
    right = np.cross([0.3, 1.0, 0.2], forward)
    right /= norm(right)
    return np.stack([right, np.cross(forward, right), forward])


def _shadow_map(shapes: ShapeArrays, axes: Array, middle: Array, radius: float, size: int) -> Float:
    """Compute a shadow map ``[size,size]``: depth of the first surface, relative to the middle."""
    c2w = np.eye(4)
    c2w[:3, :3], c2w[:3, 3] = axes.T, middle - BEHIND * radius * axes[2]
    hits = trace(shapes, c2w, Pinhole(size, size, BEHIND * size / 2), 1)
    return (hits.depth - BEHIND * radius).astype(np.float32)


def light_stage(stage: Stage) -> LitStage:
    """Prepare a stage for rendering: arrays, smaller textures, shadow maps."""
    opaque = pack([s for s in stage.shapes if not s.shell and not s.glow] or stage.shapes[:1])
    extent = bounds(opaque)
    reach = np.linalg.norm(extent, axis=1)
    low, high = (opaque.centres - reach[:, None]).min(0), (opaque.centres + reach[:, None]).max(0)
    middle, radius = (low + high) / 2, norm(high - low) / 2
    rng = np.random.default_rng(0)
    key = [stage.light.towards + stage.light.softness * rng.normal(0, 0.6, 3) for _ in range(KEY_MAPS)]
    rotations = np.arange(AMBIENT_MAPS) + 0.5  # evenly over the sphere (Fibonacci)
    up, angle = 1 - 2 * rotations / AMBIENT_MAPS, np.pi * (1 + 5**0.5) * rotations
    flat = np.sqrt(1 - up**2)
    ambient = np.stack([flat * cos(angle), -up, flat * sin(angle)], 1)
    axes = np.stack([_axes(towards) for towards in (*key, *ambient)])
    return LitStage(
        stage,
        pack(stage.shapes),
        tuple(pyramid(texture) for texture in stage.textures),
        axes,
        middle,
        radius,
        np.stack([_shadow_map(opaque, a, middle, radius, KEY_SIZE) for a in axes[:KEY_MAPS]]),
        np.stack([_shadow_map(opaque, a, middle, radius, AMBIENT_SIZE) for a in axes[KEY_MAPS:]]),
        np.where(up > 0, 1.0, FROM_BELOW) * 4 / AMBIENT_MAPS,
    )


def coordinates(shapes: ShapeArrays, ids: NDArray[np.int32], points: Float) -> tuple[Float, Float]:
    """Compute texture coordinates ``[n,2]`` of points in shape frames, and texture repeats per world unit ``[n]``."""
    kinds, half = shapes.kinds[ids], shapes.sizes[ids, :3].astype(np.float32)
    x, y, z = points.T
    a, b, c = (np.abs(points) / np.maximum(half, 1e-9)).T
    turned = (kinds == ELLIPSOID) | (kinds == BLOB) | ((kinds == CONE) & (b < 1 - 1e-5))
    girth = np.maximum(half[:, 0], half[:, 2])
    side = (kinds == BOX) & (a >= b) & (a >= c)
    top = ((kinds == BOX) & (b > a) & (b >= c)) | ((kinds == CONE) & ~turned)
    around = arctan2(x, z)
    u = np.where(turned, around * girth, np.where(side, z, x))
    v = np.where(top, z, y)
    wide = np.where(turned, np.pi * girth, np.where(side, half[:, 2], half[:, 0]))
    high = np.where(top, half[:, 2], half[:, 1])
    materials = [s.material for s in shapes.shapes]
    repeat = np.array([material.repeat for material in materials], np.float32)[ids]
    shift = np.array([material.shift for material in materials], np.float32)[ids]
    once = repeat == 0
    u = np.where(once, u / (2 * wide) + 0.5, u * repeat + shift[:, 0])
    v = np.where(once, v / (2 * high) + 0.5, v * repeat + shift[:, 1])
    return np.stack([u, v], 1).astype(np.float32), np.where(once, 0.5 / np.maximum(wide, high), repeat)


def paint(view: LitStage, ids: NDArray[np.int32], points: Float, spread: Float) -> Float:
    """Look up texture colours ``[n,3]``, sRGB; ``spread`` is the size of a sample on the surface, world units."""
    uv, repeat = coordinates(view.shapes, ids, points)
    textures = np.array([s.material.texture for s in view.shapes.shapes])[ids]
    size = len(view.mips[0][0])
    levels = np.frexp(np.maximum(spread * repeat * size, 1) * 2**0.5)[1] - 1  # the nearest power of two
    levels = np.minimum(levels, len(view.mips[0]) - 1)
    group = textures * len(view.mips[0]) + levels
    order = np.argsort(group, kind="stable")
    out = np.empty((len(ids), 3), np.float32)
    starts = np.flatnonzero(np.diff(group[order], prepend=-1))
    for rows in np.split(order, starts[1:]):
        texture = view.mips[textures[rows[0]]][levels[rows[0]]]
        out[rows] = _lookup(texture, uv[rows])
    return out


def _lookup(texture: Picture, uv: Float) -> Float:
    """Sample a repeating texture bilinearly; y of the texture points down."""
    width = 4096  # cv2.remap takes at most 32767 columns
    size = len(texture)
    rows = -(-len(uv) // width)
    at = np.zeros((rows * width, 2), np.float32)
    at[: len(uv)] = (uv - np.floor(uv)) * size - 0.5
    x, y = at.reshape(rows, width, 2)[..., 0], at.reshape(rows, width, 2)[..., 1]
    colors = cv2.remap(texture, x.copy(), y.copy(), cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    return colors.reshape(-1, 3)[: len(uv)]


def radiance(view: LitStage, c2w: Array, lens: Pinhole, samples: int) -> Float:
    """Render the linear light ``[h,w,3]`` of a view."""
    hits = trace(view.shapes, c2w, lens, samples)
    h, w = hits.depth.shape
    out = np.zeros((h * w, 3), np.float32)
    ids = hits.ids.reshape(-1)
    seen = ids >= 0
    if seen.any():
        out[seen] = _reflect(view, ids[seen], hits, seen, c2w, lens, samples)
    return out.reshape(h, w, 3).reshape(lens.height, samples, lens.width, samples, 3).mean((1, 3))


def _reflect(
    view: LitStage, ids: NDArray[np.int32], hits: Hits, seen: Array, c2w: Array, lens: Pinhole, samples: int
) -> Float:
    """Compute the linear light ``[n,3]`` of the samples that hit a shape of the stage."""
    points, normals = hits.points.reshape(-1, 3)[seen], hits.normals.reshape(-1, 3)[seen]
    depth = hits.depth.reshape(-1)[seen]
    y, x = np.divmod(np.flatnonzero(seen), hits.depth.shape[1])
    rays = np.stack([(x + 0.5) / samples - lens.width / 2, (y + 0.5) / samples - lens.height / 2], 1) / lens.focal
    rays = rotate(np.concatenate([rays, np.ones((len(rays), 1))], 1), c2w[:3, :3])
    world = (c2w[:3, 3] + rays * depth[:, None]).astype(np.float32)
    rays = (rays / np.linalg.norm(rays, axis=1, keepdims=True)).astype(np.float32)
    cosine = np.maximum(-(normals * rays).sum(1), 0.1)
    spread = (depth / (lens.focal * samples)).astype(np.float32) / np.sqrt(cosine)
    albedo = power(paint(view, ids, points, spread), 2.2)
    return _shade(view, ids, albedo, world, normals, rays)


def _shade(view: LitStage, ids: NDArray[np.int32], albedo: Float, world: Float, normals: Float, rays: Float) -> Float:
    """Compute the linear light that points reflect or emit towards the camera."""
    light, shapes = view.stage.light, view.shapes.shapes
    direct, indirect = np.zeros((2, len(ids)), np.float32)
    bias = 2.0 * 2 * view.radius / KEY_SIZE
    even = np.full(KEY_MAPS, 1 / KEY_MAPS)
    add_light(world, normals, view.axes[:KEY_MAPS], view.middle, view.radius, view.key, bias, even, direct)
    bias = 1.2 * 2 * view.radius / AMBIENT_SIZE
    around = view.axes[KEY_MAPS:], view.middle, view.radius, view.ambient, bias, view.weights
    add_light(world, normals, *around, indirect)
    away = np.linalg.norm(world - light.lamp.astype(np.float32), axis=1)
    direct *= 2.5 / (1 + (away / norm(light.lamp - view.stage.focus)) ** 2 * 1.5)
    gloss = np.array([s.material.gloss for s in shapes], np.float32)[ids]
    half = light.towards.astype(np.float32) - rays
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    shine = gloss * direct * power(np.clip((normals * half).sum(1), 0, 1), 8 + 120 * gloss)
    grazing = (1 + (normals * rays).sum(1)).clip(0, 1)
    rim = 0.25 * gloss * (grazing * grazing) ** 2  # grazing views reflect more (Schlick 1994)
    key, ambient = light.key.astype(np.float32), light.ambient.astype(np.float32)
    out = albedo * (key * direct[:, None] + ambient * indirect[:, None])
    out += shine[:, None] * key + rim[:, None] * ambient
    glow = np.array([s.glow for s in shapes])[ids]
    out[glow] = albedo[glow] * GLOW * float(key.mean() + ambient.mean())
    return out


def find_exposure(pictures: Sequence[Float], brightness: float) -> float:
    """Find the exposure factor that makes the mean of the pictures about ``brightness``, sRGB."""
    values = np.concatenate([p.reshape(-1) for p in pictures])
    low, high = 1e-3, 1e3
    for _ in range(30):
        middle = (low * high) ** 0.5
        low, high = (middle, high) if develop(values * middle).mean() < brightness else (low, middle)
    return float((low * high) ** 0.5)


def develop(linear: Float) -> Float:
    """Convert linear light to sRGB in [0, 1]: a film curve (Narkowicz 2015), then gamma."""
    x = 0.6 * linear
    return power(np.clip(x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14), 0, 1), 1 / 2.2)
