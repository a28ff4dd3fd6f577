"""What a ``.ply`` and the files next to it hold, as plain numbers."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from gsmerge.errors import SceneError
from gsmerge.geometry import project
from gsmerge.io import (
    Alignment,
    PlyScene,
    ReadHints,
    SceneFiles,
    SceneLoad,
    align_scene,
    find_scene_files,
    ply_notes,
    read_cameras,
    read_ply_with_hints,
)
from gsmerge.io.alignment import CameraCheck, check_cameras
from gsmerge.io.exporters import exporter_names, make_hints
from gsmerge.io.formats.ply import OpacityChoice
from gsmerge.io.formats.ply_file import LOGIT_COMMENT
from gsmerge.io.formats.writing import file_bytes
from gsmerge.options import CompactOptions
from gsmerge.plan import resolved_settings, steps_for
from gsmerge.report import finite
from gsmerge.runtime.estimate import estimate_run
from gsmerge.runtime.threads import available_threads, use_threads
from gsmerge.stages.clean import BOX_QUANTILES, beyond_scene, floater_share
from gsmerge.stages.segment import default_count
from gsmerge.stages.sky import sky_regions
from gsmerge.types import Cameras, Gaussians, Scene

MAX_SAMPLES = 200_000  # Gaussians that are measured
HUGE_SCALE_SHARE = 0.1  # of the box's diagonal: larger scales show no detail
_TRANSPARENT, _OPAQUE = 1 / 255, 0.995  # opacities: one step of an 8-bit image; where optical depth is capped
_SATURATED = 1e-6  # of an opacity's distance to 0 or 1: its logit changes in float32
_OWN = "gsmerge"  # the exporter's name of files that gsmerge wrote


@dataclass(frozen=True)
class Extents:
    """Where the Gaussians lie and how large they are, world units."""

    box_low: tuple[float, ...]  # 1 % quantile of the positions per axis
    box_high: tuple[float, ...]  # 99 % quantile of the same
    diagonal: float  # of that box
    share_outliers: float  # share of the Gaussians outside of the box made ten times as large about its middle
    scale_median: float  # of each Gaussian's largest scale
    scale_max: float  # the largest scale of all
    share_floaters: float  # share of the Gaussians that are isolated or far beyond the scene, of many estimated
    share_huge: float  # share of the Gaussians whose largest scale is above a tenth of the diagonal


@dataclass(frozen=True)
class Coverage:
    """What one view shows."""

    name: str  # of its image
    share_of_pixels: float | None  # share of the pixels that have a visible Gaussian of their own; None without pixels
    share_of_gaussians: float  # share of all Gaussians whose centre is inside the picture


@dataclass(frozen=True)
class Inspection:
    """Everything that was recognised, in plain Python values."""

    path: str  # the ``.ply``
    layout: str  # name of the column layout
    format: str  # "ascii", "binary little-endian" or "binary big-endian"
    count: int  # Gaussians in the file
    bytes: int  # size of the file
    bytes_by_attribute: dict[str, int]  # bytes of the rows by attribute
    extra_columns: tuple[str, ...]  # columns that mean nothing here
    extra_elements: tuple[str, ...]  # elements besides ``vertex``
    sh_degree: int  # 0 to 4
    opacity_encoding: str  # "logit" or "raw"
    extents: Extents  # how far the Gaussians reach, outliers, and how large they are
    box_low: tuple[float, ...]  # 1 % quantile of the positions per axis, world units
    box_high: tuple[float, ...]  # 99 % quantile of the same
    num_nonfinite: int  # rows with NaN or inf
    num_clipped_scales: int  # Gaussians with a scale beyond what a float32 covariance can hold
    num_zero_quats: int  # Gaussians without a rotation
    num_opaque: int  # Gaussians with an opacity of at least 0.995
    num_transparent: int  # finite Gaussians with an opacity below 1/255
    num_saturated: int  # finite Gaussians with an opacity within 1e-6 of 0 or 1
    notes: tuple[str, ...]  # warnings about the input and what was adapted, one sentence each
    exporter: str  # the exporters that may have written the file
    num_views: int = 0  # cameras, 0 without; with pixels, those that the file has
    per_pixel: int = 0  # Gaussians of each pixel; 0 without pixels
    num_missing: int = 0  # pixels of the views that the file has no Gaussian for
    width: int = 0  # of the Gaussian grid, pixels; 0 while it is not verified
    height: int = 0  # the same
    cameras: str | None = None  # where the cameras are; None without
    camera_format: str | None = None  # name of their format
    images: str | None = None  # where the images are; None without
    alignment: Alignment | None = None  # the measured alignment; None if it could not be measured
    alignment_problem: str | None = None  # why the scene is not known to have one Gaussian per pixel; None if it has
    rows: str | None = None  # which order of the rows fits best, and by how much; None without pixels
    # share of the Gaussians at most one pixel from their pixels' centres; None without pixels
    alignment_score: float | None = None
    # how many times nearer they are than in the second-best order; None without pixels
    alignment_margin: float | None = None
    # how many of the Gaussians the cameras see, and how far colours are from the photos; None without cameras that fit
    sight: CameraCheck | None = None
    coverage: tuple[Coverage, ...] = ()  # what every view shows
    num_sky_views: int = 0  # views whose photos show sky, where those are enough for ``drop_sky``
    # what ``compact`` would make of it by default: ``num_gaussians``, ``ratio``, ``bytes``, ``seconds``,
    # ``memory_bytes`` and ``machine_memory_bytes``; right within a factor of about two. None where it would refuse the
    # scene.
    estimate: dict[str, float] | None = None

    def to_dict(self) -> dict[str, Any]:
        """The same as dictionaries, lists and plain values, ready for JSON; what is not finite becomes None."""
        return finite(asdict(self))


def inspect(
    path: str | os.PathLike[str],
    *,
    cameras: str | os.PathLike[str] | None = None,
    images: str | os.PathLike[str] | None = None,
    opacity: OpacityChoice = "auto",
    **hints: Any,
) -> Inspection:
    """Say what a scene, a ``.ply`` or the folder of one, is made of, and whether it has one Gaussian per pixel.

    Cameras that are missing or do not fit are reported, not raised. ``cameras``, a file or a folder, and ``images``, a
    folder or an ``.npz``, are searched next to the ``.ply`` unless they are given. ``opacity`` is as of
    :func:`gsmerge.io.read_ply`; ``hints`` are fields of :class:`gsmerge.io.ReadHints`: ``exporter``, ``quats``,
    ``order``, ``scene_scale``, ``max_side``.

    Raises:
        SceneError: If the ``.ply`` cannot be read, or a named file does not exist.
    """
    read_hints = make_hints(hints)
    files = find_scene_files(path, cameras=cameras, images=images)
    with use_threads():
        ply = read_ply_with_hints(files.ply, opacity=opacity, hints=read_hints)
        return Inspection(**_of_ply(ply), **_of_views(ply, files, read_hints))


def _of_ply(ply: PlyScene) -> dict[str, Any]:
    info, opacities = ply.info, ply.gaussians.opacities[ply.valid]
    size = extents(ply.gaussians[ply.valid] if info.num_nonfinite else ply.gaussians)
    same = (
        "path", "layout", "format", "count", "bytes_by_attribute", "extra_columns", "extra_elements", "sh_degree",
        "opacity_encoding", "num_nonfinite", "num_clipped_scales", "num_zero_quats",
    )  # fmt: skip
    return {
        **{name: getattr(info, name) for name in same},
        "bytes": info.file_bytes,
        "extents": size,
        "box_low": size.box_low,
        "box_high": size.box_high,
        "num_opaque": int((opacities >= _OPAQUE).sum()),
        "num_transparent": int((opacities < _TRANSPARENT).sum()),
        "num_saturated": int(((opacities <= _SATURATED) | (opacities >= 1 - _SATURATED)).sum()),
    }


def _of_views(ply: PlyScene, files: SceneFiles, hints: ReadHints) -> dict[str, Any]:
    own = LOGIT_COMMENT in ply.info.comments
    facts: dict[str, Any] = {
        "cameras": files.cameras and str(files.cameras),
        "images": files.images and str(files.images),
        "exporter": _OWN if own else "not known before the cameras fit",
        "notes": ply_notes(ply.info),
    }
    camera_file = None
    try:
        if files.cameras is not None:
            camera_file = read_cameras(files.cameras, scene=files.ply.stem)
            facts |= {"num_views": len(camera_file), "camera_format": camera_file.source}
        load = align_scene(ply, files, camera_file, hints=hints)
    except SceneError as error:
        return facts | {"alignment_problem": str(error)}
    if not own:
        facts["exporter"] = exporter_names(load.exporters)
    facts |= {"notes": load.notes, "num_views": len(load.views.used)}
    facts |= {"camera_format": load.cameras and load.cameras.source}
    facts |= {"coverage": coverage(load.scene), "estimate": estimate(load.scene), "sight": _sight(load)}
    facts |= {"num_sky_views": _num_sky_views(load.scene)}
    if load.recovery is None or load.alignment is None:
        return facts | {"alignment_problem": load.problem}
    return facts | {
        "width": load.scene.cameras.width,
        "height": load.scene.cameras.height,
        "per_pixel": load.recovery.best.layout.per_pixel,
        "num_missing": load.pixel_scene().num_missing,
        "alignment": load.alignment,
        "alignment_score": load.alignment.share_within_1px,
        "alignment_margin": load.recovery.margin,
        "rows": load.recovery.description,
    }


def _num_sky_views(scene: Scene) -> int:
    if len(scene) == 0 or scene.images is None:
        return 0
    stored = scene.stored.reshape(-1) if scene.aligned else np.isfinite(scene.gaussians.means).all(1)
    return len(sky_regions(scene.gaussians.means[stored], scene.cameras, scene.images))


def _sight(load: SceneLoad) -> CameraCheck | None:
    scene = load.scene
    if len(scene) == 0:
        return None
    whole = np.ones(len(scene.gaussians), bool)
    valid = scene.stored.reshape(-1) if scene.aligned else whole
    return check_cameras(scene.gaussians, valid, scene.cameras, scene.images)


def estimate(scene: Scene) -> dict[str, Any]:
    """What ``compact`` would make of a scene by default, see :attr:`Inspection.estimate`."""
    options, photos = CompactOptions(), scene.images is not None
    count = min(scene.num_gaussians, default_count(scene, options.segment, options.decode))
    grid = len(scene), scene.cameras.height, scene.cameras.width
    return {
        "num_gaussians": count,
        "ratio": count / max(1, scene.num_gaussians),
        "bytes": file_bytes(count, scene.gaussians.sh_degree),
        **estimate_run(
            grid,
            resolved_settings(options, photos=photos),
            max(math.prod(grid), scene.num_gaussians),
            photos=photos,
            threads=available_threads(),
            fit_steps=steps_for(options, count, scene),
            num_rest=3 * scene.gaussians.shN.shape[1],
        ),
    }


def extents(gaussians: Gaussians) -> Extents:
    """Measure finite Gaussians; zeros where there are none. Large scenes are sampled, except for the largest scale."""
    if len(gaussians) == 0:
        return Extents((0.0,) * 3, (0.0,) * 3, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    step = -(-len(gaussians) // MAX_SAMPLES)
    points = gaussians.means[::step].astype(np.float64)
    largest = gaussians.scales.max(1)
    low, high = np.percentile(points, BOX_QUANTILES, axis=0)
    diagonal = float(np.linalg.norm(high - low))
    return Extents(
        box_low=tuple(map(float, low)),
        box_high=tuple(map(float, high)),
        diagonal=diagonal,
        share_outliers=float(beyond_scene(points).mean()),
        share_floaters=floater_share(gaussians),
        scale_median=float(np.median(largest[::step])),
        scale_max=float(largest.max()),
        share_huge=float((largest[::step] > HUGE_SCALE_SHARE * diagonal).mean()),
    )


def coverage(scene: Scene) -> tuple[Coverage, ...]:
    """What every view shows of a scene; of several Gaussians per pixel each layer is a view."""
    if len(scene) == 0:
        return ()
    rows = np.arange(0, len(scene.gaussians), -(-len(scene.gaussians) // MAX_SAMPLES))
    if scene.aligned:
        rows = rows[scene.stored.reshape(-1)[rows]]
    points = scene.gaussians.means[rows].astype(np.float64)
    shares = [float(inside.mean()) if len(points) else 0.0 for inside in _inside(points, scene.cameras)]
    pixels: list[float | None] = [None] * len(scene)
    if scene.aligned:
        visible = (scene.gaussians.opacities >= _TRANSPARENT).reshape(scene.valid.shape) & scene.stored
        pixels = [float(view.mean()) for view in visible]
    return tuple(map(Coverage, scene.names, pixels, shares))


def share_outside(gaussians: Gaussians, cameras: Cameras) -> float:
    """Share of the Gaussians, of many some, whose centres are inside no view's picture; 0 without any."""
    points = gaussians.means[:: max(1, -(-len(gaussians) // MAX_SAMPLES))].astype(np.float64)
    seen = np.zeros(len(points), bool)
    for inside in _inside(points, cameras):
        seen |= inside
    return float(1 - seen.mean()) if len(points) else 0.0


def _inside(points: np.ndarray, cameras: Cameras) -> Iterator[np.ndarray]:
    """``[n]`` bool of each view: which points its picture shows."""
    for view in range(len(cameras)):
        (pixels,), (depths,) = project(points, cameras[[view]])
        yield (depths > 0) & ((pixels >= 0) & (pixels < (cameras.width, cameras.height))).all(1)
