"""List the captures of a dataset, and read their cameras and photos. A capture is a scene without Gaussians.

A dataset is a folder with a folder for each scene. DL3DV has ``transforms.json``, also below ``nerfstudio/``. Mip-NeRF
360 has ``sparse/0`` and ``images_4/``. A dataset of pixelSplat (RE10K, ACID) has ``index.json`` and ``.torch`` chunks
instead.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gsmerge.errors import SceneError
from gsmerge.io.bounds import read_json
from gsmerge.io.cameras.camera_file import CameraFile, as_pinholes, select_views, to_cameras
from gsmerge.io.cameras.read import read_cameras
from gsmerge.io.cameras.table import CHUNK
from gsmerge.io.photo_files import as_floats, photo_size
from gsmerge.scene.files import IMAGE_PLACES, SceneFiles
from gsmerge.scene.photos import stored_photos
from gsmerge.types import StrPath, Views

INDEX = "index.json"  # lists the chunk of each scene
CAMERA_PLACES = ("transforms.json", "nerfstudio/transforms.json", "sparse/0", "colmap/sparse/0", "cameras.json")
PHOTO_PLACES = ("images_4", "images_8", "images_2", *IMAGE_PLACES)  # smaller photos first, since models reduce them


@dataclass(frozen=True)
class Capture:
    """A scene of a dataset, as the paths of its cameras and photos; neither is in memory."""

    name: str
    path: Path  # path of the cameras: a file, a COLMAP folder, or a chunk that has the photos as well
    photos: Path | None  # folder or chunk of the photos; None: as the cameras name them

    def read_cameras(self) -> CameraFile:
        """Read all cameras, in the order of their names; cameras of a chunk in the order of the chunk."""
        cameras = read_cameras(self.path, scene=self.name)
        if self.path.suffix == CHUNK:
            return cameras
        return select_views(cameras, np.argsort(np.array(cameras.names), kind="stable").tolist())

    def read_views(self, cameras: CameraFile) -> Views:
        """Read the photos of ``cameras``, undistorted; SceneError if one is missing."""
        photos = stored_photos(SceneFiles(self.path.with_name("scene.ply"), self.path, self.photos), cameras)
        if not len(photos):
            raise SceneError(self.path, f"no photo found for {cameras.names[0]}")
        pinholes, photos, _ = as_pinholes(cameras, photos)
        return Views(to_cameras(pinholes, photo_size(photos)), as_floats(photos), cameras.names)


def list_captures(data: StrPath) -> list[Capture]:
    """List the captures of a dataset, folders in the order of their names; SceneError if there is none."""
    root, chunks = Path(data), _read_index(Path(data))
    names = chunks or sorted(path.name for path in root.glob("[!.]*") if path.is_dir())
    captures = [capture for capture in (_find(root, name, chunks) for name in names) if capture is not None]
    if not captures:
        raise _missing(root, "folders of scenes with")
    return captures


def find_capture(data: StrPath, name: str) -> Capture:
    """Find a capture of a dataset; a SceneError states where it was expected."""
    capture = _find(Path(data), name, _read_index(Path(data)))
    if capture is None:
        raise _missing(Path(data), f"a scene {name} with")
    return capture


def _read_index(root: Path) -> Mapping[str, str]:
    """Read the name of each scene's chunk; empty if the dataset has folders."""
    path = root / INDEX
    if not path.is_file():
        return {}
    chunks = read_json(path)
    if not isinstance(chunks, dict) or not all(isinstance(chunk, str) for chunk in chunks.values()):
        raise SceneError(path, f"expected the name of a {CHUNK} file for each scene, found something else")
    return chunks


def _find(root: Path, name: str, chunks: Mapping[str, str]) -> Capture | None:
    """Find a capture by name, in the chunks if there are any; None if it has no cameras."""
    if chunks:
        return Capture(name, root / chunks[name], root / chunks[name]) if name in chunks else None
    folder = root / name
    path = next((folder / place for place in CAMERA_PLACES if (folder / place).exists()), None)
    if path is None:
        return None
    places = (base / place for base in (folder, path.parent) for place in PHOTO_PLACES)
    return Capture(name, path, next((place for place in places if place.is_dir()), None))


def _missing(root: Path, expected: str) -> SceneError:
    """Make the error for a dataset without captures, or without a named capture."""
    return SceneError(
        root, f"expected {expected} {', '.join(CAMERA_PLACES)}, or {INDEX} and {CHUNK} chunks, found none"
    )
