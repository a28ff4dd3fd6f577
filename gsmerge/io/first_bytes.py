"""Recognise by their first bytes files that are no scenes, cameras or photos, and refuse them with a remedy."""

from __future__ import annotations

import re
import shlex
from contextlib import suppress
from pathlib import Path

from gsmerge.errors import SceneError
from gsmerge.frozen import dataclass

_PACKED_SCENES = (".spz", ".splat", ".sog", ".npz", ".glb", ".gsm")
IMAGE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".jfif", ".webp", ".bmp", ".ppm", ".tif", ".tiff", ".avif"})
# Endings of files that are never text
NO_TEXT = (".ply", *_PACKED_SCENES, *IMAGE_SUFFIXES - {".ppm"}, ".torch", ".safetensors", ".bin")
_START = 1 << 10  # number of first bytes of a file that are compared with patterns
# A report of gsmerge (a page, JSON or CSV) has one of these texts among its first bytes
_REPORTS = b'content="gsmerge ', b'"name": "gsmerge"', b"schema_version,result,"
_DOWNLOAD = "download it again, in a browser if the page needs a click or a login"
_UNPACK = "unpack it, and name the scene in it"
_NAME_SUBJECT = "name the scene or the result that it is about"
_COPY_AGAIN = "copy or download it again"


@dataclass(frozen=True)
class OtherContent:
    """A kind of content for which a file is refused, with a remedy."""

    what: str  # its name in messages
    start: str  # pattern of the first bytes; messages quote its group ``quote``, if it has one
    remedy: str
    allowed: tuple[str, ...] = ()  # endings of files that are not refused for this content
    refused: tuple[str, ...] | None = None  # endings of files that are refused for it; None: all others


_TRAIN_OR_MAKE = "train Gaussians on it, or make Gaussians from the photos with a model"
_WRITE_GAUSSIANS = (
    "write its Gaussians as .ply, with ns-export gaussian-splat (nerfstudio) or the option save_ply (gsplat)"
)
_EXPORT = "export the scene from its program as .ply"
FILM = "a film"
# The npm package of a program that converts other formats
CONVERTER_PACKAGE = "@playcanvas/splat-transform@3.7"
# In remedies, {path} stands for the path of the file
_PACKED_BY_OTHERS = (
    "Gaussians in a format that is not read",
    f"convert it with: npx {CONVERTER_PACKAGE} {{path}} -L 0 scene.ply",
)
_FILM_ENTRY = FILM, "save its frames as photos, and make a scene from them with a model such as Depth Anything 3"
# Ending of a file that is never read -> its content, and the remedy
FOREIGN: dict[str, tuple[str, str]] = {
    **dict.fromkeys((".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v"), _FILM_ENTRY),
    **dict.fromkeys((".pt", ".pth", ".ckpt", ".pkl"), ("a checkpoint", _WRITE_GAUSSIANS)),
    **dict.fromkeys((".ksplat", ".lcc", ".lcc2"), _PACKED_BY_OTHERS),
    **dict.fromkeys((".las", ".laz", ".e57", ".pcd", ".xyz", ".pts", ".ptx"), ("a cloud of points", _TRAIN_OR_MAKE)),
    **dict.fromkeys((".obj", ".fbx", ".stl", ".dae", ".off", ".blend", ".abc"), ("a mesh", _TRAIN_OR_MAKE)),
    **dict.fromkeys((".usd", ".usdz", ".usda", ".usdc"), ("a scene of USD", _EXPORT)),
    ".gltf": ("glTF in several files", "export it as .glb, which is a single file"),
    ".bgeo": ("a geometry of Houdini", _EXPORT),
    ".ssproj": ("a project of SuperSplat", _EXPORT),
    ".psht": ("a project of Postshot", _EXPORT),
    ".rad": ("levels of Spark", "name the .ply or .spz that they were made from"),
    ".spx": ("a file of Reall3DViewer", "name the .ply that it was made from"),
    ".splatv": ("moving splats", "name a .ply of one moment"),
}
_RAW = ".dng", ".raw", ".cr2", ".cr3", ".nef", ".arw", ".orf", ".rw2", ".raf", ".pef", ".srw"
# Formats of pictures that are not read: name, endings, and a pattern of the first bytes
OTHER_PICTURES: tuple[tuple[str, tuple[str, ...], str], ...] = (
    ("HEIC", (".heic", ".heif", ".hif"), r"(?s).{4}ftyp(hei|hev|mif1|msf1)"),
    ("JPEG XL", (".jxl",), r"\xff\x0a|\0\0\0\x0cJXL "),
    ("JPEG 2000", (".jp2", ".j2k", ".jpx"), r"\xff\x4f\xff\x51|\0\0\0\x0cjP  "),
    ("GIF", (".gif",), r"GIF8"),
    ("OpenEXR", (".exr",), r"v/1\x01"),
    ("Radiance", (".hdr",), r"#\?R(ADIANCE|GBE)"),
    ("Photoshop", (".psd", ".psb"), r"8BPS"),
    ("DirectDraw", (".dds",), r"DDS "),
    ("Targa", (".tga",), r"(?!)"),  # has no mark at its start, so this pattern never matches
    ("SVG", (".svg",), r"(?:<\?xml[^>]*>)?\s*<svg"),
    ("raw", _RAW, r"(?s)FUJIFILMCCD-RAW|.{4}ftypcrx|II[RU][OS\0]"),  # other raw formats start like TIFF
    ("BigTIFF", (), r"II\+\0|MM\0\+"),
)
CONVERT = "convert it to .jpg or .png"
CONVERT_ALL = "convert all, keeping their names, with ImageMagick: mogrify -format jpg {files}"
# If several entries of this table match a file, the first of these entries says what the file is
OTHER_CONTENTS = (
    OtherContent("a Git LFS pointer", r"version https://git-lfs\.github\.com/spec/", "fetch it with: git lfs pull"),
    OtherContent(
        "a web page",
        r"(?is)(?:\xef\xbb\xbf)?\s*<(?:!doctype\s+html|html|head|body|script)\b"
        r"(?:.*?<title[^>]*>\s*(?P<quote>[^<]*[^<\s]))?",
        _DOWNLOAD,
        allowed=(".html", ".htm"),
    ),
    OtherContent(
        "tensors of torch.save, which Lyra 1 writes as .ply",
        r"(?s)PK.*/data\.pkl",
        "run Lyra with save_gaussians_orig: true, and name the file in gaussians_orig",
        allowed=(".torch",),
    ),
    OtherContent("a zip archive", r"PK\x03\x04", _UNPACK, allowed=(".sog", ".npz", ".torch")),
    OtherContent("a gzip archive", r"\x1f\x8b\x08[\0-\x1f]", _UNPACK, allowed=(".spz",)),
    OtherContent("a tar archive", r"(?s).{257}ustar", _UNPACK),
    OtherContent("a 7z archive", r"7z\xbc\xaf\x27\x1c", _UNPACK),
    OtherContent("a rar archive", r"Rar!\x1a\x07", _UNPACK),
    OtherContent("a packed file", r"BZh[1-9]1AY|\xfd7zXZ\0|\x28\xb5\x2f\xfd", _UNPACK),
    OtherContent(
        "a report of gsmerge, which no command reads",
        r'\s*\{\s*"schema_version":\s*\d+,\s*"tool":\s*\{\s*"name":\s*"gsmerge"|schema_version,result,',
        _NAME_SUBJECT,
        allowed=(".jsonl",),  # to which a batch adds
    ),
    OtherContent("a PLY file", r"ply\r?\n", "change its ending to .ply", refused=_PACKED_SCENES),
    OtherContent(
        "text", r"(?!ply[\r\n])\s*(?P<quote>[ -~\x80-\xff]+)(?:[\t\r\n][\t\r\n -~\x80-\xff]*)?\Z", _DOWNLOAD,
        refused=NO_TEXT,
    ),
)  # fmt: skip


