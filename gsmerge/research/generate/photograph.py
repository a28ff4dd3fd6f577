"""Render photos and exact depth of a room.

A ray of each sample finds the first surface. The sample's colour comes from the surface's texture, and from lights with
shadow maps. A tone curve like that of film turns the light into the colours of a photo.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from gsmerge.frozen import dataclass
from gsmerge.method.kernels.cast import BLOB, BOX, CONE, ELLIPSOID, add_light, cast
from gsmerge.method.kernels.elementary import arctan2, cos, power, sin
from gsmerge.method.kernels.matrices import matmul
from gsmerge.research.generate.shapes import Array, Shape, ShapeArrays, half_sizes, norm, pack_shapes, rotate
from gsmerge.research.generate.textures import Texture, make_mipmaps

NO_SURFACE_DEPTH = 1e6  # depth of pixels without a surface, metres
SAMPLE_RAYS = 2  # rays per pixel and axis for colours; depth has one ray through the pixel's centre
# number of shadow maps of the direct light, for soft shadows, and their side in pixels
KEY_MAPS = 5
KEY_SIZE = 640
# number and side of the shadow maps of the light from all sides
AMBIENT_MAPS = 24
AMBIENT_SIZE = 256
GLOW = 0.7  # brightness of glowing shapes, relative to a white wall in full light
GRAZING_STRENGTH = 0.25  # strength of reflections at grazing angles, relative to the gloss

Float: TypeAlias = NDArray[Any]  # float32


@dataclass(frozen=True, eq=False)
class Light:
    """The lights of a room."""

    towards: Array  # [3] unit vector to the direct light
    lamp: Array  # [3] position of the lamp, near which surfaces are brighter
    key: Array  # [3] linear colour of the direct light
    ambient: Array  # [3] linear colour of the light from all sides
    softness: float  # half width of the direct light, radians


@dataclass(frozen=True, eq=False)
class Room:
    """Shapes, textures and lights of a room. The y axis points down, and cameras look along +z."""

    shapes: tuple[Shape, ...]
    textures: tuple[Texture, ...]  # indexed by the shapes' materials
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


@dataclass(frozen=True, eq=False)
class Hits:
    """What the h x w rays of a view hit first."""

    depth: Array  # [h,w] along the camera's z
    ids: NDArray[np.int32]  # [h,w] number of the shape; -1 if the ray hits none
    points: Float  # [h,w,3] hit in the shape's frame
    normals: Float  # [h,w,3] in the world, towards the camera


@dataclass(frozen=True, eq=False)
class LitRoom:
    """A room with shadow maps, ready to be rendered."""

    room: Room
    shapes: ShapeArrays
    mips: tuple[list[Texture], ...]  # mipmaps of every texture
    axes: Array  # [k,3,3] axes of all shadow maps, first those of the direct light
    middle: Array  # [3] world point in the middle of the shadow maps
    radius: float  # half side of the shadow maps, world units
    key: Float  # [KEY_MAPS,KEY_SIZE,KEY_SIZE] shadow maps of the direct light
    ambient: Float  # [AMBIENT_MAPS,AMBIENT_SIZE,AMBIENT_SIZE] shadow maps of the light from all sides
    weights: Array  # [AMBIENT_MAPS] weights of the ambient maps


def screen_boxes(shapes: ShapeArrays, c2w: Array, lens: Pinhole, samples: int) -> NDArray[np.int32]:
    """Compute boxes ``[m,4]`` of x0, y0, x1, y1: the samples in which the camera ``c2w`` may see each shape."""
    half = half_sizes(shapes)
    signs = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1], indexing="ij"), -1).reshape(-1, 3)
    corners = matmul(half[:, None] * signs, shapes.rotations.swapaxes(1, 2)) + shapes.centres[:, None]
    local = matmul(corners - c2w[:3, 3], c2w[:3, :3])
    # Edges that reach behind the camera are cut at the near plane. The numbers of two corners of an edge differ in one
    # bit
    edges = np.array([(i, i | bit) for bit in (1, 2, 4) for i in range(8) if not i & bit])
    a = local[:, edges[:, 0]]
    b = local[:, edges[:, 1]]
    near_plane = 1e-3  # metres
    with np.errstate(divide="ignore", invalid="ignore"):  # edges parallel to the plane are not used
        crossing = a + (b - a) * ((near_plane - a[..., 2:]) / (b[..., 2:] - a[..., 2:]))
    crosses = (a[..., 2] < near_plane) != (b[..., 2] < near_plane)
    # Points ``[m,20,3]`` in the camera's frame: the 8 corners, then the points where the 12 edges cross the near plane.
    # ``valid [m,20,1]`` is True for corners beyond the plane, and for edges that cross it
    points = np.concatenate([local, np.where(crosses[..., None], crossing, 0.0)], 1)
    valid = np.concatenate([local[..., 2] >= near_plane, crosses], 1)[..., None]
    pixels = points[..., :2] / np.where(valid, points[..., 2:], 1) * lens.focal + [lens.width / 2, lens.height / 2]
    limits = np.array([lens.width, lens.height]) * samples
    low = np.where(valid, np.floor(pixels * samples) - 1, np.inf).min(1)
    high = np.where(valid, np.ceil(pixels * samples) + 1, -np.inf).max(1)
    return np.concatenate([np.clip(low, 0, limits), np.clip(high, 0, limits)], 1).astype(np.int32)


def trace(shapes: ShapeArrays, c2w: Array, lens: Pinhole, samples: int) -> Hits:
    """Cast ``samples`` x ``samples`` rays for each pixel of the camera ``c2w [4,4]``, and return their first hits."""
    h = lens.height * samples
    w = lens.width * samples
    hits = Hits(np.full((h, w), NO_SURFACE_DEPTH), np.full((h, w), -1, np.int32), *np.zeros((2, h, w, 3), np.float32))
    intrinsics = np.array([lens.focal, lens.focal, lens.width / 2, lens.height / 2])
    c2w = np.ascontiguousarray(c2w, dtype=np.float64)
    eye = c2w[:3, 3].copy()
    axes = c2w[:3, :3].copy()
    table = shapes.kinds, shapes.rotations, shapes.centres, shapes.sizes, shapes.waves
    boxes = screen_boxes(shapes, c2w, lens, samples)
    # Fills the arrays of hits
    cast(eye, axes, intrinsics, 1.0 / samples, *table, boxes, hits.depth, hits.ids, hits.points, hits.normals)
    return hits


def _shadow_map(shapes: ShapeArrays, axes: Array, middle: Array, radius: float, size: int) -> Float:
    """Compute the shadow map ``[size,size]`` along ``axes [3,3]``, of all within ``radius`` of ``middle``.

    A pixel says by how much the first surface is deeper than ``middle``.
    """
    c2w = np.eye(4)
    behind = 1000.0  # distance of a shadow map's camera in radii, so that its rays are nearly parallel
    c2w[:3, :3], c2w[:3, 3] = axes.T, middle - behind * radius * axes[2]
    hits = trace(shapes, c2w, Pinhole(size, size, behind * size / 2), 1)
    return (hits.depth - behind * radius).astype(np.float32)


def light_room(room: Room) -> LitRoom:
    """Prepare a room for rendering: make the arrays of its shapes, the mipmaps, and the shadow maps."""
    # Walls and glowing shapes cast no shadow; the arrays need one shape at least
    opaque = pack_shapes([s for s in room.shapes if not s.shell and not s.glow] or room.shapes[:1])
    radii = np.linalg.norm(half_sizes(opaque), axis=1)[:, None]
    low = (opaque.centres - radii).min(0)
    high = (opaque.centres + radii).max(0)
    middle = (low + high) / 2
    radius = norm(high - low) / 2
    rng = np.random.default_rng(0)
    key = [room.light.towards + room.light.softness * rng.normal(0, 0.6, 3) for _ in range(KEY_MAPS)]
    # The directions ``[AMBIENT_MAPS,3]`` of the ambient light, evenly over the sphere (Fibonacci's spiral)
    steps = np.arange(AMBIENT_MAPS) + 0.5
    up = 1 - 2 * steps / AMBIENT_MAPS
    azimuth = np.pi * (1 + 5**0.5) * steps
    horizontal = np.sqrt(1 - up**2)
    ambient = np.stack([horizontal * cos(azimuth), -up, horizontal * sin(azimuth)], 1)
    all_axes = []  # axes of each shadow map as rows right, down, forward ``[3,3]``
    for towards in (*key, *ambient):
        forward = -towards / norm(towards)
        right = np.cross([0.3, 1.0, 0.2], forward)
        right /= norm(right)
        all_axes.append(np.stack([right, np.cross(forward, right), forward]))
    axes = np.stack(all_axes)
    from_below = 0.5  # brightness of light from below, relative to light from above
    return LitRoom(
        room, shapes=pack_shapes(room.shapes), mips=tuple(make_mipmaps(texture) for texture in room.textures),
        axes=axes, middle=middle, radius=radius,
        key=np.stack([_shadow_map(opaque, a, middle, radius, KEY_SIZE) for a in axes[:KEY_MAPS]]),
        ambient=np.stack([_shadow_map(opaque, a, middle, radius, AMBIENT_SIZE) for a in axes[KEY_MAPS:]]),
        weights=np.where(-ambient[:, 1] > 0, 1.0, from_below) * 4 / AMBIENT_MAPS,
    )  # fmt: skip


def texture_coordinates(shapes: ShapeArrays, ids: NDArray[np.int32], points: Float) -> tuple[Float, Float]:
    """Compute texture coordinates ``[n,2]`` of points in shape frames, and texture repeats per world unit ``[n]``.

    Round surfaces are unrolled about their y axis. Flat faces are projected along their axis.
    """
    kinds = shapes.kinds[ids]
    half = shapes.sizes[ids, :3].astype(np.float32)
    x, y, z = points.T
    share_x, share_y, share_z = (np.abs(points) / np.maximum(half, 1e-9)).T  # 1 on a face across this axis
    is_round = (kinds == ELLIPSOID) | (kinds == BLOB) | ((kinds == CONE) & (share_y < 1 - 1e-5))
    radius = np.maximum(half[:, 0], half[:, 2])
    is_side = (kinds == BOX) & (share_x >= share_y) & (share_x >= share_z)  # faces across x
    is_top = ((kinds == BOX) & (share_y > share_x) & (share_y >= share_z)) | ((kinds == CONE) & ~is_round)  # across y
    azimuth = arctan2(x, z)
    u = np.where(is_round, azimuth * radius, np.where(is_side, z, x))
    v = np.where(is_top, z, y)
    half_width = np.where(is_round, np.pi * radius, np.where(is_side, half[:, 2], half[:, 0]))
    half_height = np.where(is_top, half[:, 2], half[:, 1])
    materials = [s.material for s in shapes.shapes]
    repeat = np.array([material.repeat for material in materials], np.float32)[ids]
    shift = np.array([material.shift for material in materials], np.float32)[ids]
    once = repeat == 0
    u = np.where(once, u / (2 * half_width) + 0.5, u * repeat + shift[:, 0])
    v = np.where(once, v / (2 * half_height) + 0.5, v * repeat + shift[:, 1])
    return np.stack([u, v], 1).astype(np.float32), np.where(once, 0.5 / np.maximum(half_width, half_height), repeat)


def look_up_colors(lit: LitRoom, ids: NDArray[np.int32], points: Float, spread: Float) -> Float:
    """Look up the texture colours ``[n,3]``, sRGB, of points in the frames of the shapes ``ids [n]``.

    ``spread [n]`` is the size of a sample at the point, in world units. This size chooses the mipmap.
    """
    uv, repeat = texture_coordinates(lit.shapes, ids, points)
    textures = np.array([s.material.texture for s in lit.shapes.shapes])[ids]
    size = len(lit.mips[0][0])
    num_levels = len(lit.mips[0])
    powers = np.frexp(np.maximum(spread * repeat * size, 1) * 2**0.5)[1] - 1  # nearest powers of two, in texels
    levels = np.minimum(powers, num_levels - 1)
    mip_ids = textures * num_levels + levels
    order = np.argsort(mip_ids, kind="stable")
    out = np.empty((len(ids), 3), np.float32)
    remap_width = 4096  # columns of a table for cv2.remap, which takes at most 32767
    starts = np.flatnonzero(np.diff(mip_ids[order], prepend=-1))
    for rows in np.split(order, starts[1:]):  # the samples of one mipmap
        texture = lit.mips[textures[rows[0]]][levels[rows[0]]]
        # The texture repeats, is sampled bilinearly, and has a v axis that points down
        num_rows = -(-len(rows) // remap_width)
        texels = np.zeros((num_rows * remap_width, 2), np.float32)
        texels[: len(rows)] = (uv[rows] - np.floor(uv[rows])) * len(texture) - 0.5
        x, y = np.moveaxis(texels.reshape(num_rows, remap_width, 2), 2, 0)
        colors = cv2.remap(texture, x.copy(), y.copy(), cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
        out[rows] = colors.reshape(-1, 3)[: len(rows)]
    return out


def render_light(lit: LitRoom, c2w: Array, lens: Pinhole, samples: int) -> Float:
    """Render the linear light ``[h,w,3]`` of a view's pixels: means of ``samples`` x ``samples`` rays each."""
    hits = trace(lit.shapes, c2w, lens, samples)
    h, w = hits.depth.shape
    out = np.zeros((h * w, 3), np.float32)
    rows = np.flatnonzero(hits.ids.reshape(-1) >= 0)
    if len(rows):
        out[rows] = _reflect(lit, hits, rows=rows, c2w=c2w, lens=lens, samples=samples)
    return out.reshape(h, w, 3).reshape(lens.height, samples, lens.width, samples, 3).mean((1, 3))


