"""Read cameras: the table of their formats, and the places where they are in folders."""

from __future__ import annotations

import os
from collections.abc import Iterator
from functools import partial
from pathlib import Path

from gsmerge.arguments import check_arguments
from gsmerge.errors import SceneError
from gsmerge.io.bounds import check_file
from gsmerge.io.cameras.camera_file import C2W_OPENCV, C2W_OPENGL, W2C_OPENCV, CameraFile
from gsmerge.io.cameras.camera_format import CameraFormat, CameraSource, StoredCameras
from gsmerge.io.cameras.embedded import SHARP, read_sharp
from gsmerge.io.cameras.foreign import CAMERA_PLACES, INTRINSICS, check_program, check_unknown, starts_like_poses
from gsmerge.io.cameras.json_files import (
    FFGS,
    is_ffgs,
    is_long_lrm,
    read_ffgs,
    read_inria,
    read_long_lrm,
    read_world_mirror,
)
from gsmerge.io.cameras.transforms import read_transforms
from gsmerge.io.cameras.viewer_cameras import ENDING
from gsmerge.io.first_bytes import read_start
from gsmerge.io.formats.table import MODEL_NAMES, STATE_ENDING
from gsmerge.runtime.plugins import LazyFunction, lazy_functions
from gsmerge.types import StrPath

_lazy = lazy_functions(__package__)
CHUNK = ".torch"  # of re10k
array_names, holds_poses = _lazy("npz_files.array_names"), _lazy("npz_files.holds_poses")
holds_images, read_depths = _lazy("npz_files.holds_images"), _lazy("npz_files.read_depths")
_KEYFRAME = "t_00"  # value of a file of Polycam, which its first bytes name
_MAX_OTHERS = 16  # files in a folder that are looked into for cameras
_LOG = ".log"  # text of poses
_OTHERS = (".json", ".npz", ".xml", ".txt", _LOG, ".csv")


def is_colmap(folder: Path) -> bool:
    """Return whether a folder holds a COLMAP model."""
    return holds_model(folder, ".bin") or holds_model(folder, ".txt")


def is_keyframes(folder: Path) -> bool:
    """Return whether a folder holds the cameras of Polycam's keyframes, a ``.json`` each."""
    first = min(folder.glob("[!.]*.json"), default=folder)
    return first.is_file() and f'"{_KEYFRAME}"'.encode() in read_start(first)


def holds_model(folder: Path, suffix: str) -> bool:
    """Return whether a folder holds the files of a COLMAP model with an ending, ``.bin`` or ``.txt``."""
    return (folder / f"cameras{suffix}").is_file() and (folder / f"images{suffix}").is_file()


def find_cameras(folder: Path) -> Path | None:
    """Find the first known camera file below a folder, or its only ``.torch`` chunk."""
    for place in CAMERA_PLACES:
        candidate = folder / place
        if candidate.is_file() or (candidate.is_dir() and _is_camera_folder(candidate)):
            return candidate
    chunks = [chunk for chunk in folder.glob(f"*{CHUNK}") if chunk.is_file()]
    return chunks[0] if len(chunks) == 1 else None


def _is_camera_folder(folder: Path) -> bool:
    return any(row.recognise(CameraSource(folder)) for row in CAMERA_FORMATS if not row.ending)


def find_other_cameras(folder: Path) -> Path | None:
    """Find a folder's only file of :data:`_OTHERS` with cameras, or the first that starts as some if none is read."""
    files = sorted(path for path in folder.glob("[!.]*") if path.suffix in _OTHERS and path.name not in INTRINSICS)
    files = [path for path in files if path.is_file() and not path.name.endswith(ENDING)][:_MAX_OTHERS]
    files = [path for path in files if _holds_cameras(path)] or [*filter(starts_like_poses, files)][:1]
    return files[0] if len(files) == 1 else None


def _holds_cameras(path: Path) -> bool:
    if path.suffix == ".npz":
        return bool(holds_poses(path))
    try:
        return len(read_cameras(path)) > 0
    except SceneError:
        return False


