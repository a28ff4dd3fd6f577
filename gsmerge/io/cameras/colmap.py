"""Read the cameras of COLMAP models in text or binary files. Points, rigs and frames are not read."""

from __future__ import annotations

import os
import re
import struct
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from gsmerge.errors import SceneError
from gsmerge.io.bounds import MAX_MODEL_BYTES, MAX_VIEWS, read_lines
from gsmerge.io.cameras.camera_file import StoredView, check_camera_count, make_lens, make_pinhole
from gsmerge.io.cameras.camera_source import CameraSource, StoredCameras
from gsmerge.io.first_bytes import read_start
from gsmerge.method.geometry.transforms import rotation_entries

# Camera model -> number of its parameters, in the order of COLMAP's ids. The first parameters of every model are one or
# two focal lengths and the principal point
_NUM_PARAMS = {
    "SIMPLE_PINHOLE": 3, "PINHOLE": 4, "SIMPLE_RADIAL": 4, "RADIAL": 5, "OPENCV": 8, "OPENCV_FISHEYE": 8,
    "FULL_OPENCV": 12, "FOV": 5, "SIMPLE_RADIAL_FISHEYE": 4, "RADIAL_FISHEYE": 5, "THIN_PRISM_FISHEYE": 12,
}  # fmt: skip
_MODEL_NAMES = dict(enumerate(_NUM_PARAMS))  # id -> name
# Models with one focal length for both axes
_ONE_FOCAL = {"SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"}
_FISHEYE_MODELS = {"OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"}
_PERSPECTIVE_MODELS = {"SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV"}

MAX_NAME = 1 << 16  # most bytes of an image's name

_MAX_WORDS = 4 + max(_NUM_PARAMS.values())  # most words in the line of a camera
_MAX_DIGITS = 18  # most digits of a whole number
_WHOLE_NUMBER = re.compile(rf"[+-]?[0-9]{{1,{_MAX_DIGITS}}}([.]0*)?")

_Image = tuple[str, int, np.ndarray]  # name, camera id, pose [3,4]


def read_colmap(source: CameraSource, suffix: str) -> StoredCameras:
    """Read the views of a COLMAP model in the order of its images, from files with the ``suffix`` .bin or .txt.

    Raise SceneError if the model is damaged, has a camera model that is not read, or lacks the camera of an image.
    """
    folder = source.path
    camera_path = folder / f"cameras{suffix}"
    image_path = folder / f"images{suffix}"
    try:
        cameras, images = (_read_binary if suffix == ".bin" else _read_text)(camera_path, image_path)
        unknown = next((name for name, camera, _ in images if camera not in cameras), None)
        if unknown is not None:
            raise SceneError(image_path, f"view {unknown}: its camera is not in cameras{suffix}")
    except (struct.error, ValueError, IndexError) as error:
        raise SceneError(folder, f"expected a COLMAP model, found damaged cameras or images{suffix}") from error
    except OSError as error:
        raise SceneError(folder, f"cannot be read ({error.strerror})") from error
    return StoredCameras([cameras[camera]._replace(name=name, pose=pose) for name, camera, pose in images])


def count_images(folder: Path) -> int:
    """Return the number of images of a COLMAP model; 0 if the model is damaged.

    The number stands in the file's header. In a text file without a header, the images are counted.
    """
    with suppress(OSError, ValueError, struct.error, SceneError):
        if (folder / "images.bin").is_file():
            (count,) = struct.unpack("<Q", read_start(folder / "images.bin", 8))
        else:
            stated = re.search(rb"# Number of images: (\d{1,18}),", read_start(folder / "images.txt"))
            count = int(stated[1]) if stated else len(read_colmap(CameraSource(folder), ".txt").views)
        return int(count) if count <= MAX_VIEWS else 0
    return 0


def _read_numbers(file: BinaryIO, form: str) -> tuple[Any, ...]:
    """Read the next numbers of a file by their ``struct`` format; raise struct.error if the file ends too early."""
    return struct.unpack(form, file.read(struct.calcsize(form)))


def _read_name(file: BinaryIO) -> str:
    """Read a name that ends with a zero byte; raise ValueError if no zero byte follows."""
    name = b""
    name_part = 64  # bytes of a name that are read at a time
    while b"\0" not in name:
        part = file.read(name_part)
        if not part or len(name) > MAX_NAME:
            raise ValueError("a name without an end")
        name += part
    text, _, rest = name.partition(b"\0")
    file.seek(-len(rest), os.SEEK_CUR)
    return text.decode("utf-8")


def _make_pose(numbers: list[float]) -> np.ndarray:
    """Make a pose ``[3,4]`` from a quaternion wxyz and a translation."""
    if not np.isfinite(numbers).all():
        raise ValueError("a pose that is not finite")
    quat = np.array(numbers[:4]) / max(1e-12, *map(abs, numbers[:4]))  # so that the norm does not overflow
    rotation = np.reshape(rotation_entries(*quat / max(float(np.linalg.norm(quat, axis=0)), 1e-12)), (3, 3))
    return np.concatenate([rotation, np.array(numbers[4:7])[:, None]], 1)