def _reflect(lit: LitRoom, hits: Hits, rows: NDArray[np.int64], c2w: Array, lens: Pinhole, samples: int) -> Float:
    """Compute the linear light ``[n,3]`` of the samples ``rows [n]``, which hit a shape of the room."""
    points = hits.points.reshape(-1, 3)[rows]
    normals = hits.normals.reshape(-1, 3)[rows]
    ids = hits.ids.reshape(-1)[rows]
    depth = hits.depth.reshape(-1)[rows]
    y, x = np.divmod(rows, hits.depth.shape[1])
    slopes = np.stack([(x + 0.5) / samples - lens.width / 2, (y + 0.5) / samples - lens.height / 2], 1) / lens.focal
    rays = rotate(np.concatenate([slopes, np.ones((len(slopes), 1))], 1), c2w[:3, :3])  # with the depth 1
    positions = (c2w[:3, 3] + rays * depth[:, None]).astype(np.float32)
    directions = (rays / np.linalg.norm(rays, axis=1, keepdims=True)).astype(np.float32)
    min_cosine = 0.1  # at smaller cosines, that is at grazing angles, a sample would cover too much of a surface
    cosine = np.maximum(-(normals * directions).sum(1), min_cosine)
    spread = (depth / (lens.focal * samples)).astype(np.float32) / np.sqrt(cosine)
    gamma = 2.2  # exponent from sRGB to linear light
    albedo = power(look_up_colors(lit, ids, points, spread), gamma)
    return _shade(lit, ids, albedo=albedo, positions=positions, normals=normals, rays=directions)


