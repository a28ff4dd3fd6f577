"""What a ``.ply`` and the files next to it hold, as plain numbers."""

from __future__ import annotations

import math
import os
from dataclasses import asdict, dataclass
from typing import Any

import torch

from gsmerge.errors import SceneError
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
from gsmerge.io.alignment.poses import CameraCheck, check_cameras
from gsmerge.io.exporters import exporter_names
from gsmerge.io.formats.ply import OpacityChoice
from gsmerge.io.formats.ply_file import LOGIT_COMMENT
from gsmerge.io.formats.writing import file_bytes
from gsmerge.io.hints import make_hints
from gsmerge.measure.extents import Coverage, Extents, coverage, extents
from gsmerge.options import CompactOptions
from gsmerge.report import finite
from gsmerge.runtime.estimate import estimate_run
from gsmerge.runtime.threads import available_threads, use_threads
from gsmerge.stages.group import default_count
from gsmerge.types import PixelScene, UnalignedScene

_TRANSPARENT, _OPAQUE = 1 / 255, 0.995  # opacities: one step of an 8-bit image; where optical depth is capped
_SATURATED = 1e-6  # of an opacity's distance to 0 or 1: its logit changes in float32
_OWN = "gsmerge"  # the exporter's name of files that gsmerge wrote


@dataclass(frozen=True)
class Inspection:
    """Everything that was recognised, in plain Python values.

    Args:
        path: The ``.ply``.
        layout: Name of the column layout.
        format: "ascii", "binary little-endian" or "binary big-endian".
        count: Gaussians in the file.
        bytes: Size of the file.
        bytes_by_attribute: Bytes of the rows by attribute.
        extra_columns: Columns that mean nothing here.
        extra_elements: Elements besides ``vertex``.
        sh_degree: 0 to 4.
        opacity_encoding: "logit" or "raw".
        extents: How far the Gaussians reach, outliers, and how large they are.
        box_low: 1 % quantile of the positions per axis, world units.
        box_high: 99 % quantile of the same.
        num_nonfinite: Rows with NaN or inf.
        num_clipped_scales: Gaussians with a scale beyond what a float32 covariance can hold.
        num_zero_quats: Gaussians without a rotation.
        num_opaque: Gaussians with an opacity of at least 0.995.
        num_transparent: Finite Gaussians with an opacity below 1/255.
        num_saturated: Finite Gaussians with an opacity within 1e-6 of 0 or 1.
        num_views: Cameras, 0 without; with pixels, those that the file has.
        per_pixel: Gaussians of each pixel; 0 without pixels.
        num_missing: Pixels of the views that the file has no Gaussian for.
        width: Of the Gaussian grid, pixels; 0 while it is not verified.
        height: The same.
        cameras: Where the cameras are; None without.
        camera_format: Name of their format.
        images: Where the images are; None without.
        alignment: The measured alignment; None if it could not be measured.
        alignment_problem: Why the scene is not known to have one Gaussian per pixel; None if it has.
        exporter: The exporters that may have written the file.
        rows: Which order of the rows fits best, and by how much; None without pixels.
        alignment_score: Share of the Gaussians at most one pixel from their pixels' centres; None without pixels.
        alignment_margin: How many times nearer they are than in the second-best order; None without pixels.
        sight: How many of the Gaussians the cameras see, and how far colours are from the photos; None without
            cameras that fit.
        coverage: What every view shows.
        estimate: What ``compact`` would make of it by default: ``num_gaussians``, ``ratio``, ``bytes``, ``seconds``,
            ``memory_bytes`` and ``machine_memory_bytes``; right within a factor of about two. None where it would
            refuse the scene.
        notes: Warnings about the input and what was adapted, one sentence each.
    """

    path: str
    layout: str
    format: str
    count: int
    bytes: int
    bytes_by_attribute: dict[str, int]
    extra_columns: tuple[str, ...]
    extra_elements: tuple[str, ...]
    sh_degree: int
    opacity_encoding: str
    extents: Extents
    box_low: tuple[float, ...]
    box_high: tuple[float, ...]
    num_nonfinite: int
    num_clipped_scales: int
    num_zero_quats: int
    num_opaque: int
    num_transparent: int
    num_saturated: int
    notes: tuple[str, ...]
    exporter: str
    num_views: int = 0
    per_pixel: int = 0
    num_missing: int = 0
    width: int = 0
    height: int = 0
    cameras: str | None = None
    camera_format: str | None = None
    images: str | None = None
    alignment: Alignment | None = None
    alignment_problem: str | None = None
    rows: str | None = None
    alignment_score: float | None = None
    alignment_margin: float | None = None
    sight: CameraCheck | None = None
    coverage: tuple[Coverage, ...] = ()
    estimate: dict[str, float] | None = None

    def to_dict(self) -> dict[str, Any]:
        """The same as dictionaries, lists and plain values, ready for JSON; what is not finite becomes None."""
        plain: dict[str, Any] = finite(asdict(self))
        plain["dialect"] = plain.pop("exporter")  # the name in the schema
        return plain


def inspect(
    path: str | os.PathLike[str],
    *,
    cameras: str | os.PathLike[str] | None = None,
    images: str | os.PathLike[str] | None = None,
    opacity: OpacityChoice = "auto",
    **hints: Any,
) -> Inspection:
    """Say what a scene is made of, and whether it has one Gaussian per pixel of its views.

    Cameras that are missing or do not fit are reported, not raised.

    Args:
        path: A ``.ply`` or a folder that has one.
        cameras: Camera file or folder; None: next to the ``.ply``.
        images: Folder of images, or an ``.npz`` that holds them; None: next to the ``.ply``.
        opacity: How opacities are stored; see :func:`gsmerge.io.read_ply`.
        **hints: Fields of :class:`gsmerge.io.ReadHints`: ``exporter``, ``quats``, ``order``, ``scene_scale``,
            ``max_side``.

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


def _sight(load: SceneLoad) -> CameraCheck | None:
    scene = load.scene
    if len(scene) == 0:
        return None
    valid = torch.ones(len(scene.gaussians), dtype=torch.bool)
    if isinstance(scene, PixelScene):
        valid = scene.stored.reshape(-1)
    return check_cameras(scene.gaussians, valid, scene.cameras, scene.images)


def estimate(scene: PixelScene | UnalignedScene) -> dict[str, Any]:
    """What ``compact`` would make of a scene by default, see :attr:`Inspection.estimate`."""
    options, photos = CompactOptions(), scene.images is not None
    count = min(scene.num_gaussians, default_count(scene, options))
    grid = len(scene), scene.cameras.height, scene.cameras.width
    return {
        "num_gaussians": count,
        "ratio": count / max(1, scene.num_gaussians),
        "bytes": file_bytes(count, scene.gaussians.sh_degree),
        **estimate_run(
            grid,
            options.resolved(photos=photos),
            max(math.prod(grid), scene.num_gaussians),
            photos=photos,
            threads=available_threads(),
            fit_steps=options.fit.steps,
            num_rest=3 * scene.gaussians.shN.shape[1],
        ),
    }