def _make_view(path: Path, camera_id: int, model: str, size: tuple[int, int], params: list[float]) -> StoredView:
    """Make a view of a camera, without a name and a pose; raise SceneError if the camera model is not supported."""
    if model not in _PERSPECTIVE_MODELS | _FISHEYE_MODELS:
        problem = f"camera {camera_id}: expected a pinhole, a perspective or a fisheye camera, found {model}"
        remedy = "undistort the images first"
        if model == "EQUIRECTANGULAR":
            remedy = "cut cube faces from the panoramas, and give each a camera"
        raise SceneError(path, problem, remedy)
    num_intrinsics = 3 if model in _ONE_FOCAL else 4  # the rest are coefficients of the lens
    K = make_pinhole(params[0], *params[:3]) if model in _ONE_FOCAL else make_pinhole(*params[:4])
    distortion = params[num_intrinsics : _NUM_PARAMS[model]]
    lens = make_lens(model, "fisheye" if model in _FISHEYE_MODELS else "perspective", distortion)
    if lens is None:
        # WorldMirror 1 stores the size of the photos, but intrinsics for the smaller images that the network reads.
        # Twice the principal point is taken as the size of these images if it has whole numbers, is clearly smaller
        # than the photos, and has the photos' aspect ratio
        sides = 2 * K[:2, 2]
        ratio_x, ratio_y = sides / np.maximum(size, 1)
        max_difference = 0.01  # two images have the same shape if the ratios of their sides differ by at most this
        has_photo_shape = abs(ratio_x - ratio_y) <= max_difference * abs(ratio_x)
        smaller_ratio = 0.9  # the size is that of a smaller input if the ratio of the sides is below this
        is_input = has_photo_shape and ratio_x < smaller_ratio and (sides == np.rint(sides)).all()
        size = (int(sides[0]), int(sides[1])) if is_input else size
    return StoredView("", np.eye(4), K, size, lens)


def _read_binary(camera_path: Path, image_path: Path) -> tuple[dict[int, StoredView], list[_Image]]:
    """Read ``cameras.bin`` and ``images.bin``, whose points are skipped.

    Return a view without name and pose for each camera, by the camera's id, and the images. Files are not mapped, since
    a mapped file that becomes shorter ends the process.
    """
    cameras = {}
    with camera_path.open("rb") as file:
        (count,) = _read_numbers(file, "<Q")
        check_camera_count(camera_path, count)
        for _ in range(count):
            camera_id, model_id, width, height = _read_numbers(file, "<iiQQ")
            model = _MODEL_NAMES.get(model_id, f"model {model_id}")
            params = list(_read_numbers(file, f"<{_NUM_PARAMS.get(model, 0)}d"))
            cameras[camera_id] = _make_view(camera_path, camera_id, model, (width, height), params)
    images = []
    with image_path.open("rb") as file:
        (count,) = _read_numbers(file, "<Q")
        check_camera_count(image_path, count)
        for _ in range(count):
            _, *numbers, camera = _read_numbers(file, "<i7di")
            name = _read_name(file)
            (num_points,) = _read_numbers(file, "<Q")
            points_end = file.tell() + 24 * num_points  # a point has 24 bytes: x, y and an id
            if points_end > os.fstat(file.fileno()).st_size:
                raise ValueError("early end of file")
            file.seek(points_end)
            images.append((name, camera, _make_pose(numbers)))
    return cameras, images


def _has_content(line: str) -> bool:
    """Return whether a line is neither empty nor a comment."""
    return line.strip()[:1] not in ("", "#")


def _read_text(camera_path: Path, image_path: Path) -> tuple[dict[int, StoredView], list[_Image]]:
    """Read ``cameras.txt`` and ``images.txt``. Return what :func:`_read_binary` returns.

    The line of an image has a pose, and a name that may have spaces. The next line lists the points of the image.
    Programs that rewrite the file may drop all lines of points, or only empty lines.
    """
    cameras: dict[int, StoredView] = {}
    for line in filter(_has_content, read_lines(camera_path)):
        check_camera_count(camera_path, len(cameras) + 1)
        camera_id, model, width, height, *params = line.split(maxsplit=_MAX_WORDS)
        if len(params) != _NUM_PARAMS.get(model, len(params)) or max(len(width), len(height)) > _MAX_DIGITS:
            raise ValueError("wrong number of parameters, or digits")
        size = int(width), int(height)
        cameras[int(camera_id)] = _make_view(camera_path, int(camera_id), model, size, [float(p) for p in params])
    images: list[_Image] = []
    after_image = False
    for line in filter(_has_content, read_lines(image_path, MAX_MODEL_BYTES)):
        if after_image and _lists_points(line, cameras):
            after_image = False
            continue
        check_camera_count(image_path, len(images) + 1)
        _, *numbers, camera, name = line.split(maxsplit=9)
        if len(numbers) != 7:
            raise ValueError("expected a rotation and a position")
        images.append((name.strip(), int(camera), _make_pose([float(x) for x in numbers])))
        after_image = True
    return cameras, images


def _lists_points(line: str, cameras: Mapping[int, StoredView]) -> bool:
    """Return whether the line after that of an image lists points, each as x, y and an id, rather than being the next
    image.

    The line of an image has ten words: its id, a quaternion, a translation, the id of a camera, and a name.
    """
    words = line.split(maxsplit=9)
    if len(words) < 3 or not all(_WHOLE_NUMBER.fullmatch(point_id) for point_id in words[2:9:3]):
        return False
    if len(words) < 10 or not _WHOLE_NUMBER.fullmatch(words[0]) or int(float(words[8])) not in cameras:
        return True
    quat = np.array(words[1:5], np.float64)
    not_unit = 0.05  # four numbers are no quaternion if their norm differs from 1 by more than this
    return bool(abs(np.sqrt((quat * quat).sum()) - 1) > not_unit)