def read_start(path: Path, count: int = 1 << 12) -> bytes:
    """Return the first bytes of a file, which show its kind; no bytes if the file cannot be read."""
    with suppress(OSError), path.open("rb") as file:
        return file.read(count)
    return b""


def may_be_replaced(path: Path) -> bool:
    """Return whether a report may be written to a path, because no file, an empty file, or another report is there."""
    return not path.is_file() or path.stat().st_size == 0 or any(mark in read_start(path) for mark in _REPORTS)


def refuse_picture(path: Path) -> None:
    """Raise SceneError if a file's ending or first bytes show a picture of a format that is not read."""
    ending = path.suffix.lower()
    start = read_start(path, _START)
    for name, endings, pattern in OTHER_PICTURES:
        if ending in endings or re.match(pattern.encode("latin-1"), start):
            problem = f"expected an image, found a picture of the format {name}, which is not read"
            raise SceneError(path, problem, CONVERT)


def check_first_bytes(path: Path, size: int) -> None:
    """Raise SceneError, with a remedy, if the ending or the first bytes of a file show content that is not read.

    ``size``: bytes of the file. A file that cannot be opened is not refused here, since the reader of the file reports
    the error.
    """
    ending = path.suffix.lower()
    if size == 0 and ending in NO_TEXT:
        raise SceneError(path, "expected content, found an empty file", _COPY_AGAIN)
    if ending in FOREIGN:
        content, remedy = FOREIGN[ending]
        raise SceneError(path, f"expected a scene, found {content}", remedy.format(path=shlex.quote(str(path))))
    start = read_start(path, _START)
    if ending in IMAGE_SUFFIXES:
        refuse_picture(path)
    for row in OTHER_CONTENTS:
        is_refused = ending not in row.allowed and (row.refused is None or ending in row.refused)
        match = re.match(row.start.encode("latin-1"), start) if is_refused else None
        if match:
            quote = (match.groupdict().get("quote") or b"").decode("utf-8", "replace").strip()
            shown = f" ({' '.join(quote.split())!r:.60})" if quote else ""
            # An archive may have a scene inside
            scenes = {_UNPACK: "scene", _NAME_SUBJECT: "scene or cameras"}
            expected = scenes.get(row.remedy, f"{ending} file".strip())
            raise SceneError(path, f"expected a {expected}, found {row.what}{shown}", row.remedy)
