"""Hash the files that a scene is read from, and fill the names of scenes into paths."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from gsmerge.errors import SceneError, UsageError, attempt
from gsmerge.io import SCENE_SUFFIXES, read_cameras
from gsmerge.io.bounds import read_errors
from gsmerge.io.cameras.dataparser import list_dataparsers
from gsmerge.io.cameras.foreign import INTRINSICS
from gsmerge.io.cameras.programs import FRAMES_FILE
from gsmerge.reading.file_stats import list_inner
from gsmerge.reading.photos.scene_photos import find_photos
from gsmerge.reading.scene_files import SceneFiles

EXTRA_FILES = (INTRINSICS, FRAMES_FILE)  # read with some camera files


def digest(value: Mapping[str, Any]) -> str:
    """Compute SHA-256 of plain JSON types; the order of the keys does not matter."""
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=True, allow_nan=False)
    return hashlib.sha256(text.encode("ascii")).hexdigest()


def content_hash(files: Sequence[Path]) -> str:
    """Compute one SHA-256 over the names and contents of files, and of all files in folders."""
    state = hashlib.sha256()
    for root in files:
        for path in list_inner(root):
            name = path.relative_to(root).as_posix() if root.is_dir() else path.name
            with read_errors(path), path.open("rb") as file:
                state.update(os.fsencode(f"{len(name)}:{name}:{path.stat().st_size}:"))
                while block := file.read(1 << 20):
                    state.update(block)
    return state.hexdigest()


def list_files(files: SceneFiles) -> list[Path]:
    """List every file and folder that a scene is read from, each once."""
    paths = list(files.paths)
    for cameras in filter(None, (files.cameras, *files.others)):
        root = cameras if cameras.is_dir() else cameras.parent
        folders = (root, cameras.parent, files.ply.parent)
        paths += [folder / name for folder in folders for name in EXTRA_FILES if (folder / name).exists()]
        paths += [*list_dataparsers(files.ply, root / "_"), *list_photos(files, cameras)]
    return list(dict.fromkeys(paths))


def list_photos(files: SceneFiles, cameras: Path) -> list[Path]:
    """List the photos that may show the views of a camera file, and the masks that the camera file names."""
    camera_file = attempt(read_cameras, cameras)
    photos = camera_file if isinstance(camera_file, SceneError) else attempt(find_photos, files, camera_file)
    if isinstance(camera_file, SceneError) or isinstance(photos, SceneError):  # the reader of the scene reports it
        return []
    root = cameras if cameras.is_dir() else cameras.parent
    masks = [root / name for name in camera_file.masks.values() if (root / name).is_file()]
    return [*photos.pool, *masks]


def scene_name(scene: Path) -> str:
    """Return a scene's name: a file's name without extension, a folder's name unchanged."""
    return scene.stem if scene.suffix in SCENE_SUFFIXES else scene.name


def fill_template(template: str | None, scene: Path) -> Path | None:
    """Fill ``{scene}``, ``{parent}`` (its folder) and ``{stem}`` (its name) into a path.

    Raises UsageError if the path has other fields.
    """
    if template is None:
        return None
    parent = scene if scene.is_dir() else scene.parent
    try:
        return Path(template.format(scene=scene, parent=parent, stem=scene_name(scene)))
    except (AttributeError, LookupError, TypeError, ValueError) as error:
        raise UsageError(f"{template}: expected only {{scene}}, {{parent}} or {{stem}} in braces") from error
