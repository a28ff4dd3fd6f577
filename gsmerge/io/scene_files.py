"""Finding the cameras and images that belong to a ``.ply``."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path

from gsmerge.errors import SceneError
from gsmerge.io.bounds import check_file
from gsmerge.io.cameras.npz_files import holds_images
from gsmerge.io.cameras.re10k import SUFFIX as CHUNK
from gsmerge.io.cameras.read import find_cameras
from gsmerge.io.photos import list_images

# The first that exists wins; then the folder's only .ply.
PLY_PLACES = ("scene.ply", "gaussians.ply", "gs_ply/0000.ply", "point_cloud.ply")
IMAGE_PLACES = ("images", "input", "context", "rgb", "input_images")
_POINT_CLOUDS = {"input.ply", "points3D.ply", "points.ply", "sparse_pc.ply"}  # of other programs
_RESULT = re.compile(r"\.compact(\.level\d+)?(\.compressed)?\.ply$")


@dataclass(frozen=True)
class SceneFiles:
    """The files of a scene; cameras may be a COLMAP folder, images the ``.npz`` or ``.torch`` that holds them."""

    ply: Path
    cameras: Path | None
    images: Path | None


def find_scene_files(
    path: str | os.PathLike[str],
    *,
    cameras: str | os.PathLike[str] | None = None,
    images: str | os.PathLike[str] | None = None,
) -> SceneFiles:
    """Find a scene's files.

    The given folder is searched, then the ``.ply``'s own, then the one above it for ``gs_ply/`` and two above
    it for ``point_cloud/iteration_n/``; in each the places of ``PLY_PLACES``, ``CAMERA_PLACES`` and
    ``IMAGE_PLACES`` in their order. Images inside the cameras' ``.npz`` or ``.torch`` go before a folder, because they
    are those that the model saw.

    Cameras and images that the user names are used instead of searching.

    Raises:
        SceneError: If there is no ``.ply``, several to choose from, or a named file does not exist.
    """
    path = Path(path)
    ply = _find_ply(path) if os.path.isdir(path) else path
    check_file(ply)
    given = path if ply != path else ply.parent
    roots = list(dict.fromkeys(Path(os.path.realpath(root)) for root in (given, *_roots(ply))))
    camera_path = _named(cameras) or next((c for c in map(find_cameras, roots) if c is not None), None)
    image_path = _named(images)
    if image_path is None and camera_path is not None:
        has_images = camera_path.suffix == CHUNK or (camera_path.suffix == ".npz" and holds_images(camera_path))
        image_path = camera_path if has_images else None
    if image_path is None:
        folders = (root / place for root in roots for place in IMAGE_PLACES)
        image_path = next((f for f in folders if f.is_dir() and list_images(f)), None)
    return SceneFiles(ply, camera_path, image_path)


def _named(path: str | os.PathLike[str] | None) -> Path | None:
    if path is None:
        return None
    if not os.path.exists(path):
        raise SceneError(path, "no such file or folder")
    if not os.path.isdir(path):
        check_file(Path(path))
    return Path(path)


def _roots(ply: Path) -> list[Path]:
    folder = Path(os.path.realpath(ply.parent))
    if folder.name == "gs_ply":
        return [folder, folder.parent]
    if folder.name.startswith("iteration_") and folder.parent.name == "point_cloud":
        return [folder, folder.parent.parent]
    return [folder]


def _find_ply(folder: Path) -> Path:
    named = named_ply(folder)
    plys = other_plys(folder) if named is None else [named]
    if not plys:
        raise SceneError(folder, "expected a .ply file in the folder, found none")
    if len(plys) > 1:
        names = ", ".join(p.name for p in plys[:4])
        raise SceneError(folder, f"expected one .ply file in the folder, found {len(plys)} ({names})", "name one")
    return plys[0]


def named_ply(folder: Path) -> Path | None:
    """The file in a folder that is the scene whatever else is in it; None without one."""
    for place in PLY_PLACES:
        if (folder / place).is_file():
            return folder / place
    trained = [p for p in folder.glob("point_cloud/iteration_*/point_cloud.ply") if p.parent.name[10:].isdecimal()]
    return max(trained, key=lambda p: int(p.parent.name[10:]), default=None)


def other_plys(folder: Path) -> list[Path]:
    """The other files directly in a folder that may be scenes: no results of gsmerge, no point clouds."""
    plys = (p for p in folder.glob("*.ply") if not p.name.startswith(".") and p.name not in _POINT_CLOUDS)
    return sorted(p for p in plys if not _RESULT.search(p.name))
