"""Find image files in a folder and its sub-folders by the names of views, which may lack the extension."""

from __future__ import annotations

import os
import re
import shlex
import struct
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from pathlib import Path, PurePath, PurePosixPath
from typing import TypeVar

from gsmerge.errors import SceneError
from gsmerge.io.bounds import walk_files
from gsmerge.io.first_bytes import CONVERT_ALL, FILM, FOREIGN, IMAGE_SUFFIXES, OTHER_PICTURES
from gsmerge.types import StrPath, number_views

OTHER_SUFFIXES = frozenset(ending for _, endings, _ in OTHER_PICTURES for ending in endings)  # of formats not read
FILMS = frozenset(ending for ending, (content, _) in FOREIGN.items() if content == FILM)
# Last bytes of the videos that gsmerge writes, which no other video has. Players skip these bytes as an unknown part
CLIP_ENDS = {".mp4": b"\0\0\0\x0ffreegsmerge", ".webm": b"\xec\x87gsmerge"}
_DRAWN = b"Software\0gsmerge render"  # mark of pictures that gsmerge drew
_PNG_START = 33  # bytes of a PNG before its second chunk
_CUT_FILM = "save the frames that the model saw as photos, with ffmpeg -i FILM photos/%05d.jpg"
IMAGE_PLACES = (  # places in a folder at which the photos of a scene may lie
    "images_resized",  # photos as WorldMirror saw them; in its images/, tall photos are squeezed
    "images", "input", "context", "rgb", "input_images", "color", "corrected_images", "keyframes/corrected_images",
    "keyframes/images", "image_2", "image_3", "image_0", "image_1", "results",
)  # fmt: skip
HOLD_PHOTOS = (".npz", ".gsm")  # endings of files that may have photos inside
_NAME_FOLDER = "name the folder of the photos with {option}"
_HIDDEN = ".@"  # first characters of hidden folders, such as .thumb and @eaDir
ImageSource = StrPath | Sequence[StrPath]
PixelCount = Callable[[Path], int]  # counts the pixels of an image file
PathT = TypeVar("PathT", str, Path)


def match_images(source: ImageSource, names: Sequence[str]) -> list[Path]:
    """Find the image file of each name, in the order of ``names``; :func:`read_images` describes source and errors."""
    if isinstance(source, str | os.PathLike):
        root = Path(source)
        if not root.is_dir():
            problem = "expected a folder of images, found a file" if root.exists() else "no such folder"
            raise SceneError(root, problem, "name the folder of the photos")
        files = list_images(root)
    else:
        files = [Path(p) for p in source]
        root = files[0].parent if files else Path()
    by_ending = _files_by_ending(root, files)
    matched = [_find_only(root, by_ending, name) for name in names]
    paths = [path for path in matched if path is not None]
    if not paths and len(files) == len(names):
        return files
    if len(paths) < len(names):
        missing = names[matched.index(None)]
        problem = f"expected {len(names)} images, one per camera, found {len(files)} and none for {missing}"
        raise SceneError(root, problem, "add the missing images, or name another folder with --images")
    if len(set(paths)) < len(set(names)):  # equal names are no error, since layers of one view share name and file
        ((repeated, _),) = Counter(paths).most_common(1)
        problem = f"expected a different image for each camera, found {repeated.name} for two of them"
        raise SceneError(root, problem, "give each image the name of its camera")
    return paths


def _files_by_ending(root: Path, files: Sequence[Path]) -> dict[str, list[Path]]:
    """Map every ending of :func:`_path_endings` to the files whose paths below a folder have this ending."""
    by_ending: dict[str, list[Path]] = {}
    for file in files:
        for ending in _path_endings(file.relative_to(root) if file.is_relative_to(root) else file):
            by_ending.setdefault(ending, []).append(file)
    return by_ending


def _path_endings(path: PurePath) -> list[str]:
    """List the endings of a path, the longest first: "a/b.png", "a/b", "b.png" and "b" for "a/b.png"."""
    max_parts = 16  # most parts of an ending: the file's name, and the folders above it
    parts = path.parts[-max_parts:]
    endings = [PurePosixPath(*parts[i:]) for i in range(len(parts))]
    return list(dict.fromkeys(str(name) for ending in endings for name in (ending, ending.with_suffix(""))))


def _find_matches(by_ending: dict[str, list[Path]], name: str) -> list[Path]:
    """List the files that match a name best: the files whose paths share the longest ending with the name.

    The list is empty if no file matches the name.
    """
    parts = [part for part in PurePosixPath(name.replace("\\", "/")).parts if part not in ("/", "//", "..")]
    return next((by_ending[ending] for ending in _path_endings(PurePosixPath(*parts)) if ending in by_ending), [])


