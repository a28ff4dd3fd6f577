"""The table of camera formats: how a file is recognised, how it stores its views, and what its poses mean.

Files with a key for each value are read by their :class:`ViewLayout`, and files of other formats by a function.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

from gsmerge.frozen import dataclass, replace
from gsmerge.io.cameras.camera_file import (
    C2W_OPENCV,
    C2W_OPENGL,
    W2C_OPENCV,
    W2C_OPENGL,
    CameraFile,
    Convention,
    make_camera_file,
)
from gsmerge.io.cameras.camera_source import CameraSource, StoredCameras
from gsmerge.io.cameras.foreign import ISAAC_FILES
from gsmerge.io.cameras.programs import (
    SHARP,
    is_long_lrm,
    join_matrices,
    list_exported_cameras,
    list_keyframes,
    list_path,
    list_shots,
    move_to_gaussians,
    read_sharp,
    set_centred_size,
)
from gsmerge.io.cameras.view_layout import (
    Matrix,
    PinholeKeys,
    RotationAndShift,
    ViewLayout,
    read_views,
    rotation_of_vector,
)
from gsmerge.io.first_bytes import read_start
from gsmerge.io.formats.table import STATE_ENDING
from gsmerge.runtime.plugins import LazyFunction, lazy_functions

_lazy = lazy_functions(__package__)
FFGS = "ffgs cameras.json"  # a format whose photos were resized until they cover the model's input, and cropped
# Formats of nerfstudio whose cameras are in the world of its splat already: the path of a viewer comes first
IN_SPLAT_FRAME = ("nerfstudio path", "ns-export cameras")
KEYFRAME = "t_00"  # key by which files of Polycam are recognised; it is within their first bytes


@dataclass(frozen=True)
class CameraFormat:
    """A format of camera files."""

    name: str  # name of the format, which is the ``source`` of its cameras
    files: str  # description for people
    ending: str  # ending of files' names, in lower case; "" for a folder
    read: ViewLayout | Callable[[CameraSource], StoredCameras]  # a function raises SceneError for damaged files
    convention: Convention  # convention of the poses
    intrinsics: str  # how intrinsics are stored, described for people
    recognise: Callable[[CameraSource], bool] = lambda _: True  # is called only for files with the ending

    def cameras(self, source: CameraSource) -> CameraFile:
        """Read the cameras of a file; raise SceneError if the file is damaged or incomplete."""
        stored = read_views(source, self.read) if isinstance(self.read, ViewLayout) else self.read(source)
        convention = stored.convention or self.convention
        camera_file = make_camera_file(
            source.path, self.name, convention=convention, views=stored.views, images=stored.images, order=stored.order
        )
        return replace(camera_file, counts=stored.counts, depths=stored.depths)


def is_colmap(folder: Path) -> bool:
    """Return whether a folder holds a COLMAP model."""
    return _holds_model(folder, ".bin") or _holds_model(folder, ".txt")


def _holds_model(folder: Path, suffix: str) -> bool:
    """Return whether a folder holds the files of a COLMAP model with the ending ``suffix``, ``.bin`` or ``.txt``."""
    return (folder / f"cameras{suffix}").is_file() and (folder / f"images{suffix}").is_file()


def is_keyframes(folder: Path) -> bool:
    """Return whether a folder holds the cameras of Polycam, each in a ``.json``."""
    first_file = min(folder.glob("[!.]*.json"), default=folder)
    return first_file.is_file() and f'"{KEYFRAME}"'.encode() in read_start(first_file)


def is_isaac(folder: Path) -> bool:
    """Return whether a folder holds the cameras of Isaac Sim, each in a ``.json``."""
    return next(folder.glob(ISAAC_FILES), None) is not None


def _has_views_with(source: CameraSource, key: str) -> bool:
    """Return whether a JSON file has a list ``views`` of objects, and at least one of the objects has the ``key``."""
    views = source.object.get("views")
    return isinstance(views, list) and all(isinstance(v, dict) for v in views) and any(key in v for v in views)


_array_names, _is_da3 = _lazy("npz_files.array_names"), _lazy("npz_files.is_da3")
_READ_COLMAP = _lazy("colmap.read_colmap")
_read_da3 = _lazy("npz_files.read_da3")
_LISTS_POSES = _lazy("pose_lines.lists_poses")
_IS_REALESTATE, _IS_EASYVOLCAP = _lazy("pose_lines.is_realestate"), _lazy("datasets.is_easyvolcap")
_read_state_views = LazyFunction("gsmerge.io.formats.gsm", "read_views")

_TRANSFORMS_JSON = ViewLayout(
    views="frames",
    name=("file_path", "image_path", "name"),
    pose=Matrix("transform_matrix"),  # applied_transform is not applied: poses are in the Gaussians' world
    K=PinholeKeys("fl_x", "fl_y", "cx", "cy", angle_x="camera_angle_x", angle_y="camera_angle_y"),
    size=("w", "h"),
    mask="mask_path",
    lens="camera_model",
    optional=("fl_x", "fl_y", "cx", "cy", "w", "h", "camera_model"),
)
_EXPORTED = replace(_TRANSFORMS_JSON, views=list_exported_cameras, pose=Matrix("transform"))
_PATH = replace(
    _TRANSFORMS_JSON, views=list_path, pose=Matrix("camera_to_world"), size=("render_width", "render_height")
)
_LONG_LRM = ViewLayout(
    views="frames",
    name=("file_path", "image_path"),
    pose=Matrix("w2c"),
    K=PinholeKeys("fx", "fy", "cx", "cy"),
    size=("w", "h"),
    finish=move_to_gaussians,
)
_INRIA = ViewLayout(
    name="img_name",
    pose=RotationAndShift("rotation", "position"),
    K=PinholeKeys("fx", "fy", "cx", "cy"),
    size=("width", "height"),
    optional=("cx", "cy"),
    finish=_lazy("npz_files.take_optimised_poses"),
)
_GLOBALSPLAT = ViewLayout(
    views="views", name=("file", "image"), pose=Matrix("c2w"), K=Matrix("intrinsic"), size="image_shape"
)
_FFGS = replace(_GLOBALSPLAT, K=Matrix("k_normalized"), unit="size")
_WORLD_MIRROR = ViewLayout(
    views=join_matrices, pose=Matrix("extrinsics"), K=Matrix("intrinsics"), finish=set_centred_size
)
_OPENSFM = ViewLayout(
    views=list_shots,
    pose=RotationAndShift("rotation", "translation", rotation_of_vector),
    K=PinholeKeys(("focal_x", "focal"), "focal_y", "c_x", "c_y"),
    size=("width", "height"),
    unit="larger side",
    origin="middle",
    lens="projection_type",
    models={
        "perspective": "OPENCV",
        "brown": "OPENCV",
        "simple_radial": "OPENCV",
        "radial": "OPENCV",
        "fisheye": "OPENCV_FISHEYE",
        "fisheye_opencv": "OPENCV_FISHEYE",
    },
    optional=("focal_y", "c_x", "c_y"),
)
_POLYCAM = ViewLayout(
    views=list_keyframes, pose=Matrix("transform"), K=PinholeKeys("fx", "fy", "cx", "cy"), size=("width", "height")
)
_ISAAC = replace(_POLYCAM, views=_lazy("datasets.list_isaac_cameras"))
_METASHAPE = ViewLayout(
    views=_lazy("metashape.list_metashape_cameras"),
    pose=Matrix("transform"),
    K=PinholeKeys("fx", "fy", "cx", "cy"),
    size=("width", "height"),
    origin="middle",
    lens="type",
    models={"frame": "OPENCV", "fisheye": "OPENCV_FISHEYE"},
    optional=("cx", "cy"),
)

SHARP_PLY = CameraFormat(
    SHARP, "inside the `.ply` of SHARP", ".ply", lambda file: read_sharp(file) or StoredCameras([]), W2C_OPENCV,
    "pixels of the photo", lambda file: read_sharp(file) is not None,
)  # fmt: skip
# A camera file is read by the first format of this table that has the file's ending and recognises the file
CAMERA_FORMATS = (
    CameraFormat("COLMAP binary", "COLMAP: `cameras.bin` and `images.bin`", "", partial(_READ_COLMAP, suffix=".bin"),
                 W2C_OPENCV, "pixels; lenses", lambda file: _holds_model(file.path, ".bin")),
    CameraFormat("Polycam", "`keyframes/corrected_cameras` of Polycam", "", _POLYCAM,
                 C2W_OPENGL, "pixels", lambda file: is_keyframes(file.path)),
    CameraFormat("Isaac Sim", "`camera_params_0000.json` of Isaac Sim's BasicWriter, beside `rgb_0000.png`", "", _ISAAC,
                 W2C_OPENGL, "pixels", lambda file: is_isaac(file.path)),
    CameraFormat("COLMAP text", "COLMAP: `cameras.txt` and `images.txt`", "", partial(_READ_COLMAP, suffix=".txt"),
                 W2C_OPENCV, "pixels; lenses", lambda file: _holds_model(file.path, ".txt")),
    CameraFormat("RealEstate10K", "`.txt` of RealEstate10K: the video's address, then 19 numbers a line", ".txt",
                 _lazy("pose_lines.read_realestate"), W2C_OPENCV, "divided by the size",
                 lambda file: _IS_REALESTATE(file.path)),
    CameraFormat("pose list", "`camera_poses.txt` of DA3-Streaming, VGGT-Long, `poses.txt` of KITTI, `traj.txt` of"
                 " Replica: 12 or 16 numbers a line", ".txt", _lazy("pose_lines.read_poses"), C2W_OPENCV,
                 "pixels, in `intrinsic.txt`, `calib.txt` or `cam_params.json`; may be missing",
                 lambda file: _LISTS_POSES(file.path)),
    CameraFormat("EasyVolcap", "`extri.yml` and `intri.yml` of EasyVolcap and EasyMocap", ".yml",
                 _lazy("datasets.read_easyvolcap"), W2C_OPENCV, "pixels; lenses", _IS_EASYVOLCAP),
    CameraFormat("Long-LRM", "dataset file of Long-LRM", ".json", _LONG_LRM, W2C_OPENCV, "pixels", is_long_lrm),
    CameraFormat("transforms.json", "`transforms.json` of nerfstudio, instant-ngp; `transforms_train.json` of Blender",
                 ".json", _TRANSFORMS_JSON, C2W_OPENGL, "pixels or field of view; may be missing; lenses",
                 lambda file: "frames" in file.object),
    CameraFormat(IN_SPLAT_FRAME[0], "`camera_path.json` of nerfstudio's viewer, for `render --path`", ".json",
                 lambda file: read_views(file, _PATH), C2W_OPENGL, "field of view",
                 lambda file: "camera_path" in file.object),
    CameraFormat(IN_SPLAT_FRAME[1], "`transforms_train.json` of `ns-export cameras`", ".json",
                 lambda file: read_views(file, _EXPORTED), C2W_OPENGL, "in the capture's `transforms.json`",
                 lambda file: "transform" in file.first),
    CameraFormat("frame list", "list of frames with `transform_matrix`", ".json", replace(_TRANSFORMS_JSON, views=""),
                 C2W_OPENCV, "pixels or field of view; may be missing; lenses",
                 lambda file: "transform_matrix" in file.first),
    CameraFormat("INRIA cameras.json", "`cameras.json` of INRIA; InstantSplat's `pose/ours_N/pose_optimized.npy`",
                 ".json", _INRIA, C2W_OPENCV, "pixels; principal point in the middle, or `cx`, `cy`",
                 lambda file: "position" in file.first or "rotation" in file.first),
    CameraFormat("GlobalSplat cameras.json", "`cameras.json` of GlobalSplat", ".json", _GLOBALSPLAT, C2W_OPENCV,
                 "pixels, or divided by the size", lambda file: _has_views_with(file, "intrinsic")),
    CameraFormat(FFGS, "`cameras.json` of ffgs", ".json", _FFGS, C2W_OPENCV,
                 "divided by the size of the model's input", lambda file: _has_views_with(file, "c2w")),
    CameraFormat("OpenSfM", "`reconstruction.json` of OpenSfM and WebODM", ".json", _OPENSFM,
                 W2C_OPENCV, "divided by the larger side; lenses", lambda file: "shots" in file.first),
    CameraFormat("Metashape", "`.xml` of Metashape", ".xml", _METASHAPE, C2W_OPENCV, "pixels from the middle; lenses"),
    CameraFormat("camera_params.json", "`camera_params.json` of WorldMirror", ".json", _WORLD_MIRROR,
                 C2W_OPENCV, "pixels", lambda file: {"extrinsics", "intrinsics"} <= file.object.keys()),
    CameraFormat("dump of a model", "`views.npz` ([below](#models-that-save-no-cameras))", ".npz",
                 _lazy("npz_files.read_views_npz"), C2W_OPENCV, "pixels, or divided by the size; may be missing",
                 lambda file: "c2w" in _array_names(file.path)),
    CameraFormat("DA3 npz", "`results.npz` of Depth Anything 3", ".npz", _read_da3,
                 W2C_OPENCV, "pixels, or divided by the size; may be missing",
                 lambda file: _is_da3(file.path)),
    CameraFormat("npz of poses", "`.npz` of what VGGT, or MapAnything or AnySplat (camera-to-world), returns",
                 ".npz", _read_da3, W2C_OPENCV, "pixels; of AnySplat divided by the size; may be missing"),
    SHARP_PLY,
    CameraFormat("state", "inside a `.gsm` of gsmerge extend", STATE_ENDING, _read_state_views, W2C_OPENCV, "pixels"),
)  # fmt: skip
CAMERA_ENDINGS = tuple(dict.fromkeys(row.ending for row in CAMERA_FORMATS if row.ending not in ("", ".ply")))
