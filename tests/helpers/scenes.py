"""Tiny synthetic scenes are made in memory, and checks say what must hold of every compact scene.

The maker is the product's own (:mod:`gsmerge.research.generate`): its rays, and its Gaussians with the errors set to
zero. Surfaces here have colours that are functions of the place alone, so photos are exact, and every pixel gets one
Gaussian on the surface that it sees, the size of its footprint, flat along the surface's normal.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cache
from typing import Any

import numpy as np
from floors import nudged

from gsmerge import Cameras, Gaussians, Scene, compact, render
from gsmerge.method.fit import FitJob, FitOptions
from gsmerge.method.fit.schedule import FitRun, prepare_fit
from gsmerge.method.geometry.transforms import covariances, normalize, quat_to_rotmat, rotmat_to_quat
from gsmerge.method.geometry.views import subset, take_rows
from gsmerge.method.kernels import elementary
from gsmerge.method.kernels.matrices import invert, matmul
from gsmerge.method.raster.photos import Photos, scene_photos
from gsmerge.research.generate import objects, photograph, shapes
from gsmerge.research.generate.noise import Noise, TrueView, pixel_gaussians
from gsmerge.research.generate.synthetic_scene import look_at as camera_to_world
from gsmerge.results.report import CompactReport
from gsmerge.results.result import CompactResult
from gsmerge.types import SH_C0, FeatureGaussians, Pixels

Texture = Callable[[np.ndarray], np.ndarray]
FIELDS = ("means", "quats", "scales", "opacities", "sh0", "shN")
WIDE = 1e7  # half the width of a plane without ends
NO_ERRORS = Noise(**{**dict.fromkeys((f.name for f in fields(Noise)), 0.0), "sh_degree": 0})  # type: ignore[arg-type]
UNPAINTED = shapes.Material(0)


@dataclass(frozen=True)
class Surface:
    """A shape of the generator's; ``texture(points [n,3])`` gives the colours ``[n,3]`` of world positions."""

    shape: shapes.Shape
    texture: Texture


def waves(seed: int = 0, rate: float = 6.0) -> Texture:
    """Return a smooth, colourful texture of world positions that does not repeat."""
    rng = np.random.default_rng(seed)
    turns, phases = rng.normal(size=(3, 4, 3)) * rate, rng.uniform(0, 6.28, (3, 4))

    def texture(points: np.ndarray) -> np.ndarray:
        swings = elementary.sin(matmul(points, turns.reshape(-1, 3).T).reshape(-1, 3, 4) + phases).sum(-1)
        return 0.5 + 0.11 * swings

    return texture


def flat(*rgb: float) -> Texture:
    """Return one colour."""
    return lambda points: np.broadcast_to(np.array(rgb), points.shape)


def plane(depth: float, texture: Texture, *, left: float = -WIDE, right: float = WIDE) -> Surface:
    """Return the plane z = depth between two x."""
    return Surface(shapes.quad(((left + right) / 2, 0, depth), ((right - left) / 2, WIDE), UNPAINTED), texture)


def ball(centre: Sequence[float], radius: float, texture: Texture) -> Surface:
    """Return a sphere."""
    return Surface(shapes.ball(centre, (radius, radius, radius), UNPAINTED), texture)


def wall(seed: int = 0) -> list[Surface]:
    """Return a textured wall."""
    return [plane(3.0, waves(seed))]


def two_planes() -> list[Surface]:
    """Return two planes, of which the one in half of the view is nearer."""
    return [plane(2.2, waves(1), right=0.0), plane(3.2, waves(2))]


def pole(width: float = 0.13) -> list[Surface]:
    """Return a thin white pole in front of a darker textured wall."""
    dim = waves(3)
    return [
        plane(2.0, flat(0.95, 0.95, 0.9), left=-width / 2, right=width / 2),
        plane(3.0, lambda points: 0.5 * dim(points)),
    ]


