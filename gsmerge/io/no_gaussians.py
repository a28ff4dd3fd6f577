"""Recognise output without Gaussians, and say how to get Gaussians from the model or program that wrote it."""

from __future__ import annotations

import os
import shlex
from contextlib import suppress
from itertools import islice
from pathlib import Path

from gsmerge.errors import SceneError
from gsmerge.frozen import dataclass
from gsmerge.io.bounds import check_file
from gsmerge.io.first_bytes import FOREIGN
from gsmerge.io.formats.ply import header_content
from gsmerge.io.formats.table import SEVERAL_USES, may_hold_gaussians
from gsmerge.io.image_names import IMAGE_PLACES, IMAGE_SUFFIXES, OTHER_SUFFIXES, list_images

MAX_SEARCHED_FOLDERS = 100  # most folders that are searched in a folder of scenes
_NAME_PLY = "name the .ply of the Gaussians, or the folder that it is in"


@dataclass(frozen=True)
class PointsOnly:
    """A model or program whose output has no Gaussians, with a remedy."""

    title: str  # the name that people use
    files: tuple[str, ...]  # patterns of its output in a folder; one match is enough
    remedy: str  # how the user gets Gaussians


_TRAIN_OR_NAME = "train Gaussians on it, or name the .ply of a model, and this file with --cameras"
# What a folder of photos contains, and the remedy
_PHOTOS = "photos", "make Gaussians from the photos first, with a model such as Depth Anything 3 or AnySplat"
# If several entries of this table match a folder, the first of these entries says what the folder contains
POINTS_ONLY = (
    PointsOnly(
        "Depth Anything 3",
        ("exports/npz/results.npz", "exports/mini_npz/results.npz", "results.npz", "scene.glb"),
        'run it with export_format="npz-gs_ply", infer_gs=True and a giant model',
    ),
    PointsOnly("gsplat's trainer", ("ckpts/ckpt_*.pt",), "run it with its option save_ply"),
    PointsOnly("nerfstudio", ("nerfstudio_models/*.ckpt",), "write Gaussians with ns-export gaussian-splat"),
    PointsOnly("DA3-Streaming or VGGT-Long", ("camera_poses.txt",), _TRAIN_OR_NAME),
    PointsOnly("FLARE", ("pred.npz",), f"FLARE writes no Gaussians; {_TRAIN_OR_NAME}"),
    PointsOnly(
        "VGGT or MapAnything",
        ("sparse/points.ply", "dense_mesh.glb", "glbscene_*.glb", "predictions.npz", "points.ply"),
        _TRAIN_OR_NAME,
    ),
    PointsOnly(
        "COLMAP",
        tuple(f"{folder}cameras.{kind}" for folder in ("sparse/0/", "sparse/", "0/", "") for kind in ("bin", "txt")),
        _TRAIN_OR_NAME,
    ),
    PointsOnly("a model of points", ("*.glb", "*.npz"), _TRAIN_OR_NAME),
)


def no_gaussians(folder: Path) -> SceneError:
    """Make the error for a folder without a scene. The error says what the folder contains, and what to do."""
    try:
        os.scandir(folder).close()
    except OSError as error:
        return SceneError(folder, f"cannot be read ({error.strerror})")
    content, remedy = _describe_content(folder) or ("", _NAME_PLY)
    problem = "expected a .ply of Gaussians in the folder, found none"
    return SceneError(folder, f"{problem} but {content}" if content else problem, remedy)


def find_remedy(folder: Path) -> str:
    """Say what a folder without scenes, or one of its sub-folders, contains, and what to do; "" if not known."""
    with suppress(OSError):
        subfolders = (path for path in sorted(folder.iterdir()) if path.is_dir() and path.name[0] != ".")
        searched = (folder, *islice(subfolders, MAX_SEARCHED_FOLDERS))
        contents = [(path, *known) for path in searched if (known := _describe_content(path)) is not None]
        if contents:
            path, content, remedy = min(contents, key=lambda entry: entry[1:] == _PHOTOS)  # photos only without others
            return f"{path} has {content}: {remedy}"
    return ""


def _describe_content(folder: Path) -> tuple[str, str] | None:
    """Describe what a folder without a scene contains, and add a remedy; None if nothing in the folder is known."""
    files = (
        path
        for path in sorted(folder.glob("[!.]*"))
        if path.is_file() and path.suffix != ".ply" and may_hold_gaussians(path)
    )
    scene_file = next(files, None)
    if scene_file is not None:
        return scene_file.name, "name that file"
    for row in POINTS_ONLY:
        file = next((path for pattern in row.files for path in sorted(folder.glob(pattern))), None)
        if file is not None:
            return f"{file.relative_to(folder).as_posix()} of {row.title}", row.remedy
    points = next((path for path in sorted(folder.glob("[!.]*.ply")) if header_content(path) == "other"), None)
    if points is not None:
        return f"points or a mesh ({points.name})", _NAME_PLY
    foreign = next((path for path in sorted(folder.glob("[!.]*")) if path.suffix.lower() in FOREIGN), None)
    if foreign is not None:
        kind, remedy = FOREIGN[foreign.suffix.lower()]
        return f"{kind} ({foreign.name})", remedy.format(path=shlex.quote(str(foreign)))
    has_photos = any(path.suffix.lower() in IMAGE_SUFFIXES | OTHER_SUFFIXES for path in folder.glob("[!.]*"))
    return _PHOTOS if has_photos or any(list_images(folder / place) for place in IMAGE_PLACES) else None


def check_scene_file(path: Path) -> None:
    """Raise SceneError, with a remedy, for a file without Gaussians whose ending may have them, such as ``.npz``."""
    suffix = path.suffix.lower()
    if suffix not in SEVERAL_USES or check_file(path) == 0 or may_hold_gaussians(path):
        return
    matching = (row for row in POINTS_ONLY if any(path.match(Path(file).name) for file in row.files))
    row = next(matching, POINTS_ONLY[-1])
    problem = f"expected a file of Gaussians, found a {suffix} without Gaussians, as {row.title} writes it"
    raise SceneError(path, problem, row.remedy)