def propose_images(root: Path, files: Sequence[Path], names: Sequence[str], pixels: PixelCount) -> list[Path | None]:
    """Propose one of ``files`` below a folder for each name; None if no file matches the name.

    Of several files that match a name, a file whose whole path is in the name is preferred. Otherwise a file outside of
    hidden folders is preferred, and then the file with the most ``pixels``.
    """
    by_ending = _files_by_ending(root, files)

    def rank(path: Path, name: str) -> tuple[bool, bool, int]:
        """Return a sort key by which the preferred file comes first."""
        relative = path.relative_to(root) if path.is_relative_to(root) else path
        whole_paths = str(relative), str(relative.with_suffix(""))
        has_whole_path = any(ending in whole_paths for ending in _path_endings(PurePosixPath(name)))
        return not has_whole_path, any(part[0] in _HIDDEN for part in relative.parts), -pixels(path)

    def choose(name: str) -> Path | None:
        """Return the preferred file for a name; None if no file matches."""
        matches = _find_matches(by_ending, name)
        return min(matches, key=lambda path: rank(path, name)) if len(matches) > 1 else next(iter(matches), None)

    return [choose(name) for name in names]


def _find_only(root: Path, by_ending: dict[str, list[Path]], name: str, option: str = "--images") -> Path | None:
    """Return the only file that matches a name; None if no file matches, SceneError if several files match."""
    matches = _find_matches(by_ending, name)
    if len(matches) > 1:
        first, second = (os.path.relpath(path, root) for path in matches[:2])
        problem = f"expected one image named {name}, found {first} and {second}"
        raise SceneError(root, problem, f"name a folder that has only one of them with {option}")
    return matches[0] if matches else None


def match_masks(
    folder: Path, names: Sequence[str], option: str = "--masks", *, named: bool = True
) -> tuple[list[Path | None], list[str]]:
    """Find the mask of every view by the name of its photo, with or without extension; None for a view without a mask.

    If the user has ``named`` the folder, photos have no names, and there are as many masks, natural order counts. Also
    return a list of notes. A note says that order counts, names masks that belong to no view, or says that no view has
    a mask. Raise SceneError if a view has two masks, or if a named folder has no mask of a view; the error names the
    ``option``.
    """
    files = list_images(folder)
    by_ending = _files_by_ending(folder, files)
    masks = list[Path | None]()
    for name in names:
        mask = _find_only(folder, by_ending, name, option)
        photo = Path(name)
        # If a mask's sub-folder has the name of a folder beside the photo's folder, the mask is that of another photo
        if mask is not None and mask.parent != folder:
            neighbour = photo.parent.parent / mask.parent.name
            mask = None if neighbour != photo.parent and neighbour.is_dir() else mask
        masks.append(mask)
    have_no_names = tuple(names) == number_views(len(names))
    if named and not any(masks) and have_no_names and len(files) == len(names):
        return list(files), [f"{option.removeprefix('--')}: the views have no names: {folder} is taken in order"]
    if not any(masks):
        unread = None if files else _describe_unread_files(walk_files(folder))
        remedy = f"rename the masks, or name another folder with {option}"
        content, remedy = unread or (f"none among {len(files)} pictures", remedy)
        order = f", or one for each of the {len(names)} views" if have_no_names else ""
        expected = f"expected masks with the names of the photos, such as {PurePath(names[0]).stem}.png{order}"
        problem = f"{expected}, found {content}"
        if named:
            raise SceneError(folder, problem, remedy)
        return masks, [f"masks are not used: {folder}: {problem}; {remedy}"]
    unused = [file.relative_to(folder).as_posix() for file in files if file not in masks]
    examples = ", ".join(unused[:3]) + ", ..." * (len(unused) > 3)
    note = f"{option.removeprefix('--')}: pictures in {folder} with the name of no photo: {examples} ({len(unused)})"
    return masks, [note] if unused else []


def list_images(folder: Path) -> list[Path]:
    """List all images in and below a folder in natural order ("2" before "10"); raise SceneError for too many files."""
    images = [f for f in walk_files(folder) if f.suffix.lower() in IMAGE_SUFFIXES and not f.name.startswith(".")]
    return natural_order(images)


def check_photo_folder(path: Path) -> None:
    """Raise SceneError if a path is a file that holds no photos, or a folder without a photo of a known format."""
    ending = path.suffix.lower()
    if path.is_file() and ending not in HOLD_PHOTOS:
        content, remedy = (FILM, _CUT_FILM) if ending in FILMS else ("a file", "name the folder of the photos")
        raise SceneError(path, f"expected a folder of photos, found {content}", remedy)
    if not path.is_dir() or list_images(path):
        return
    content, remedy = _describe_unread_files(walk_files(path)) or ("none", _NAME_FOLDER.format(option="--images"))
    raise SceneError(path, f"expected photos ({', '.join(sorted(IMAGE_SUFFIXES))}), found {content}", remedy)


def describe_unread(folder: Path, places: Sequence[str]) -> list[str]:
    """Return a note on pictures or videos that cannot be read, in the sub-folders ``places`` or in the folder itself.

    The note describes only the first folder that has unreadable pictures or videos. The list is empty if no folder has
    such files.
    """
    for place in (*(folder / name for name in places), folder):
        with suppress(OSError):
            files = (path for path in place.iterdir() if path.is_file())
            # A GIF counts as a video, which is no photo
            unread = _describe_unread_files([path for path in files if path.suffix.lower() != ".gif"])
            if unread is not None:
                content, remedy = unread
                return [f"{place} has {content}, which cannot be read; {remedy}"]
    return []


