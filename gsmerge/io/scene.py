"""From files to a scene with one Gaussian per pixel, verified."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from gsmerge.errors import SceneError
from gsmerge.io.alignment import Alignment, check_alignment, explain_misalignment
from gsmerge.io.cameras.camera_file import CameraFile, select_views, to_cameras
from gsmerge.io.cameras.da3 import read_da3
from gsmerge.io.cameras.read import CAMERA_PLACES, read_cameras
from gsmerge.io.images import as_tensor, find_image, natural_key, read_images
from gsmerge.io.ply import OpacityChoice, PlyInfo, PlyScene, ply_notes, read_ply
from gsmerge.io.scene_files import SceneFiles, find_scene_files
from gsmerge.types import Cameras, PixelScene

_ASPECT_TOLERANCE = 0.04  # backbones round each side to a multiple of 14 by itself
_MIN_CORRELATION = 0.5


@dataclass(frozen=True)
class SceneLoad:
    """A scene and how it came about.

    Args:
        scene: The scene.
        ply: What was found in the ``.ply``.
        files: The files that were read.
        cameras: The cameras in the order of the views, as their file has them.
        alignment: How well every view's Gaussians project into their own pixels.
        notes: What was adapted or looks odd, one sentence each, without a full stop.
    """

    scene: PixelScene
    ply: PlyInfo
    files: SceneFiles
    cameras: CameraFile
    alignment: Alignment
    notes: tuple[str, ...]


def read_scene(
    path: str | os.PathLike[str],
    *,
    cameras: str | os.PathLike[str] | None = None,
    images: str | os.PathLike[str] | None = None,
    opacity: OpacityChoice = "auto",
) -> PixelScene:
    """Read a scene with one Gaussian per pixel: ``.ply``, cameras, and images where there are any.

    Args:
        path: The ``.ply``, or a folder that has it.
        cameras: Camera file or folder; None looks beside the ``.ply``.
        images: Folder of images, or an ``.npz`` that holds them; None looks beside the ``.ply``.
        opacity: How opacities are stored; see :func:`gsmerge.io.read_ply`.

    Raises:
        SceneError: If a file is missing or damaged, or the Gaussians are not those of the cameras' pixels.

    Example:
        >>> scene = read_scene("scene.ply")  # doctest: +SKIP
    """
    return load_scene(path, cameras=cameras, images=images, opacity=opacity).scene


def load_scene(
    path: str | os.PathLike[str],
    *,
    cameras: str | os.PathLike[str] | None = None,
    images: str | os.PathLike[str] | None = None,
    opacity: OpacityChoice = "auto",
) -> SceneLoad:
    """:func:`read_scene` with everything that was found on the way."""
    files = find_scene_files(path, cameras=cameras, images=images)
    return align_scene(read_ply(files.ply, opacity=opacity), files)


def align_scene(ply: PlyScene, files: SceneFiles, camera_file: CameraFile | None = None) -> SceneLoad:
    """Put Gaussians, cameras and images together and verify that they belong together.

    The views are tried in the order of the camera file, then in the order of the images' names.

    Args:
        ply: The Gaussians.
        files: Where the cameras and images are.
        camera_file: The cameras, if they are read already.

    Raises:
        SceneError: As :func:`read_scene`.
    """
    if files.cameras is None:
        places = ", ".join(place for place in CAMERA_PLACES if len(place) > 1)
        raise SceneError(files.ply, f"no cameras found beside it (looked for {places})", "name them with --cameras")
    camera_file = read_cameras(files.cameras) if camera_file is None else camera_file
    names = camera_file.names
    images = read_photos(files, camera_file)
    cameras, notes = _fit_grid(ply.info, files, camera_file, images)
    alignment = check_alignment(ply.gaussians, cameras, ply.valid)
    if not alignment.ok:
        order = sorted(range(len(names)), key=lambda i: natural_key(names[i]))
        by_name = check_alignment(ply.gaussians, cameras[order], ply.valid)
        if not by_name.ok:
            raise _misaligned(ply, camera_file, cameras, alignment)
        cameras, camera_file, alignment = cameras[order], select_views(camera_file, order), by_name
        images = None if images is None else images[order]
        notes.append("views are in the order of the image names, not of the camera file")
    valid = ply.valid.reshape(len(cameras), cameras.height, cameras.width)
    scene = PixelScene(ply.gaussians, cameras, images, valid, camera_file.names)
    notes += _colour_notes(scene)
    return SceneLoad(scene, ply.info, files, camera_file, alignment, (*ply_notes(ply.info), *notes))


def read_photos(files: SceneFiles, camera_file: CameraFile) -> Tensor | None:
    """The images of the cameras: from the folder, an ``.npz``, or where the camera file itself says.

    Args:
        files: Where the images are.
        camera_file: The cameras.

    Returns:
        ``[c,h,w,3]`` float32 in [0, 1], in the order of the cameras; None if there are none.

    Raises:
        SceneError: As :func:`gsmerge.io.read_images`.
    """
    if files.images is None:
        folder = Path(camera_file.path).parent
        found = [find_image(folder, name) for name in camera_file.names]
        paths = [f for f in found if f is not None]
        return read_images(paths, camera_file.names) if len(paths) == len(found) else None
    if files.images.suffix != ".npz":
        return read_images(files.images, camera_file.names)
    own = files.cameras is not None and files.cameras.resolve() == files.images.resolve()
    stored = camera_file.images if own else read_da3(files.images).images
    if stored is None or len(stored) != len(camera_file):
        found_count = 0 if stored is None else len(stored)
        raise SceneError(files.images, f"expected {len(camera_file)} images, one per camera, found {found_count}")
    return as_tensor(stored)


def _fit_grid(
    ply: PlyInfo, files: SceneFiles, camera_file: CameraFile, images: Tensor | None
) -> tuple[Cameras, list[str]]:
    """Cameras of the size of the Gaussian grid: the images' size, which the camera file's must agree with."""
    sizes = sorted(set(zip(camera_file.widths.tolist(), camera_file.heights.tolist(), strict=True)))
    if images is None:
        cameras = to_cameras(camera_file)
        _expect_count(ply, len(cameras), cameras.width, cameras.height)
        return cameras, []
    height, width = images.shape[1:3]
    views = len(camera_file)
    if ply.count != views * height * width:
        grid = next((s for s in sizes if ply.count == views * s[0] * s[1]), None)
        if grid is not None:
            raise SceneError(
                files.images or camera_file.path,
                f"expected images of the Gaussian grid's size {grid[0]} x {grid[1]}, found {width} x {height}",
                "give the images that the backbone saw, or resize these",
            )
        _expect_count(ply, views, width, height)
    for w, h in sizes:
        if w and h and abs(w * height / (h * width) - 1) > _ASPECT_TOLERANCE:
            swapped = (w, h) == (height, width)
            raise SceneError(
                camera_file.path,
                f"expected cameras of the images' size {width} x {height} or a multiple of it, found {w} x {h}",
                "width and height are swapped" if swapped else "crop cameras and images alike",
            )
    other = [s for s in sizes if s != (width, height) and 0 not in s]
    notes = [f"intrinsics scaled from {w} x {h} to the images' {width} x {height}" for w, h in other]
    return to_cameras(camera_file, (width, height)), notes


def _expect_count(ply: PlyInfo, views: int, width: int, height: int) -> None:
    pixels = width * height
    if ply.count == views * pixels:
        return
    problem = (
        f"expected one Gaussian per pixel, {views} x {height} x {width} = {views * pixels} (views x height x width), "
        f"found {ply.count}"
    )
    raise SceneError(ply.path, problem, _other_grid(ply.count, views, width, height))


def _other_grid(count: int, views: int, width: int, height: int) -> str:
    """Which simple reading the number of Gaussians has instead."""
    pixels = width * height
    if count % (views * pixels) == 0:
        return f"that is {count // (views * pixels)} Gaussians per pixel"
    if count % pixels == 0:
        return f"that is {count // pixels} views of this size: give the cameras of just those"
    if count == views * (width - 16) * (height - 16):
        return f"that is {height - 16} x {width - 16} per view: 8 pixels were trimmed at every border"
    each = count / views
    guess = round((each * width / height) ** 0.5)
    for w in range(max(1, guess - 14), guess + 15):
        h = each / w
        if h == round(h) and h and abs(w * height / (h * width) - 1) < _ASPECT_TOLERANCE:
            return f"that is {round(h)} x {w} per view: give cameras and images of that size"
    if count < views * pixels:
        return "pixels were dropped or merged by the exporter, which is not supported"
    return "give the cameras and images that belong to it"


def _misaligned(ply: PlyScene, camera_file: CameraFile, cameras: Cameras, alignment: Alignment) -> SceneError:
    worst = alignment.worst_px
    measured = (
        f"expected every view's Gaussians within {alignment.limit_px:g} px of their own pixels, "
        f"found a median of up to {worst:.1f} px and {100 * alignment.share_in_front:.0f} % in front of their camera"
    )
    reason = explain_misalignment(ply.gaussians, cameras, ply.valid, camera_file.convention)
    unknown = "no other convention fits either: give the cameras that belong to the .ply"
    return SceneError(camera_file.path, measured, f"{reason}: convert one to the other" if reason else unknown)


def _colour_notes(scene: PixelScene) -> list[str]:
    """A note if the images do not look like the Gaussians: likely in another order, or of another scene."""
    if scene.images is None:
        return []
    step = max(1, scene.pixels_per_view // 5000)
    colours = scene.gaussians.sh0.reshape(len(scene), -1, 3)[:, ::step].mean(-1)
    photos = scene.images.reshape(len(scene), -1, 3)[:, ::step].mean(-1)
    valid = scene.valid.reshape(len(scene), -1)[:, ::step]
    odd = [
        name
        for name, colour, photo, ok in zip(scene.names, colours, photos, valid, strict=True)
        if _correlation(colour[ok], photo[ok]) < _MIN_CORRELATION
    ]
    return [f"{len(odd)} of {len(scene)} images do not look like their Gaussians, for example {odd[0]}"] if odd else []


def _correlation(a: Tensor, b: Tensor) -> float:
    """Pearson's correlation, 1 where one of the two hardly varies."""
    if len(a) < 16 or min(float(a.std()), float(b.std())) < 0.01:
        return 1.0
    return float(torch.corrcoef(torch.stack([a, b]))[0, 1])
