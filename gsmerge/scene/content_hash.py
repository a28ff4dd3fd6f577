"""Hash all files that a scene is read from, and fill the names of scenes into paths."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from gsmerge.errors import SceneError, UsageError
from gsmerge.io import SCENE_SUFFIXES, CameraFile, read_cameras
from gsmerge.io.bounds import read_errors, walk_files
from gsmerge.io.cameras.dataparser import DATAPARSER
from gsmerge.io.cameras.foreign import INTRINSICS
from gsmerge.io.cameras.long_lrm import FRAMES_FILE
from gsmerge.io.scene_files import IMAGE_PLACES, SceneFiles
from gsmerge.photos.photo_folders import capture_folder, find_named_photos
from gsmerge.photos.scene_photos import images_beside

EXTRA_FILES = (DATAPARSER, INTRINSICS, FRAMES_FILE)  # read with some camera files


def digest(value: Mapping[str, Any]) -> str:
    """Compute SHA-256 of plain JSON types; the order of the keys does not matter."""
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=True, allow_nan=False)
    return hashlib.sha256(text.encode("ascii")).hexdigest()


def content_hash(files: Sequence[Path]) -> str:
    """Compute one SHA-256 over the names and contents of files and of everything in folders."""
    state = hashlib.sha256()
    for root in files:
        paths = sorted(path for path in walk_files(root) if path.is_file()) if root.is_dir() else [root]
        for path in paths:
            name = path.relative_to(root).as_posix() if root.is_dir() else path.name
            with read_errors(path), path.open("rb") as file:
                state.update(f"{len(name)}:{name}:{path.stat().st_size}:".encode())
                while block := file.read(1 << 20):
                    state.update(block)
    return state.hexdigest()


def list_files(files: SceneFiles) -> list[Path]:
    """List all files and folders from which a scene is read, each once."""
    paths = list(files.paths)
    for cameras in filter(None, (files.cameras, *files.others)):
        root = cameras if cameras.is_dir() else cameras.parent
        folders = (root, cameras.parent, files.ply.parent)
        paths += [folder / name for folder in folders for name in EXTRA_FILES if (folder / name).exists()]
        paths += list_photos(cameras) or ([] if files.images else images_beside(files.ply))
    return list(dict.fromkeys(paths))


def list_photos(cameras: Path) -> list[Path]:
    """List the photos of a camera file: the files that it names, or image folders, or files by its names; and masks."""
    camera_file = try_cameras(cameras)
    root = cameras if cameras.is_dir() else cameras.parent
    names = () if camera_file is None else camera_file.names
    named = [root / name for name in names if (root / name).is_file()]
    found = None if named or camera_file is None else find_named_photos([capture_folder(cameras)], camera_file, 0)
    folders = [root / place for place in IMAGE_PLACES if (root / place).is_dir()]
    masks = () if camera_file is None else camera_file.masks.values()
    return [*(named or folders or (found or ([], []))[1]), *(root / name for name in masks if (root / name).is_file())]


def try_cameras(path: Path) -> CameraFile | None:
    """Read the cameras of a file; None if that fails, since the reader of the scene reports the reason."""
    try:
        return read_cameras(path)
    except SceneError:
        return None


def scene_name(scene: Path) -> str:
    """Return a scene's name: a file's name without extension, a folder's name unchanged."""
    return scene.stem if scene.suffix in SCENE_SUFFIXES else scene.name


def fill_template(template: str | None, scene: Path) -> Path | None:
    """Fill ``{scene}``, ``{parent}`` (its folder) and ``{stem}`` (its name) into a path; UsageError on other fields."""
    if template is None:
        return None
    parent = scene if scene.is_dir() else scene.parent
    try:
        return Path(template.format(scene=scene, parent=parent, stem=scene_name(scene)))
    except (AttributeError, LookupError, TypeError, ValueError) as error:
        raise UsageError(f"{template}: expected only {{scene}}, {{parent}} or {{stem}} in braces") from error
