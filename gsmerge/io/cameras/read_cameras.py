"""Read cameras from a path: find the file of the cameras in a folder, and recognise the file's format."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

from gsmerge.errors import SceneError
from gsmerge.io.bounds import check_file, no_such_path
from gsmerge.io.cameras.camera_file import CameraFile
from gsmerge.io.cameras.camera_source import CameraSource, check_objects
from gsmerge.io.cameras.foreign import BESIDE_POSES, CAMERA_PLACES, check_program
from gsmerge.io.cameras.table import (
    CAMERA_ENDINGS,
    CAMERA_FORMATS,
    IN_SPLAT_FRAME,
    KEYFRAME,
    SHARP_PLY,
    is_colmap,
    is_isaac,
    is_keyframes,
)
from gsmerge.io.cameras.viewer_cameras import ENDING
from gsmerge.io.image_names import natural_order
from gsmerge.runtime.arguments import check_arguments
from gsmerge.runtime.plugins import lazy_functions
from gsmerge.types import StrPath

_lazy = lazy_functions(__package__)
holds_images = _lazy("npz_files.holds_images")
_holds_poses = _lazy("npz_files.holds_poses")
count_images = _lazy("colmap.count_images")
_CANDIDATE_ENDINGS = (".json", ".npz", ".xml", ".txt")  # endings of files that may be cameras whatever their name
_OTHER_ENDINGS = (".npy", ".yml", ".yaml", ".csv", ".log")  # of cameras of other programs
_OTHER_TEXTS = r"^(readme|licen[sc]e|requirements|config|cfg|args|report|log)|report\.json$"  # which are no cameras


def find_cameras(folder: Path) -> Path | None:
    """Return the first of :func:`list_cameras`; None if there are none."""
    return next(list_cameras(folder), None)


def list_cameras(folder: Path) -> Iterator[Path]:
    """Yield the camera files in the known places of a folder, the most preferred first."""
    for place in CAMERA_PLACES:
        candidate = folder / place
        if "*" in place:
            models = natural_order(path for path in folder.glob(place) if is_colmap(path))
            yield from sorted(models, key=lambda path: -count_images(path)) if len(models) > 1 else models
        elif candidate.is_file() or (candidate.is_dir() and _is_camera_folder(candidate)):
            yield candidate


def _is_camera_folder(folder: Path) -> bool:
    """Return whether a folder has one set of cameras in several files, such as a COLMAP model."""
    return any(row.recognise(CameraSource(folder)) for row in CAMERA_FORMATS if not row.ending)


def find_other_cameras(folder: Path) -> Path | None:
    """Find a folder's only file that can be read as cameras, whatever its name; None if there is none, or several.

    Files of intrinsics beside poses, and cameras that gsmerge wrote for viewers, are left out.
    """
    max_candidates = 16  # most files of a folder that are searched for cameras
    files = [path for path in _list_files(folder, _CANDIDATE_ENDINGS)[:max_candidates] if holds_cameras(path)]
    return files[0] if len(files) == 1 else None


def list_unread(folder: Path) -> list[Path]:
    """List files of a folder that may be cameras by their endings, of whatever program, but cannot be read so."""
    files = _list_files(folder, (*_CANDIDATE_ENDINGS, *_OTHER_ENDINGS))
    return [path for path in files if not re.search(_OTHER_TEXTS, path.name, re.IGNORECASE) and not holds_cameras(path)]


def _list_files(folder: Path, endings: Sequence[str]) -> list[Path]:
    """List files of a folder with one of ``endings``, but no intrinsics beside poses, and no cameras for viewers."""
    return [
        path
        for path in sorted(folder.glob("[!.]*"))
        if path.suffix in endings
        and path.name not in BESIDE_POSES
        and not path.name.endswith(ENDING)
        and path.is_file()
    ]


def holds_cameras(path: Path) -> bool:
    """Return whether a file can be read as cameras, by its ending and its content."""
    if path.suffix not in _CANDIDATE_ENDINGS:
        return False
    if path.suffix == ".npz":
        return bool(_holds_poses(path))
    try:
        return read_cameras(path).source != IN_SPLAT_FRAME[0]  # a path is for clips
    except SceneError:
        return False


@check_arguments
def read_cameras(path: StrPath, *, folder: Path | None = None) -> CameraFile:
    """Read cameras from a file, or from a folder that holds cameras of a known format.

    The formats are those of docs/reference/formats.md. Poses become world-to-camera with OpenCV axes.

    Args:
        path: The file, a COLMAP folder, or a folder that has the cameras in one of the usual places.
        folder: Folder of the Gaussians, where Long-LRM writes how it moved the cameras. By default the cameras' folder.

    Raises:
        SceneError: If there are no cameras, if a file is damaged or incomplete, or if a camera model is not supported.

    Example:
        >>> cameras = gsmerge.read_cameras("demo/transforms.json")
        >>> len(cameras), cameras.source
        (5, 'transforms.json')
    """
    path = Path(path)
    if not os.path.exists(path):
        raise no_such_path(path)
    if path.is_dir() and not _is_camera_folder(path):
        camera_path = find_cameras(path) or find_other_cameras(path)
        if camera_path is None:
            check_program(path)
            raise SceneError(path, "expected transforms.json, cameras.json, a COLMAP model or results.npz, found none")
        path = camera_path
    if not path.is_dir():
        check_program(path)
        check_file(path)
        # A file of a COLMAP model, of Polycam's keyframes or of Isaac Sim stands for its folder
        if path.suffix == ".json":
            is_keyframe = is_keyframes(path.parent) and KEYFRAME in CameraSource(path).object
            is_of_isaac = is_isaac(path.parent) and "cameraViewTransform" in CameraSource(path).object
            path = path.parent if is_keyframe or is_of_isaac else path
        elif path.suffix in (".bin", ".txt") and path.stem in ("cameras", "images", "points3D"):
            if not is_colmap(path.parent):
                raise SceneError(path, "expected a COLMAP model with cameras and images files, found no pair of them")
            path = path.parent
    ending = "" if path.is_dir() else path.suffix.lower()
    source = CameraSource(path, folder)
    format_ = next((row for row in CAMERA_FORMATS if row.ending == ending and row.recognise(source)), None)
    if format_ is None:
        if ending == ".json" and isinstance(source.json, list):
            check_objects(path, source.json)
        raise SceneError(path, *_UNKNOWN.get(ending, _UNKNOWN[""]))
    return format_.cameras(source)


def read_sharp_camera(path: Path) -> CameraFile | None:
    """Read the camera that SHARP writes into its ``.ply``; None if the file has no camera."""
    source = CameraSource(path)
    return SHARP_PLY.cameras(source) if SHARP_PLY.recognise(source) else None


_UNKNOWN = {  # ending -> what was expected of such a file, and a remedy
    "": (f"expected cameras as {', '.join(CAMERA_ENDINGS)} or a COLMAP folder, found another kind of file",),
    ".json": ("expected 'frames' (nerfstudio) or a list of cameras (INRIA), found neither",),
    ".ply": ("expected cameras inside it, found none", "name another file"),
}
