"""Image files by the names of views: in folders and their sub-folders, with or without extension."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from pathlib import Path, PurePath, PurePosixPath
from typing import TypeVar

from gsmerge.errors import SceneError
from gsmerge.io.bounds import walk_files
from gsmerge.io.first_bytes import FILM, FOREIGN, OTHER_PICTURES
from gsmerge.types import StrPath

IMAGE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".jfif", ".webp", ".bmp", ".tif", ".tiff", ".ppm"})
OTHER_SUFFIXES = frozenset(ending for _, endings, _ in OTHER_PICTURES for ending in endings)  # of pictures not read
FILMS = frozenset(ending for ending, (what, _) in FOREIGN.items() if what == FILM)
_CUT = "cut it into the frames that the model saw: ffmpeg -i FILM photos/%05d.jpg"
_MAX_PARTS = 16  # of a path, its name and the folders above, by which files are found
_NAME_FOLDER = "name the folder of the photos with --images, or with --target-images those of held-out views"
_HIDDEN = ".@"  # with which names of hidden folders begin: .thumb, @eaDir
ImageSource = StrPath | Sequence[StrPath]
PixelCount = Callable[[Path], int]  # of an image file
PathT = TypeVar("PathT", str, Path)


def match_images(source: ImageSource, names: Sequence[str]) -> list[Path]:
    """Find the image file of every view; see :func:`read_images`."""
    if isinstance(source, str | os.PathLike):
        root = Path(source)
        if not root.is_dir():
            problem = "expected a folder of images, found a file" if root.exists() else "no such folder"
            raise SceneError(root, problem)
        files = list_images(root)
    else:
        files = [Path(p) for p in source]
        root = files[0].parent if files else Path()
    by_ending = _by_ending(root, files)
    matched = [_lookup(root, by_ending, name) for name in names]
    paths = [path for path in matched if path is not None]
    if not paths and len(files) == len(names):
        return files
    if len(paths) < len(names):
        missing = names[matched.index(None)]
        problem = f"expected {len(names)} images, one per camera, found {len(files)} and none for {missing}"
        raise SceneError(root, problem, "add what is missing, or name the right folder with --images")
    if len(set(paths)) < len(set(names)):  # layers of one view have its name
        twice = Counter(paths).most_common(1)[0][0]
        raise SceneError(root, f"expected an image of its own for each camera, found {twice.name} for two of them")
    return paths


def _by_ending(root: Path, files: Sequence[Path]) -> dict[str, list[Path]]:
    """List the files below a folder by every ending of their paths."""
    by_ending: dict[str, list[Path]] = {}
    for file in files:
        for ending in _endings(file.relative_to(root) if file.is_relative_to(root) else file):
            by_ending.setdefault(ending, []).append(file)
    return by_ending


def _endings(path: PurePath) -> list[str]:
    """List the endings of a path, the longest first, with and without its extension."""
    parts = path.parts[-_MAX_PARTS:]
    endings = [PurePosixPath(*parts[i:]) for i in range(len(parts))]
    return list(dict.fromkeys(str(name) for ending in endings for name in (ending, ending.with_suffix(""))))


def _find_matches(by_ending: dict[str, list[Path]], name: str) -> list[Path]:
    """List the files whose paths have the longest ending of a name that any has."""
    parts = [part for part in PurePosixPath(name.replace("\\", "/")).parts if part not in ("/", "//", "..")]
    return next((by_ending[ending] for ending in _endings(PurePosixPath(*parts)) if ending in by_ending), [])


def propose_images(root: Path, files: Sequence[Path], names: Sequence[str], pixels: PixelCount) -> list[Path | None]:
    """Propose one of ``files`` below a folder for each name, None where none has it.

    Of several, one whose whole path is the name comes first, hidden folders last; then the largest by ``pixels``.
    """
    by_ending = _by_ending(root, files)

    def rank(path: Path, name: str) -> tuple[bool, bool, int]:
        inside = path.relative_to(root) if path.is_relative_to(root) else path
        whole = any(ending in (str(inside), str(inside.with_suffix(""))) for ending in _endings(PurePosixPath(name)))
        return not whole, any(part[0] in _HIDDEN for part in inside.parts), -pixels(path)

    def choose(name: str) -> Path | None:
        matches = _find_matches(by_ending, name)
        return min(matches, key=lambda path: rank(path, name)) if len(matches) > 1 else next(iter(matches), None)

    return [choose(name) for name in names]


def _lookup(root: Path, by_ending: dict[str, list[Path]], name: str, option: str = "--images") -> Path | None:
    matches = _find_matches(by_ending, name)
    if len(matches) > 1:
        first, second = (os.path.relpath(path, root) for path in matches[:2])
        problem = f"expected one image named {name}, found {first} and {second}"
        raise SceneError(root, problem, f"name the folder that has one of them with {option}")
    return matches[0] if matches else None


def match_masks(folder: Path, names: Sequence[str], option: str = "--masks") -> tuple[list[Path | None], list[str]]:
    """Find the mask of every view by the name of its photo, with or without extension; None for a view without.

    Also returns a note on masks of no view. SceneError, which names the ``option``, if the folder has no mask of any
    view, or two of one view.
    """
    files = list_images(folder)
    by_ending = _by_ending(folder, files)
    masks = [_lookup(folder, by_ending, name, option) for name in names]
    if not any(masks):
        rename = "none of them", f"rename them, or name another folder with {option}"
        what, remedy = (None if files else _find_unread(walk_files(folder))) or rename
        problem = f"expected masks named as the photos, such as {PurePath(names[0]).stem}.png, found {what}"
        raise SceneError(folder, problem, remedy)
    unused = [file.relative_to(folder).as_posix() for file in files if file not in masks]
    some = ", ".join(unused[:3]) + ", ..." * (len(unused) > 3)
    note = f"{option.removeprefix('--')}: {len(unused)} of {folder} have the name of no photo: {some}"
    return masks, [note] if unused else []


def list_images(folder: Path) -> list[Path]:
    """List all images below a folder in natural order ("2" before "10"); SceneError for too many files."""
    images = [f for f in walk_files(folder) if f.suffix.lower() in IMAGE_SUFFIXES and not f.name.startswith(".")]
    return natural_order(images)


def check_photo_folder(path: Path) -> None:
    """Raise SceneError if a path is a film or a picture, or a folder without a photo that is read."""
    if path.suffix.lower() in FILMS and path.is_file():
        raise SceneError(path, "expected a folder of photos, found a film", _CUT)
    if path.suffix.lower() in IMAGE_SUFFIXES | OTHER_SUFFIXES and path.is_file():
        raise SceneError(path, "expected a folder of photos, found a picture", "name its folder")
    if not path.is_dir() or list_images(path):
        return
    what, remedy = _find_unread(walk_files(path)) or ("none", _NAME_FOLDER)
    raise SceneError(path, f"expected photos, {', '.join(sorted(IMAGE_SUFFIXES))}, found {what}", remedy)


def describe_unread(folder: Path, places: Sequence[str]) -> list[str]:
    """Describe in a note the pictures and films in a folder, and in those of its ``places``, that are not read."""
    for place in (*(folder / name for name in places), folder):
        with suppress(OSError):
            files = (path for path in place.iterdir() if path.is_file())
            unread = _find_unread([path for path in files if path.suffix.lower() != ".gif"])  # which are clips
            if unread is not None:
                return [f"{place} has {unread[0]}, which is not read: {unread[1]}"]
    return []


def _find_unread(files: Sequence[Path]) -> tuple[str, str] | None:
    """Describe pictures or films among files that are not read, and what to do about them; None without any."""
    found = Counter(file.suffix.lower() for file in files)
    if pictures := sum(found[ending] for ending in OTHER_SUFFIXES):
        endings = " and ".join(sorted(ending for ending in found if ending in OTHER_SUFFIXES))
        return f"{pictures} {endings}", "convert them to .jpg or .png, with their names"
    return (FILM, _CUT) if any(found[ending] for ending in FILMS) else None


def natural_key(name: str) -> list[tuple[int, int, str]]:
    """Make a sort key that puts "view 2" before "view 10"."""
    parts = [(p, p.lstrip("0")) for p in re.split(r"([0-9]+)", name) if p]
    return [(0, len(digits), digits) if p[0] in "0123456789" else (1, 0, p) for p, digits in parts]


def natural_order(paths: Iterable[PathT]) -> list[PathT]:
    """Sort paths so that "view 2" comes before "view 10"; paths with equal numbers, as "view 02", by their letters."""
    return sorted(sorted(paths), key=lambda path: natural_key(os.fspath(path).replace(os.sep, "/")))


def find_image(folder: Path, name: str, remedy: str = _NAME_FOLDER) -> Path | None:
    """Find the image that a camera file in the folder names, with or without extension; None if there is none.

    SceneError, with the remedy, for an image that is not below the folder: a stranger's camera file could name any
    picture of this machine. Links below it are followed.
    """
    path = os.path.normpath(os.path.join(folder, name))
    candidates = [path, *(path + suffix for suffix in sorted(IMAGE_SUFFIXES))]
    found = next((Path(c) for c in candidates if os.path.isfile(c)), None)
    forms = (Path.absolute, Path.resolve)
    if found is not None and not any(form(found).is_relative_to(form(folder)) for form in forms):
        raise SceneError(folder, f"expected photos in this folder, found that its cameras name {found}", remedy)
    return found