@check_arguments
def read_cameras(path: StrPath, *, scene: str | None = None, folder: Path | None = None) -> CameraFile:
    """Read cameras from a file, or from a folder that holds one of the known kinds.

    The formats are those of docs/reference/formats.md. Poses become world-to-camera with OpenCV axes.

    Args:
        path: The file, a COLMAP folder, or a folder that has the cameras in one of the usual places.
        scene: Which scene, where a file holds several (``.torch`` chunks); usually the name of the ``.ply``.
        folder: Of the Gaussians, where Long-LRM writes how it moved the cameras; None: that of the cameras.

    Raises:
        SceneError: If there are no cameras, a file is damaged or incomplete, or a lens of an unknown kind.

    Example:
        >>> cameras = gsmerge.read_cameras("demo/transforms.json")
        >>> len(cameras), cameras.source
        (5, 'transforms.json')
    """
    path = _resolve(Path(path))
    ending = "" if path.is_dir() else path.suffix.lower().replace(_LOG, ".txt")
    source = CameraSource(path, scene, folder)
    chosen = next((row for row in CAMERA_FORMATS if row.ending == ending and row.recognise(source)), None)
    if chosen is None:
        check_unknown(path)
        raise SceneError(path, *_UNKNOWN.get(ending, _UNKNOWN[""]))
    return chosen.cameras(source)


def _resolve(path: Path) -> Path:
    """Return the file of cameras that a path means, or the folder of a format of several files.

    That is the one in a folder, and the folder of a COLMAP model or of keyframes that a file belongs to. SceneError
    where there is none.
    """
    if not os.path.exists(path):
        raise SceneError(path, "no such file or folder")
    if path.is_dir() and not _is_camera_folder(path):
        inside = find_cameras(path) or find_other_cameras(path)
        if inside is None:
            check_program(path)
            raise SceneError(path, "expected transforms.json, cameras.json, a COLMAP model or results.npz, found none")
        path = inside
    return path if path.is_dir() else _folder_of(path) or path


def _folder_of(path: Path) -> Path | None:
    """Return the folder of the model or the keyframes that a file belongs to; None if it stands for itself."""
    check_program(path)
    check_file(path)
    if path.suffix == ".json":
        one_of_many = is_keyframes(path.parent) and _KEYFRAME in CameraSource(path).object
        return path.parent if one_of_many else None
    in_model = path.with_suffix(".bin").name in MODEL_NAMES and is_colmap(path.parent)
    if path.suffix not in (".bin", ".txt") or (not in_model and _LISTS_POSES(path)):
        return None
    if not is_colmap(path.parent):
        check_unknown(path)
        raise SceneError(path, "expected a COLMAP model with cameras and images files, found no pair of them")
    return path.parent


def read_all_cameras(path: Path) -> Iterator[CameraFile]:
    """Read the cameras of a path as :func:`read_cameras`; of a ``.torch`` chunk, those of each of its scenes."""
    if path.suffix.lower() == CHUNK and os.path.isfile(path):
        yield from (_RE10K.convert(path, scene) for scene in _lazy("re10k.read_scenes")(path))
    else:
        yield read_cameras(path)


def read_sharp_camera(path: Path) -> CameraFile | None:
    """Read the camera that SHARP writes into its ``.ply``; None without one."""
    source = CameraSource(path)
    return _SHARP.cameras(source) if _SHARP.recognise(source) else None