def room() -> list[Surface]:
    """Return a ball in front of a wall."""
    return [ball((0.2, 0.1, 2.6), 0.5, waves(5, 8.0)), plane(3.4, waves(4))]


def arc(num_views: int, width: int = 48, height: int = 36, *, span: float = 0.8, start: float = -0.5) -> Cameras:
    """Return cameras side by side over ``span`` of x, looking at (0, 0, 3)."""
    viewmats = []
    for view in range(num_views):
        x = span * (start + (view / (num_views - 1) if num_views > 1 else 0.5))
        viewmats.append(look_at(np.array([x, 0.15 * x, 0.0]), np.array([0.0, 0.0, 3.0])))
    return Cameras(np.stack(viewmats), intrinsics(num_views, width, height), width, height)


def look_at(eye: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return world to camera, OpenCV axes, y down."""
    return invert(camera_to_world(eye, target))


def intrinsics(num_views: int, width: int, height: int) -> np.ndarray:
    """Return a lens whose focal length is the image's width."""
    return np.stack([photograph.Pinhole(width, height, width).intrinsics] * num_views)


def views_of(
    surfaces: Sequence[Surface], cameras: Cameras
) -> tuple[photograph.Pinhole, list[tuple[np.ndarray, photograph.Hits, np.ndarray]]]:
    """Return the lens; for every view its camera to world, what its rays meet, and the colours ``[h,w,3]`` of that."""
    lens = photograph.Pinhole(cameras.width, cameras.height, float(cameras.Ks[0, 0, 0]))
    assert np.allclose(cameras.Ks, lens.intrinsics)
    packed, actual = shapes.pack_shapes([surface.shape for surface in surfaces]), []
    for viewmat in cameras.viewmats.astype(np.float64):
        c2w = invert(viewmat)
        hits = photograph.trace(packed, c2w, lens, 1)
        assert (hits.ids >= 0).all(), "every ray must meet a surface"
        places = world_points(hits.depth, c2w, lens)
        shades = np.stack([surface.texture(places.reshape(-1, 3)) for surface in surfaces])
        colors = shades[hits.ids.ravel(), np.arange(hits.ids.size)].reshape(places.shape)
        actual.append((c2w, hits, np.clip(colors, 0, 1)))
    return lens, actual


def world_points(depth: np.ndarray, c2w: np.ndarray, lens: photograph.Pinhole) -> np.ndarray:
    """Return world positions ``[h,w,3]`` of pixels' centres at depths ``[h,w]``."""
    y, x = np.mgrid[: lens.height, : lens.width] + 0.5
    rays = matmul(np.stack([x, y, np.ones_like(x)], -1), invert(lens.intrinsics).T)  # of unit depth
    return c2w[:3, 3] + matmul(depth[..., None] * rays, c2w[:3, :3].T)


def trace(surfaces: Sequence[Surface], cameras: Cameras) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return world positions ``[v,hw,3]``, depths ``[v,hw]`` and colours ``[v,hw,3]`` of every pixel's centre."""
    lens, actual = views_of(surfaces, cameras)
    points = np.stack([world_points(hits.depth, c2w, lens).reshape(-1, 3) for c2w, hits, _ in actual])
    return points, np.stack([h.depth.ravel() for _, h, _ in actual]), np.stack([c.reshape(-1, 3) for *_, c in actual])


def make_scene(
    surfaces: Sequence[Surface],
    cameras: Cameras,
    *,
    seed: int = 0,
    noise: float = 0.0,
    opacity: tuple[float, float] = (0.6, 0.95),
    degree: int = 0,
    photos: bool = True,
) -> Scene:
    """Make a scene with one Gaussian per pixel on the surfaces.

    Args:
        surfaces: What is seen.
        cameras: The views.
        seed: Of opacities, depth noise and higher harmonics.
        noise: Standard deviation of the depth, as a share of it.
        opacity: Most opacities lie between these two, less at edges.
        degree: Of the spherical harmonics; those above degree 0 are small and random.
        photos: With the exact images.
    """
    errors = replace(
        NO_ERRORS, grain=noise, far=1e9, bleed_width=1.0, trust=0.5, opacity_low=opacity[0], opacity_high=opacity[1],
        opacity_grain=(opacity[1] - opacity[0]) / 4, scale=0.6, scale_jitter=0.06, flatness=0.3,
        sh_degree=degree, harmonics=0.05,
    )  # fmt: skip
    rng = np.random.default_rng(seed)
    lens, actual = views_of(surfaces, cameras)
    images = [colors.astype(np.float32) for *_, colors in actual]
    parts = [
        pixel_gaussians(TrueView(image, hits.depth, hits.normals, c2w), lens, errors, rng)
        for image, (c2w, hits, _) in zip(images, actual, strict=True)
    ]
    gaussians = Gaussians.concat(parts)
    means = gaussians.means.astype(np.float64)
    if not noise:  # exactly on the surfaces, so that what is equal is so in float64
        means = np.concatenate([world_points(h.depth, c2w, lens).reshape(-1, 3) for c2w, h, _ in actual])
    gaussians = nudged(replace(gaussians, means=means))
    pixels = Pixels.of_grid(np.ones((len(cameras), cameras.height, cameras.width), bool))
    return Scene(gaussians, cameras, np.stack(images) if photos else None, pixels, names(len(cameras)))


def shown_in(scene: Scene, mask: np.ndarray) -> Scene:
    """Return the scene with only the Gaussians of the pixels ``mask [v,h,w]``."""
    return take_rows(scene, np.flatnonzero(mask.reshape(-1)[scene.pixels.homes]))


def names(count: int) -> tuple[str, ...]:
    """Return names of views."""
    return tuple(f"{view:03d}.png" for view in range(count))


def take_views(scene: Scene, order: Sequence[int]) -> Scene:
    """Return the scene's views in another order, repeated or left out."""
    taken = subset(scene, order)
    return replace(taken, names=names(len(order)))


def move_gaussians(gaussians: Gaussians, rotation: np.ndarray, factor: float, shift: np.ndarray) -> Gaussians:
    """Move Gaussians by x -> factor · rotation x + shift, in float64; higher harmonics must be zero."""
    turns = matmul(rotation, quat_to_rotmat(gaussians.quats.astype(np.float64)))
    return replace(
        gaussians,
        means=factor * matmul(gaussians.means.astype(np.float64), rotation.T) + shift,
        quats=rotmat_to_quat(turns).astype(np.float32),
        scales=gaussians.scales * float(factor),
    )


def move(scene: Scene, rotation: np.ndarray, factor: float, shift: np.ndarray) -> Scene:
    """Move the scene with its cameras in the same way."""
    viewmats = scene.cameras.viewmats.copy()
    viewmats[:, :3, :3] = matmul(viewmats[:, :3, :3], rotation.T)
    viewmats[:, :3, 3] = factor * viewmats[:, :3, 3] - matmul(viewmats[:, :3, :3], shift)
    gaussians = move_gaussians(scene.gaussians, rotation, factor, shift)
    return replace(scene, gaussians=gaussians, cameras=replace(scene.cameras, viewmats=viewmats))


def random_rotation(seed: int) -> np.ndarray:
    """Draw a rotation ``[3,3]``."""
    return objects.random_rotation(np.random.default_rng(seed))


def images_of(gaussians: Gaussians, cameras: Cameras) -> tuple[np.ndarray, np.ndarray]:
    """Return images ``[c,h,w,3]`` and alphas ``[c,h,w]`` over black, float64."""
    drawn = render(gaussians, cameras)
    return drawn.images.astype(np.float64), drawn.alphas[..., 0].astype(np.float64)


def spoil(gaussians: Gaussians, size: float = 1.0, seed: int = 0) -> Gaussians:
    """Move all parameters off by some of what a fit may move them."""
    rng = np.random.default_rng(seed)

    def noise(like: np.ndarray, sigma: float) -> np.ndarray:
        return (size * sigma * rng.normal(size=like.shape)).astype(np.float32)

    unit = gaussians.scales.max(1, keepdims=True)
    return replace(
        gaussians,
        means=gaussians.means + unit * noise(gaussians.means, 0.3),
        quats=normalize(gaussians.quats + noise(gaussians.quats, 0.1)),
        scales=gaussians.scales * elementary.exp(noise(gaussians.scales, 0.3)),
        opacities=(gaussians.opacities + noise(gaussians.opacities, 0.1)).clip(0.1, 0.95),
        sh0=gaussians.sh0 + noise(gaussians.sh0, 0.1) / SH_C0,
    )


@cache
def self_made(degree: int, views: int = 3) -> tuple[Scene, Gaussians]:
    """Return a scene whose photos show exactly these Gaussians."""
    scene = make_scene(room(), arc(views, 48, 36), degree=degree)
    gaussians = plain(scene, superpixels="8%")
    gaussians = replace(gaussians, means=gaussians.means.astype(np.float32), scales=1.2 * gaussians.scales)
    images = images_of(gaussians, scene.cameras)[0].clip(0, 1)
    return replace(scene, images=images.astype(np.float32)), gaussians


def pair_of(scene: Scene) -> tuple[Photos, Photos]:
    """Return the photos at full and at half size, as the fit takes them."""
    return scene_photos(scene), scene_photos(scene, 2)


def tuned(options: FitOptions, **constants: float) -> FitOptions:
    """Return the options with other constants of the fit."""
    return replace(options, tuning=replace(options.tuning, **constants))  # type: ignore[arg-type]


def run_for(photos: tuple[Photos, ...], options: FitOptions, count: int = 0, **job: Any) -> FitRun:
    """Return a fit to photos, prepared; ``job``: more of it."""
    return prepare_fit(FitJob(photos, options, count, **job))


def bare(gaussians: Gaussians) -> Scene:
    """Return Gaussians without views."""
    none = Cameras(np.zeros((0, 4, 4)), np.zeros((0, 3, 3)), 8, 8)
    return Scene(gaussians, none, None, None, ())


def psnr_of(gaussians: Gaussians, scene: Scene) -> float:
    """Return the PSNR (dB) over all views of a scene with photos."""
    image = np.clip(images_of(gaussians, scene.cameras)[0], 0, 1)
    return float(-10 * elementary.log10(((image - scene.images.astype(np.float64)) ** 2).mean()))


def compacted(scene: Scene, **settings: Any) -> CompactResult:
    """Call ``compact`` and check the invariants; a tenth of the pixels unless told."""
    if "superpixels" not in settings:
        settings = {"superpixels": "10%", **settings}
    result = compact(scene, **settings)
    assert_invariants(result.gaussians, scene)
    assert_consistent(result.report, scene, result.gaussians)
    return result


def plain(scene: Scene, **settings: Any) -> Gaussians:
    """Return the merge alone: no networks, no fit, cameras as they are."""
    alone = {"fit": "none", "checkpoint": "none", "poses": "fixed"}
    return compacted(scene, **{**alone, **settings}).gaussians


def identical(a: Gaussians, b: Gaussians) -> bool:
    """Return whether Gaussians are the same to the last bit."""
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in FIELDS)


