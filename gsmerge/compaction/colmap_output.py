"""Write a scene as a COLMAP model: its three files, and links to the photos in the folder that trainers read."""

from __future__ import annotations

from pathlib import Path

from gsmerge.io.atomic import AddOutput, link_file
from gsmerge.io.cameras import colmap_model
from gsmerge.io.formats.table import MODEL_NAMES, Contents, NamedPhotos
from gsmerge.measure.visibility import front_rows


def photo_folder(points: Path) -> Path:
    """Return the folder from which trainers read the photos of a model, given the path of its points."""
    return points.parent.parent.parent / "images"


def files_beside(points: Path, apart: bool) -> tuple[Path, ...]:
    """Return the paths of a model's other files; SceneError if files of another program are beside them."""
    return colmap_model.files_beside(points)


def note_photos(points: Path, photos: NamedPhotos) -> list[str]:
    """Return a note on the photos that are missing in the folder that trainers read, if they are not linked there."""
    place = photo_folder(points)
    if not place.exists() and all(photo is not None for _, photo in photos):
        return []
    absent = len({name for name, _ in photos if not (place / name).is_file()})
    return [f"trainers read photos from {place}: copy or link the {absent:,} missing photos there"] if absent else []


def write_output(add: AddOutput, path: Path, points: Path, contents: Contents) -> dict[Path, list[Path]]:
    """Write a model, see :data:`gsmerge.io.formats.table.WriteOutput`; link its photos unless their folder exists.

    ``contents.photos`` come from :func:`gsmerge.compaction.outputs.name_photos`.
    """
    gaussians, cameras = contents.levels[0], contents.cameras
    files, place = [points, *map(add, files_beside(path, apart=False))], photo_folder(path)
    if not place.exists():
        for name, photo in dict(contents.photos).items():
            if photo is not None:
                link_file(photo, add(place / name))
    names = [name for name, _ in contents.photos]
    model = colmap_model.model_files(gaussians, cameras, names, front_rows(gaussians, cameras))
    for file, name in zip(files, MODEL_NAMES, strict=True):
        file.write_bytes(model[name])
    return {path: files}
