"""Simulate the output of a feed-forward network for a view: depth, confidence, and one Gaussian for each pixel."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeAlias

import cv2
import numpy as np

from gsmerge.frozen import dataclass, fields, make_dataclass
from gsmerge.method.kernels.elementary import exp, log
from gsmerge.method.kernels.pictures import blur, convolve
from gsmerge.method.kernels.raster.project import view_colors
from gsmerge.research.generate.photograph import Float, Pinhole
from gsmerge.research.generate.shapes import Array, rotate
from gsmerge.research.generate.textures import enlarge_texture
from gsmerge.types import SH_C0, Gaussians

Range = tuple[float, float]
ERRORS = (  # ranges that the setting ``noise`` scales; the other ranges are habits of the exporter
    *("view_bias", "drift", "patches", "patch_error", "grain", "bleed", "floaters", "turn", "shift"),
    *("exposure", "tint", "oversized", "tilt"),
)
LOG_UNIFORM = ("view_bias", "drift", "grain", "turn", "shift", "unit")  # values whose logarithms are drawn uniformly


@dataclass(frozen=True)
class NoiseOptions:
    """Ranges from which each scene's values are drawn: sizes of a network's errors, and habits of its exporter.

    Depth errors are standard deviations of the logarithm of depth. These standard deviations are about equal to
    relative errors of depth. docs/internals/networks.md lists the ranges.
    """

    view_bias: Range = (0.0002, 0.02)  # scale error of a view
    drift: Range = (0.0003, 0.02)  # slow error across a view
    patches: Range = (0.0, 0.3)  # share of a view's area in patches of wrong depth
    patch_error: Range = (0.02, 0.5)  # depth error in these patches
    grain: Range = (0.0007, 0.003)  # independent depth error of each pixel
    blank: Range = (0.0, 3.0)  # factor of additional errors where the photo has no texture
    bleed: Range = (0.1, 1.0)  # blend towards a smoothed inverse depth at edges, 0 to 1
    bleed_width: Range = (0.6, 1.8)  # standard deviation of the smoothing of inverse depth, pixels
    far: Range = (4.0, 12.0)  # largest depth that the network predicts, in medians of the depth
    # Share of the pixels whose Gaussian floats in front of the surface. At depth edges the share is 11 times as large
    # as elsewhere
    floaters: Range = (0.0, 0.004)
    turn: Range = (0.005, 0.3)  # rotation error of a pose, degrees
    shift: Range = (0.0001, 0.004)  # translation error of a pose, in median depths
    exposure: Range = (0.0, 0.12)  # standard deviation of the logarithm of a photo's brightness
    tint: Range = (0.0, 0.03)  # standard deviation of the logarithm of each colour channel's brightness
    blur: Range = (0.3, 0.75)  # standard deviation of the lens's blur, pixels
    offset: Range = (0.0, 0.3)  # largest distance of a mean from its pixel's centre, pixels
    scale: Range = (0.5, 1.5)  # scale of a Gaussian across its normal, in footprints of its pixel
    scale_jitter: Range = (0.05, 0.35)  # standard deviation of the scales' logarithms
    flatness: Range = (0.15, 1.0)  # thickness along the normal, relative to the other axes
    tilt: Range = (0.02, 0.4)  # error of the normals, radians
    oversized: Range = (0.0, 0.006)  # share of the Gaussians that are far too large
    oversize: Range = (3.0, 12.0)  # largest factor on the size of these Gaussians; the least factor is 2
    trust: Range = (0.25, 1.0)  # confidence of pixels without errors
    constant_opacity: float = 0.2  # probability that all opacities are equal
    opacity_low: Range = (0.05, 0.4)  # opacity at a confidence of 0
    opacity_high: Range = (0.75, 0.99)  # opacity at a confidence of 1
    opacity_grain: Range = (0.0, 0.08)  # independent error of each opacity
    color_grain: Range = (0.0, 0.02)  # error of each colour
    color_blur: Range = (0.0, 0.6)  # standard deviation of the smoothing of colours, pixels; below 0.2: none
    sh_degrees: tuple[int, ...] = (0, 0, 0, 1, 2)  # degrees of the spherical harmonics, drawn with equal probability
    harmonics: Range = (0.0, 0.06)  # standard deviation of the higher coefficients
    unit: Range = (0.2, 5.0)  # world units per metre


NOISE_RANGES = [f.name for f in fields(NoiseOptions) if f.name not in ("constant_opacity", "sh_degrees")]
if TYPE_CHECKING:
    Noise: TypeAlias = Any
else:  # the values that were drawn for one scene, under the names of their ranges
    Noise = make_dataclass("Noise", [*NOISE_RANGES, "sh_degree"], frozen=True)


def draw_noise(options: NoiseOptions, rng: np.random.Generator, factor: float = 1.0) -> Noise:
    """Draw the values of one scene from their ranges.

    ``factor`` multiplies the values of ``ERRORS``. Shares of pixels and ``bleed`` are then cut to 1.
    """
    drawn: dict[str, float] = {}
    for name in NOISE_RANGES:
        low, high = getattr(options, name)
        is_log = name in LOG_UNIFORM
        drawn[name] = float(exp(rng.uniform(log(low), log(high)))) if is_log else rng.uniform(low, high)
    for name in ERRORS:
        drawn[name] *= factor
    for name in ("bleed", "patches", "floaters", "oversized"):
        drawn[name] = min(drawn[name], 1.0)
    degree = int(options.sh_degrees[rng.integers(len(options.sh_degrees))])
    if rng.random() < options.constant_opacity:
        drawn["opacity_low"] = drawn["opacity_high"]
        drawn["opacity_grain"] = 0.0
    return Noise(**drawn, sh_degree=degree)


@dataclass(frozen=True, eq=False)
class TrueView:
    """A view with its photo, exact depth and normals, and the pose that a network would estimate."""

    image: Float  # [h,w,3] sRGB
    depth: Array  # [h,w] along z
    normals: Float  # [h,w,3] world
    c2w: Array  # [4,4] camera to world, as estimated


def smooth_noise(rng: np.random.Generator, height: int, width: int, cells: int) -> Float:
    """Draw smooth noise ``[height,width]`` of standard deviation 1, with ``cells`` cells along the longer side."""
    side = max(height, width)
    field = enlarge_texture(rng.normal(0, 1, (cells, cells)), side)[:height, :width]
    return field / max(float(field.std(dtype=np.float64)), 1e-3)


def edge_mask(depth: Array) -> Float:
    """Rate pixels ``[h,w]`` by depth edges, from 0 on smooth surfaces (also if slanted) to 1 at clear edges."""
    inverse = (1 / depth).astype(np.float32)
    square = np.ones((3, 3), np.uint8)
    step = log(cv2.dilate(inverse, square) / cv2.erode(inverse, square))
    blurred = blur(inverse, 1.0)  # blur does not change the inverse depth of a slanted plane
    bend = np.abs(blurred / inverse - 1)
    return np.clip((np.minimum(step / 2, 4 * bend) - 0.01) / 0.09, 0, 1).astype(np.float32)


MEAN_FILTER = np.full(7, 1 / 7, np.float32)  # filter that averages 7 pixels


def texture_mask(image: Float) -> Float:
    """Rate pixels ``[h,w]`` by texture, from 0 in flat areas of a photo to 1 in detailed areas."""
    grey = image.mean(2)
    mean, mean_square = (convolve(values, MEAN_FILTER, MEAN_FILTER) for values in (grey, grey * grey))
    deviation = np.sqrt(np.maximum(mean_square - mean * mean, 0))
    min_deviation = 0.05  # standard deviation of grey values, from which an area counts as detailed
    return np.clip(deviation / min_deviation, 0, 1)


def predict_depth(view: TrueView, noise: Noise, rng: np.random.Generator) -> tuple[Float, Float]:
    """Simulate a network's depth ``[h,w]`` and its confidence ``[h,w]`` in [0, 1].

    Errors of the logarithm of depth are a bias of the view, a slow drift, wrong patches and fine grain. All these
    errors are larger in areas without texture. Besides, edges are smoothed in inverse depth, depth is cut at a largest
    value, and some pixels float in front of their surface.
    """
    height, width = view.depth.shape
    far = noise.far * float(np.median(view.depth))
    depth = np.minimum(view.depth, far)
    is_beyond = view.depth > far
    blank = 1 - texture_mask(view.image)
    edge = edge_mask(depth)
    near_edge = cv2.dilate(edge, np.ones((3, 3), np.uint8))
    smooth = blur(1 / depth, noise.bleed_width)
    bled = 1 / (1 / depth + noise.bleed * near_edge * (smooth - 1 / depth))
    amplification = 1 + noise.blank * blank + 3 * is_beyond
    drift = noise.drift * smooth_noise(rng, height, width, int(rng.integers(3, 7)))
    # Patches of wrong depth, 0 to 1, are more likely where the photo is blank
    field = smooth_noise(rng, height, width, int(rng.integers(5, 12))) + noise.blank * blank
    limit = np.float32(np.quantile(field.astype(np.float64), 1 - noise.patches))
    patch = np.clip((field - limit) / 0.3, 0, 1) if noise.patches > 0 else np.zeros_like(field)
    patch_error = patch * noise.patch_error * smooth_noise(rng, height, width, 8)
    grain = noise.grain * rng.normal(0, 1, depth.shape)
    predicted = bled * exp(noise.view_bias * rng.normal() + amplification * (drift + grain) + patch_error)
    floats = rng.random(depth.shape) < noise.floaters * (1 + 10 * edge)
    predicted = np.where(floats, predicted * rng.uniform(0.4, 0.95, depth.shape), predicted)
    doubt = 0.8 * near_edge + 0.5 * blank * noise.blank / 3 + 0.7 * patch * rng.uniform(0, 1) + 0.6 * is_beyond
    trust = noise.trust * np.clip(1 - doubt, 0, 1) + 0.06 * smooth_noise(rng, height, width, 9)
    return predicted.astype(np.float32), np.clip(np.where(floats, 0.5 * trust, trust), 0, 1).astype(np.float32)


RAISED = 10.0  # base colour at which the effect of shN is measured, so high that no colour is clamped at 0


def quats_facing(normals: Array) -> Array:
    """Return quats ``[n,4]`` wxyz of the shortest rotations of +z onto normals or their opposites."""
    z = normals * np.where(normals[:, 2:] < 0, -1, 1)
    quats = np.stack([1 + z[:, 2], -z[:, 1], z[:, 0], np.zeros(len(z))], 1)
    return quats / np.linalg.norm(quats, axis=1, keepdims=True)


def pixel_gaussians(view: TrueView, lens: Pinhole, noise: Noise, rng: np.random.Generator) -> Gaussians:
    """Make one Gaussian for each pixel of a view, in row-major order."""
    height, width = view.depth.shape
    n = height * width
    depth, confidence = (values.reshape(-1).astype(np.float64) for values in predict_depth(view, noise, rng))
    v, u = np.mgrid[:height, :width].reshape(2, -1) + 0.5 + rng.uniform(-noise.offset, noise.offset, (2, n))
    rays = np.stack([(u - width / 2) / lens.focal, (v - height / 2) / lens.focal, np.ones(n)], 1)
    means = (rotate(rays * depth[:, None], view.c2w[:3, :3]) + view.c2w[:3, 3]).astype(np.float32)
    normals = view.normals.reshape(-1, 3) + rng.normal(0, noise.tilt, (n, 3))
    normals = np.where(np.linalg.norm(normals, axis=1, keepdims=True) < 1e-6, rays, normals)
    quats = quats_facing(normals / np.linalg.norm(normals, axis=1, keepdims=True))
    shape = np.array([1.0, 1.0, noise.flatness]) * exp(rng.normal(0, noise.scale_jitter, (n, 3)))
    scales = noise.scale * (depth / lens.focal)[:, None] * shape
    is_oversized = rng.random(n) < noise.oversized
    scales[is_oversized] *= rng.uniform(2, max(2.0, noise.oversize), (int(is_oversized.sum()), 1))
    opacities = noise.opacity_low + (noise.opacity_high - noise.opacity_low) * confidence
    opacities = np.clip(opacities + rng.normal(0, noise.opacity_grain, n), 0.01, 0.995)
    min_blur = 0.2  # least standard deviation of the smoothing of colours, pixels; smaller values change nothing
    image = blur(view.image, noise.color_blur) if noise.color_blur > min_blur else view.image
    colors = np.clip(image.reshape(-1, 3) + rng.normal(0, noise.color_grain, (n, 3)), 0, 1).astype(np.float32)
    # Higher harmonics are random. Their effect is rendered at the colour RAISED, and subtracted from sh0, so that
    # Gaussians have the colours of the picture seen from its camera
    sh0 = ((colors - 0.5) / SH_C0)[:, None].astype(np.float32)
    num_rest = (noise.sh_degree + 1) ** 2 - 1
    common = rng.normal(0, 1, (1, num_rest, 3))  # equal for all Gaussians, since highlights of a view are on one side
    shN = (noise.harmonics * (0.7 * common + 0.7 * rng.normal(0, 1, (n, num_rest, 3)))).astype(np.float32)
    if num_rest:
        raised = np.full_like(sh0, RAISED / SH_C0)
        eye = view.c2w[:3, 3].astype(np.float32)
        rendered = np.empty((n, 3), np.float32)
        view_colors(means, raised, shN, np.arange(n, dtype=np.int32), eye, 0, n, rendered)
        sh0 -= ((rendered - (RAISED + 0.5)) / SH_C0)[:, None]
    columns = (means, quats, scales, opacities, sh0, shN)
    return Gaussians(*(np.ascontiguousarray(column, dtype=np.float32) for column in columns))