def assert_invariants(gaussians: Gaussians, scene: Scene) -> None:
    """Check what must hold of the Gaussians of every compact scene."""
    for name in FIELDS:
        assert np.isfinite(getattr(gaussians, name)).all(), name
    assert (gaussians.opacities > 0).all()
    assert (gaussians.opacities < 1).all()
    assert (gaussians.scales > 0).all()
    np.testing.assert_allclose(np.linalg.norm(gaussians.quats, axis=1), 1, atol=1e-5)
    covars = covariances(gaussians.quats.astype(np.float64), gaussians.scales.astype(np.float64))
    assert (np.linalg.eigvalsh(covars)[:, 0] >= -1e-9 * np.trace(covars, axis1=1, axis2=2)).all()
    assert len(gaussians) <= len(scene.gaussians)
    if (scene.gaussians.opacities > 1 / 255).all():
        assert len(gaussians) >= 1
    assert gaussians.sh_degree <= scene.gaussians.sh_degree
    drawn = render(gaussians, scene.cameras)
    assert np.isfinite(drawn.images).all()
    assert np.isfinite(drawn.alphas).all()


def assert_consistent(report: CompactReport, scene: Scene, gaussians: Gaussians) -> None:
    """Check that the report tells what the run did."""
    assert (report.num_input, report.num_output) == (scene.num_gaussians, len(gaussians))
    unmeasured = (scene.images is None and not scene.has_own_pixels) or "nothing is scored" in (report.worse or "")
    assert (report.psnr_before is None) == (report.psnr_after is None) == unmeasured
    assert all(seconds >= 0 for seconds in report.seconds.values())
    assert report.peak_memory_bytes > 0