_READ_COLMAP, _READ_DA3 = _lazy("colmap.read_colmap"), _lazy("npz_files.read_da3")
_LISTS_POSES, _READ_POSES = _lazy("pose_lines.lists_poses"), _lazy("pose_lines.read_poses")
_READ_VIEWS = LazyFunction("gsmerge.io.formats.gsm", "read_views")
_SHARP = CameraFormat(
    SHARP, "inside the `.ply` of SHARP", ".ply", lambda file: read_sharp(file) or StoredCameras([]), W2C_OPENCV,
    "pixels of the photo", lambda file: read_sharp(file) is not None,
)  # fmt: skip
_RE10K = CameraFormat(
    "re10k chunk", "`.torch` chunk of re10k, the scene named like the `.ply`; needs torch", CHUNK,
    _lazy("re10k.read_re10k"), W2C_OPENCV, "divided by the size",
)  # fmt: skip
# In the order of trial: the first of a file's ending that recognises it
CAMERA_FORMATS = (
    CameraFormat("COLMAP binary", "COLMAP: `cameras.bin` and `images.bin`", "", partial(_READ_COLMAP, suffix=".bin"),
                 W2C_OPENCV, "pixels; lenses", lambda file: holds_model(file.path, ".bin")),
    CameraFormat("Polycam", "`keyframes/corrected_cameras` of Polycam", "", _lazy("programs.read_polycam"),
                 C2W_OPENGL, "pixels", lambda file: is_keyframes(file.path)),
    CameraFormat("COLMAP text", "COLMAP: `cameras.txt` and `images.txt`", "", partial(_READ_COLMAP, suffix=".txt"),
                 W2C_OPENCV, "pixels; lenses", lambda file: holds_model(file.path, ".txt")),
    CameraFormat("pose folder", "`pose/*.txt` of ScanNet, NSVF", "", _READ_POSES,
                 C2W_OPENCV, "pixels, in `intrinsic.txt`; may be missing", lambda file: _LISTS_POSES(file.path)),
    CameraFormat("pose list", "poses of KITTI, TUM, RealEstate10K; `.log` of Open3D", ".txt", _READ_POSES, C2W_OPENCV,
                 "as these"),
    CameraFormat("Long-LRM", "dataset file of Long-LRM", ".json", read_long_lrm, W2C_OPENCV, "pixels", is_long_lrm),
    CameraFormat("transforms.json", "`transforms.json` of nerfstudio, instant-ngp; `transforms_train.json` of Blender",
                 ".json", read_transforms, C2W_OPENGL, "pixels or field of view; may be missing; lenses",
                 lambda file: "frames" in file.object),
    CameraFormat("frame list", "list of frames with `transform_matrix`", ".json", read_transforms, C2W_OPENCV,
                 "pixels or field of view; may be missing; lenses", lambda file: "transform_matrix" in file.first),
    CameraFormat("INRIA cameras.json", "`cameras.json` of INRIA; InstantSplat's `pose/ours_N/pose_optimized.npy`",
                 ".json", read_inria, C2W_OPENCV, "pixels; principal point in the middle, or `cx`, `cy`",
                 lambda file: "position" in file.first or "rotation" in file.first),
    CameraFormat("GlobalSplat cameras.json", "`cameras.json` of GlobalSplat", ".json", read_ffgs, C2W_OPENCV,
                 "pixels, or divided by the size", lambda file: is_ffgs(file, "intrinsic")),
    CameraFormat(FFGS, "`cameras.json` of ffgs", ".json", read_ffgs, C2W_OPENCV,
                 "divided by the size of the model's input", is_ffgs),
    CameraFormat("OpenSfM", "`reconstruction.json` of OpenSfM and WebODM", ".json", _lazy("programs.read_opensfm"),
                 W2C_OPENCV, "divided by the larger side; lenses", lambda file: "shots" in file.first),
    CameraFormat("Metashape", "`.xml` of Metashape", ".xml", _lazy("programs.read_metashape"), C2W_OPENCV,
                 "pixels from the middle; lenses"),
    CameraFormat("camera_params.json", "`camera_params.json` of WorldMirror", ".json", read_world_mirror,
                 C2W_OPENCV, "pixels", lambda file: {"extrinsics", "intrinsics"} <= file.object.keys()),
    CameraFormat("dump of a model", "`views.npz` ([below](#models-that-save-no-cameras))", ".npz",
                 _lazy("npz_files.read_dump"), C2W_OPENCV, "pixels, or divided by the size; may be missing",
                 lambda file: "c2w" in array_names(file.path)),
    CameraFormat("DA3 npz", "`results.npz` of Depth Anything 3", ".npz", _READ_DA3,
                 W2C_OPENCV, "pixels, or divided by the size; may be missing",
                 lambda file: _lazy("npz_files.is_da3")(file.path)),
    CameraFormat("npz of poses", "`.npz` of what VGGT, or MapAnything or AnySplat (camera-to-world), returns",
                 ".npz", _READ_DA3, W2C_OPENCV, "pixels; of AnySplat divided by the size; may be missing"),
    _RE10K,
    _SHARP,
    CameraFormat("state", "inside a `.gsm` of gsmerge extend", STATE_ENDING, _READ_VIEWS, W2C_OPENCV, "pixels"),
)  # fmt: skip
CAMERA_ENDINGS = (*dict.fromkeys(row.ending for row in CAMERA_FORMATS if row.ending not in ("", ".ply")), _LOG)
_UNKNOWN = {  # what was expected of a file of an ending, and a remedy
    "": (f"expected cameras as {', '.join(CAMERA_ENDINGS)} or a COLMAP folder, found another kind of file",),
    ".json": ("expected 'frames' (nerfstudio) or a list of cameras (INRIA), found neither",),
    ".ply": ("expected cameras inside it, found none", "name another file"),
}
