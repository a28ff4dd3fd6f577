"""Names and places: spaces, Unicode, links in circles, pipes, folders where files should be."""

from __future__ import annotations

import gzip
import os
import re
import shutil
import struct
from collections.abc import Callable, Sequence
from pathlib import Path

from .case import EITHER, READ, Case, Spoil, remove


def renamed(name: str) -> Spoil:
    """The folder under another name."""

    def spoil(folder: Path) -> Sequence[object]:
        return [folder.rename(folder.parent / name)]

    return spoil


def named_ply(name: str) -> Spoil:
    def spoil(folder: Path) -> Sequence[object]:
        return [(folder / "scene.ply").rename(folder / name)]

    return spoil


def images_named(form: str) -> Spoil:
    def spoil(folder: Path) -> None:
        path = folder / "transforms.json"
        for i in range(3):
            (folder / "images" / f"view_{i:03d}.png").rename(folder / "images" / f"{form % i}.png")
            path.write_text(path.read_text().replace(f"view_{i:03d}", form % i), encoding="utf-8")

    return spoil


def replaced(name: str, make: Callable[[Path], object]) -> Spoil:
    """Something else where a file or folder was."""

    def spoil(folder: Path) -> None:
        path = folder / name
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink()
        make(path)

    return spoil


def given(*arguments: str, make: Callable[[Path], object] = lambda path: None) -> Spoil:
    """Arguments after the folder; ``{}`` in them is the folder."""

    def spoil(folder: Path) -> Sequence[object]:
        make(folder)
        return [folder, *(argument.replace("{}", str(folder)) for argument in arguments)]

    return spoil


def loop(path: Path) -> None:
    """A link to itself."""
    path.symlink_to(path)


def ring(path: Path) -> None:
    """Two links that name each other."""
    other = path.with_name(f"{path.name}.other")
    path.symlink_to(other)
    other.symlink_to(path)


def endless(path: Path) -> None:
    """A folder that holds itself."""
    path.mkdir()
    (path / "again").symlink_to(path)


def linked(folder: Path) -> None:
    for name in ("scene.ply", "transforms.json", "images"):
        (folder / name).rename(folder / f"real-{name}")
        (folder / name).symlink_to(folder / f"real-{name}")


def deep(folder: Path) -> Sequence[object]:
    place = folder.parent.joinpath(*["d" * 100] * 20)
    place.parent.mkdir(parents=True)
    return [folder.rename(place)]


def equal_points(folder: Path) -> Sequence[object]:
    """A file of 20 kB that unpacks to 20 MB, and to seven times that in memory."""
    count = 1_000_001
    header = struct.pack("<3I4B", 0x5053474E, 3, count, 0, 12, 0, 0)
    (folder / "a.spz").write_bytes(gzip.compress(header + bytes(20 * count), 1))
    return [folder / "a.spz"]


def in_parts(change: Callable[[Path], object]) -> Spoil:
    """A scene whose views are files of their own, the last of them changed."""

    def spoil(folder: Path) -> None:
        head, rows = (folder / "scene.ply").read_bytes().split(b"end_header\n", 1)
        count = len(rows) // (4 * 17 * 3)
        head = re.sub(rb"element vertex \d+", b"element vertex %d" % count, head)
        for part in range(3):
            size = len(rows) // 3
            content = head + b"end_header\n" + rows[size * part : size * (part + 1)]
            (folder / f"view_{part:03d}.ply").write_bytes(content)
        (folder / "scene.ply").unlink()
        change(folder / "view_002.ply")

    return spoil


def pipe(path: Path) -> None:
    """A pipe in the place of a file."""
    path.unlink(missing_ok=True)
    os.mkfifo(path)


def many_images(folder: Path) -> None:
    for i in range(500):
        (folder / "images" / f"other_{i}.png").write_bytes(b"")


NAMES = {
    "spaces": " a scene  of mine ", "Unicode": "Szene \u00e4\u6f22\u0440 \U0001f600", "a dash": "-scene",
    "line breaks": "a\nb\rc", "an escape sequence": "a\x1b[2Jb", "quotes": "a'b\"c", "percent signs": "%s%n{0}",
    "brackets": "[red]*?", "255 letters": "x" * 255, "no UTF-8": "a\udcff\udcfeb",
    "right to left": "a\u202eb", "dots": "..scene..", "a ply's suffix": "scene.ply",
}  # fmt: skip

CASES = {f"folder with {word}": Case(renamed(name), READ) for word, name in NAMES.items()}
CASES["folder with a dash"] = Case(lambda folder: [folder.rename(folder.parent / "-scene")], READ)
CASES |= {f"ply with {word}": Case(named_ply(name[:240] + ".ply"), READ) for word, name in list(NAMES.items())[:5]}
CASES |= {
    f"images with {word}": Case(images_named(name), READ)
    for word, name in {"spaces": "a b  %d", "Unicode": "\u00e4\u6f22 %d", "many digits": "1" * 200 + "%d"}.items()
}
for thing, make in {"loop": loop, "pipe": pipe}.items():
    CASES[f"scene.ply as a {thing}"] = Case(replaced("scene.ply", make))
    CASES[f"transforms.json as a {thing}"] = Case(replaced("transforms.json", make), EITHER)
    CASES[f"images as a {thing}"] = Case(replaced("images", make), EITHER)
    CASES[f"an image as a {thing}"] = Case(replaced("images/view_000.png", make))
    for option, name in (("--cameras", "c.json"), ("--cameras", "c.npz"), ("--cameras", "c.txt"), ("--images", "i")):
        said = given(option, f"{{}}/{name}", make=lambda folder, make=make, name=name: make(folder / name))
        CASES[f"{option} {name}, a {thing}"] = Case(said)
    said = given("-o", "{}/out.ply", make=lambda folder, make=make: make(folder / "out.ply"))
    CASES[f"output out.ply, a {thing}"] = Case(said, (0, 2, 3))
for name in ("scene.ply", "transforms.json", "images", "images/view_000.png"):
    CASES[f"{name} as a ring"] = Case(replaced(name, ring), EITHER)
    CASES[f"{name} as a folder"] = Case(replaced(name, os.mkdir), EITHER)
CASES |= {
    "parts": Case(in_parts(lambda path: None), READ),
    "a part as a pipe": Case(in_parts(pipe)),
    "links to all files": Case(given(make=linked), READ),
    "images in an endless folder": Case(replaced("images", endless), EITHER),
    "an endless folder beside the images": Case(given(make=lambda folder: endless(folder / "images" / "more")), READ),
    "a path of 2000 letters": Case(deep, READ),
    "500 empty images": Case(given(make=many_images), READ),
    "nothing where the scene was": Case(given(make=remove("scene.ply"))),
    "a spz of a million equal points and one": Case(equal_points),
    "output in a file": Case(given("-o", "{}/scene.ply/a.ply")),
    "output below a file": Case(given("-o", "{}/transforms.json/a.ply")),
    "a device as the scene": Case(lambda folder: ["/dev/zero"]),
    "nothing as the scene": Case(lambda folder: ["/dev/null"]),
    "a device as cameras": Case(given("--cameras", "/dev/zero")),
    "a device as images": Case(given("--images", "/dev/zero")),
    "the ply as cameras": Case(given("--cameras", "{}/scene.ply")),
    "a name of 5000 letters": Case(lambda folder: [folder / ("x" * 5000)]),
}