def assert_same_set(one: Gaussians, other: Gaussians, *, atol: float, unit: float = 1.0) -> None:
    """Check for the same Gaussians in any order: all fields of partners within ``atol``, lengths in ``unit``."""
    assert len(one) == len(other)
    a, b = (_rows(g, unit) for g in (one, other))
    nearest = np.array([np.abs(row - b).max(1).argmin() for row in a], int)
    error = np.abs(a - b[nearest]).max(1)
    assert error.max(initial=0) <= atol, f"{(error > atol).sum()} of {len(a)} differ, by up to {error.max():.3g}"
    assert len(np.unique(nearest)) == len(a)


def _rows(gaussians: Gaussians, unit: float) -> np.ndarray:
    means, quats, scales, opacities, sh0, shN = (getattr(gaussians, name).astype(np.float64) for name in FIELDS)
    columns = (means / unit, covariances(quats, scales / unit), opacities, SH_C0 * sh0, SH_C0 * shN)
    return np.concatenate([column.reshape(len(gaussians), math.prod(column.shape[1:])) for column in columns], 1)


def make_features(
    means: Any, *, sizes: Any = 0.01, views: Any = None, colors: Any = 0.5, opacities: Any = 0.8, degree: int = 0
) -> FeatureGaussians:
    """Make ball-shaped Feature Gaussians of one member each (row i of the scene), one view each unless told.

    Args:
        means: ``[g,3]``.
        sizes: Standard deviations, ``[g]`` or one; ``[g,3]`` for boxes along the axes.
        views: ``[g]``.
        colors: ``[g,3]`` or one, sRGB in [0, 1].
        opacities: ``[g]`` or one.
        degree: Of the harmonics, zero above degree 0.
    """
    means = np.asarray(means, np.float32)
    g = len(means)

    def full(values: Any, *shape: int) -> np.ndarray:
        return np.broadcast_to(np.asarray(values, np.float32), shape).copy()

    scales = full(np.asarray(sizes)[:, None] if np.shape(sizes) == (g,) else sizes, g, 3)
    opacity = full(opacities, g)
    return FeatureGaussians(
        means=means,
        covars=scales[:, :, None] ** 2 * np.eye(3, dtype=np.float32),
        weights=opacity,
        masses=opacity * scales.prod(1) * (2 * math.pi) ** 1.5,
        extinctions=-elementary.log1p(-opacity) * np.sort(scales, 1)[:, 1:].prod(1),
        gains=np.ones(g, np.float32),
        sh0=(full(colors, g, 3)[:, None] - 0.5) / SH_C0,
        shN=np.zeros((g, (degree + 1) ** 2 - 1, 3), np.float32),
        footprints=scales.mean(1),
        views=np.arange(g) if views is None else np.asarray(views),
        starts=np.arange(g + 1),
        members=np.arange(g),
        latents=np.zeros((g, 0), np.float32),
    )
