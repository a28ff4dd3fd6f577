"""What a ``.ply`` and the files around it hold, as plain numbers."""

from __future__ import annotations

import math
import os
from dataclasses import asdict, dataclass
from pathlib import Path
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
from gsmerge.io.alignment.unaligned import CameraCheck, check_cameras
from gsmerge.io.exporters import exporter_names
from gsmerge.io.formats.ply import OpacityChoice
from gsmerge.io.formats.ply_file import LOGIT_COMMENT
from gsmerge.io.formats.ply_writer import file_bytes
from gsmerge.io.hints import make_hints
from gsmerge.measure.extents import Coverage, Extents, coverage, extents
from gsmerge.options import CompactOptions
from gsmerge.report import plan_document
from gsmerge.runtime.threads import available_threads, use_threads
from gsmerge.stages.group import usual_count
from gsmerge.types import PixelScene, UnalignedScene

_TRANSPARENT, _OPAQUE = 1 / 255, 0.995  # below one step of an 8-bit image; where optical depth is capped
_OWN = "gsmerge"
_SATURATED = 1e-6  # no logit beyond it comes back from float32 as it was


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
        extra_elements: Elements beside ``vertex``.
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
        num_saturated: Finite Gaussians with an opacity of 0 or 1, but for 1e-6.
        num_views: Cameras, 0 where none were found; where pixels were found, those that the file has.
        per_pixel: Gaussians of each pixel; 0 while no pixels were found.
        num_missing: Pixels of the views that the file has no Gaussian for.
        width: Of the Gaussian grid, pixels; 0 while it is not verified.
        height: The same.
        cameras: Where the cameras are, None where none were found.
        camera_format: Name of their format.
        images: Where the images are, None where none were found.
        alignment: The measured alignment; None if it could not be measured.
        alignment_problem: Why the scene is not known to have one Gaussian per pixel; None if it has.
        exporter: The exporters that may have written the file.
        rows: Which hints of the rows won, and by how much; None while there is none.
        alignment_score: Share of the Gaussians at most one pixel from their pixels' centres; None without pixels.
        alignment_margin: How many times nearer they are than under the next reading; None without pixels.
        sight: How many of the Gaussians the cameras see, and how far colours are from the photos; None without
            cameras that fit.
        coverage: What every view shows.
        estimate: What ``compact`` would make of it by default: ``num_gaussians``, ``ratio``, ``bytes``, ``seconds``,
            ``memory_bytes`` and ``machine_memory_bytes``; right within a factor of about two. None where it would
            refuse the scene.
        notes: What was adapted or looks odd, one sentence each.
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
    num_views: int
    per_pixel: int
    num_missing: int
    width: int
    height: int
    cameras: str | None
    camera_format: str | None
    images: str | None
    alignment: Alignment | None
    alignment_problem: str | None
    exporter: str
    rows: str | None
    alignment_score: float | None
    alignment_margin: float | None
    sight: CameraCheck | None
    coverage: tuple[Coverage, ...]
    estimate: dict[str, float] | None
    notes: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """The same as dictionaries, lists and plain values, ready for JSON; what is not finite becomes None."""
        plain: dict[str, Any] = _plain(asdict(self))
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
        cameras: Camera file or folder; None looks beside the ``.ply``.
        images: Folder of images, or an ``.npz`` that holds them; None looks beside the ``.ply``.
        opacity: How opacities are stored; see :func:`gsmerge.io.read_ply`.
        **reading: Fields of :class:`gsmerge.io.ReadHints`: ``exporter``, ``quats``, ``order``, ``scene_scale``,
            ``max_side``.

    Raises:
        SceneError: If the ``.ply`` cannot be read, or a named file does not exist.
    """
    told = make_hints(hints)
    files = find_scene_files(path, cameras=cameras, images=images)
    with use_threads():
        ply = read_ply_with_hints(files.ply, opacity=opacity, hints=told)
        return Inspection(**_of_ply(ply), **_of_views(ply, files, told))


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, tuple | list):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _of_ply(ply: PlyScene) -> dict[str, Any]:
    info = ply.info
    opacities = ply.gaussians.opacities[ply.valid]
    found = extents(ply.gaussians[ply.valid] if info.num_nonfinite else ply.gaussians)
    return {
        "path": info.path,
        "layout": info.layout,
        "format": info.format,
        "count": info.count,
        "bytes": info.file_bytes,
        "bytes_by_attribute": info.bytes_by_attribute,
        "extra_columns": info.extra_columns,
        "extra_elements": info.extra_elements,
        "sh_degree": info.sh_degree,
        "opacity_encoding": info.opacity_encoding,
        "extents": found,
        "box_low": found.box_low,
        "box_high": found.box_high,
        "num_nonfinite": info.num_nonfinite,
        "num_clipped_scales": info.num_clipped_scales,
        "num_zero_quats": info.num_zero_quats,
        "num_opaque": int((opacities >= _OPAQUE).sum()),
        "num_transparent": int((opacities < _TRANSPARENT).sum()),
        "num_saturated": int(((opacities <= _SATURATED) | (opacities >= 1 - _SATURATED)).sum()),
    }


def _of_views(ply: PlyScene, files: SceneFiles, hints: ReadHints) -> dict[str, Any]:
    found: dict[str, Any] = {
        "num_views": 0,
        "per_pixel": 0,
        "num_missing": 0,
        "width": 0,
        "height": 0,
        "cameras": None if files.cameras is None else str(files.cameras),
        "camera_format": None,
        "images": None if files.images is None else str(files.images),
        "alignment": None,
        "alignment_problem": None,
        "exporter": _OWN if LOGIT_COMMENT in ply.info.comments else "not known before the cameras fit",
        "rows": None,
        "alignment_score": None,
        "alignment_margin": None,
        "sight": None,
        "coverage": (),
        "estimate": None,
        "notes": ply_notes(ply.info),
    }
    camera_file = None
    try:
        if files.cameras is not None:
            camera_file = read_cameras(files.cameras, scene=files.ply.stem)
            found |= {"num_views": len(camera_file), "camera_format": camera_file.source}
        load = align_scene(ply, files, camera_file, hints=hints)
    except SceneError as error:
        return found | {"alignment_problem": str(error)}
    found |= {"notes": load.notes} | ({} if found["exporter"] == _OWN else {"exporter": exporter_names(load.exporters)})
    found |= {"num_views": len(load.views.used), "camera_format": load.cameras and load.cameras.source}
    found |= {"coverage": coverage(load.scene), "estimate": estimate(load.scene), "sight": _sight(load)}
    if load.recovery is None or load.alignment is None:
        return found | {"alignment_problem": load.problem}
    found |= {"alignment_score": load.alignment.share_within_1px, "alignment_margin": load.recovery.margin}
    size = {"width": load.scene.cameras.width, "height": load.scene.cameras.height}
    size |= {"per_pixel": load.recovery.best.layout.per_pixel, "num_missing": load.pixel_scene().num_missing}
    return found | size | {"alignment": load.alignment, "rows": load.recovery.description}


def _sight(load: SceneLoad) -> CameraCheck | None:
    scene = load.scene
    if len(scene) == 0:
        return None
    everything = torch.ones(len(scene.gaussians), dtype=torch.bool)
    valid = scene.stored.reshape(-1) if isinstance(scene, PixelScene) else everything
    return check_cameras(scene.gaussians, valid, scene.cameras, scene.images)


def estimate(scene: PixelScene | UnalignedScene) -> dict[str, float]:
    """What ``compact`` would make of a scene by default: Gaussians, their share, bytes, seconds and bytes of memory.

    And the bytes of memory that this machine has; None where the system does not tell.
    """
    options = CompactOptions()
    plan = plan_document(
        {},
        (len(scene), scene.cameras.height, scene.cameras.width),
        options.resolved(photos=scene.images is not None),
        output_path=Path(),
        per_view=0,
        photos=scene.images is not None,
        threads=available_threads(),
        fit_steps=options.fit.steps,
        usual=usual_count(scene, options),
        count=scene.num_gaussians,
        num_rest=3 * scene.gaussians.shN.shape[1],
    )
    count = plan["output"]["num_gaussians_at_most"]
    return {
        "num_gaussians": count,
        "ratio": count / max(1, scene.num_gaussians),
        "bytes": file_bytes(count, scene.gaussians.sh_degree),
        **plan["estimate"],
    }