def _shade(lit: LitRoom, ids: NDArray[np.int32], albedo: Float, positions: Float, normals: Float, rays: Float) -> Float:
    """Compute the linear light ``[n,3]`` that points of shapes ``ids [n]`` reflect or emit towards the camera.

    ``rays`` are unit vectors from the camera to the points.
    """
    light = lit.room.light
    shapes = lit.shapes.shapes
    half_side = lit.radius
    # The direct and the ambient light ``[n]`` that arrives at the points, with shadows
    direct, indirect = np.zeros((2, len(positions)), np.float32)
    # texels by which a lit surface may lie behind the shadow map's depth
    key_texels = 2.0
    ambient_texels = 1.2
    key_bias = key_texels * 2 * half_side / KEY_SIZE
    ambient_bias = ambient_texels * 2 * half_side / AMBIENT_SIZE
    key_axes = lit.axes[:KEY_MAPS]
    ambient_axes = lit.axes[KEY_MAPS:]
    equal = np.full(KEY_MAPS, 1 / KEY_MAPS)
    # Each call adds to its last argument
    add_light(positions, normals, key_axes, lit.middle, half_side, lit.key, key_bias, equal, direct)
    add_light(positions, normals, ambient_axes, lit.middle, half_side, lit.ambient, ambient_bias, lit.weights, indirect)
    lamp_distance = np.linalg.norm(positions - light.lamp.astype(np.float32), axis=1)
    # brightness of the direct light at the lamp, and its decrease with the distance
    lamp_gain = 2.5
    lamp_falloff = 1.5
    direct *= lamp_gain / (1 + (lamp_distance / norm(light.lamp - lit.room.focus)) ** 2 * lamp_falloff)
    gloss = np.array([s.material.gloss for s in shapes], np.float32)[ids]
    halfway = light.towards.astype(np.float32) - rays  # between light and camera (Blinn 1977)
    halfway /= np.linalg.norm(halfway, axis=1, keepdims=True)
    shine = gloss * direct * power(np.clip((normals * halfway).sum(1), 0, 1), 8 + 120 * gloss)
    grazing = (1 + (normals * rays).sum(1)).clip(0, 1)
    rim = GRAZING_STRENGTH * gloss * (grazing * grazing) ** 2  # grazing views reflect more (Schlick 1994)
    key = light.key.astype(np.float32)
    ambient = light.ambient.astype(np.float32)
    out = albedo * (key * direct[:, None] + ambient * indirect[:, None])
    out += shine[:, None] * key + rim[:, None] * ambient
    glow = np.array([s.glow for s in shapes])[ids]
    out[glow] = albedo[glow] * GLOW * float(key.mean() + ambient.mean())
    return out


def find_exposure(pictures: Sequence[Float], brightness: float) -> float:
    """Find the exposure factor at which tone-mapped pictures have the mean ``brightness``, sRGB, by bisection."""
    values = np.concatenate([picture.reshape(-1) for picture in pictures])
    low = 1e-3
    high = 1e3
    for _ in range(30):
        middle = (low * high) ** 0.5
        low, high = (middle, high) if tone_map(values * middle).mean() < brightness else (low, middle)
    return float((low * high) ** 0.5)


def tone_map(linear: Float) -> Float:
    """Convert linear light to sRGB in [0, 1] with the curve of a film (Narkowicz 2015) and a gamma."""
    x = 0.6 * linear
    return power(np.clip(x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14), 0, 1), 1 / 2.2)