def _describe_unread_files(files: Sequence[Path]) -> tuple[str, str] | None:
    """Describe files that are pictures of unread formats, or else videos, and add a remedy; None without such files."""
    counts = Counter(file.suffix.lower() for file in files)
    if num_pictures := sum(counts[ending] for ending in OTHER_SUFFIXES):
        endings = " and ".join(sorted(ending for ending in counts if ending in OTHER_SUFFIXES))
        first = next(file for file in files if file.suffix.lower() in OTHER_SUFFIXES)
        return f"{num_pictures} {endings}", convert_all(first)
    return (FILM, _CUT_FILM) if any(file.suffix.lower() in FILMS and not is_clip(file) for file in files) else None


def convert_all(picture: Path) -> str:
    """Return the remedy for a picture of a format that is not read and for all others like it in its folder."""
    return CONVERT_ALL.format(files=f"{shlex.quote(str(picture.parent))}/*{picture.suffix}")


def describe_missing_image(folder: Path, name: str) -> str:
    """Say that a file does not exist; also name a file of the same stem whose format is not read, if there is one."""
    inner = PurePath(name)
    same_stem = set[Path]()
    for place in {folder, folder if inner.is_absolute() or ".." in inner.parts else folder / inner.parent}:
        with suppress(OSError, ValueError):
            same_stem |= {place / file for file in os.listdir(place) if PurePath(file).stem == inner.stem}
    unread = {file for file in same_stem if file.suffix.lower() in OTHER_SUFFIXES}
    short = inner.relative_to(folder.name) if inner.is_relative_to(folder.name) else inner  # without the folder's name
    if not unread:
        return f"{short}: no such file"
    return f"{short}: the format {min(unread).suffix} is not read; {convert_all(min(unread))}"


def is_clip(video: Path) -> bool:
    """Return whether the last bytes of a video show that gsmerge wrote the video."""
    end = CLIP_ENDS.get(video.suffix.lower(), b"")
    with suppress(OSError), video.open("rb") as file:
        file.seek(-len(end), os.SEEK_END)
        return bool(end) and file.read() == end
    return False


def mark_drawn(data: bytes) -> bytes:
    """Mark the bytes of a picture as a drawing of gsmerge, so that no search for photos takes it.

    Decoders of other formats than PNG ignore what follows the last pixel, so that their mark is there.
    """
    if not data.startswith(b"\x89PNG"):
        return data + _DRAWN
    chunk = b"tEXt" + _DRAWN
    text = struct.pack(">I", len(_DRAWN)) + chunk + struct.pack(">I", zlib.crc32(chunk))
    return data[:_PNG_START] + text + data[_PNG_START:]


def is_drawn(picture: Path) -> bool:
    """Return whether the first or last bytes of a picture show that gsmerge drew it; False if it cannot be read."""
    if not picture.is_file():  # a pipe would wait for a writer
        return False
    with suppress(OSError), picture.open("rb") as file:
        if _DRAWN in file.read(_PNG_START + len("size") + len("tEXt") + len(_DRAWN)):
            return True
        file.seek(-len(_DRAWN), os.SEEK_END)
        return file.read() == _DRAWN
    return False


def natural_key(name: str) -> list[tuple[int, int, str]]:
    """Make a sort key that puts "view 2" before "view 10"."""
    parts = [(p, p.lstrip("0")) for p in re.split(r"([0-9]+)", name) if p]
    return [(0, len(digits), digits) if p[0] in "0123456789" else (1, 0, p) for p, digits in parts]


def natural_order(paths: Iterable[PathT]) -> list[PathT]:
    """Sort paths so that "view 2" comes before "view 10"; equal numbers, such as 2 and 02, are sorted as text."""
    return sorted(sorted(paths), key=lambda path: natural_key(os.fspath(path).replace(os.sep, "/")))


def find_image(folder: Path, name: str, cameras: Path, *, option: str = "--images", remedy: str = "") -> Path | None:
    """Find the image that a file of ``cameras`` names, with or without extension; None if there is none.

    Raise SceneError for an image outside the folder, since a camera file from elsewhere could name any picture of this
    machine. The remedy of the error is ``remedy``, or by default to name the folder with ``option``. Links inside the
    folder are followed.
    """
    path = os.path.normpath(os.path.join(folder, name))
    candidates = [path, *(path + suffix for suffix in sorted(IMAGE_SUFFIXES))]
    image = next((Path(candidate) for candidate in candidates if os.path.isfile(candidate)), None)
    full_paths = (Path.absolute, Path.resolve)
    if image is not None and not any(full(image).is_relative_to(full(folder)) for full in full_paths):
        problem = f"expected names of photos in its folder, found {image}"
        raise SceneError(cameras, problem, remedy or _NAME_FOLDER.format(option=option))
    return image
