"""Odd places have spaces and Unicode in their names, links in circles, pipes, and folders where files should be."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

from .case import READ, REFUSED, USAGE, Change, Damage, accept, allow, leave_to_sweep, refuse

FORMS = {
    "spaces": " a scene  of mine ", "Unicode": "Szene \u00e4\u6f22\u0440 \U0001f600", "a leading dash": "-scene",
    "line breaks": "a\nb\rc", "an escape sequence": "a\x1b[2Jb", "quotes": "a'b\"c", "percent signs": "%s%n{0}",
    "brackets": "[red]*?", "255 letters": "x" * 255, "bytes that are no UTF-8": "a\udcff\udcfeb",
    "a mark of right-to-left text": "a\u202eb", "dots": "..scene..", "the suffix .ply": "scene.ply",
}  # fmt: skip
OF_PHOTOS = {"spaces": "a b  %d", "Unicode": "\u00e4\u6f22 %d", "many digits": "1" * 200 + "%d"}
FEW = ("line breaks", "bytes that are no UTF-8")  # forms of names that are tried in every run


def rename(name: str, part: str = "") -> Change:
    """Give the folder, or a file in it, another name."""
    return lambda folder: [(folder / part).rename((folder / part).parent / name)]


def rename_photos(form: str) -> Change:
    def change(folder: Path) -> None:
        path = folder / "transforms.json"
        for i in range(3):
            (folder / "images" / f"view_{i:03d}.png").rename(folder / "images" / f"{form % i}.png")
            path.write_text(path.read_text().replace(f"view_{i:03d}", form % i), encoding="utf-8")

    return change


def remove(path: Path) -> None:
    shutil.rmtree(path) if path.is_dir() else path.unlink()


def replace_with(name: str, make: Callable[[Path], object]) -> Change:
    """Put something else where a file or folder was."""

    def change(folder: Path) -> None:
        remove(folder / name)
        make(folder / name)

    return change


def add_arguments(*arguments: str, make: Callable[[Path], object] = lambda path: None) -> Change:
    """Add arguments after the folder; ``{}`` in them is the folder."""

    def change(folder: Path) -> Sequence[object]:
        make(folder)
        return [folder, *(argument.replace("{}", str(folder)) for argument in arguments)]

    return change


def link_to_itself(path: Path) -> None:
    """Make a link to itself."""
    path.symlink_to(path)


def link_in_ring(path: Path) -> None:
    """Make two links that name each other."""
    other = path.with_name(f"{path.name}.other")
    path.symlink_to(other)
    other.symlink_to(path)


def make_endless(path: Path) -> None:
    """Make a folder that holds itself."""
    path.mkdir()
    (path / "again").symlink_to(path)


def link_all(folder: Path) -> None:
    for name in ("scene.ply", "transforms.json", "images"):
        (folder / name).rename(folder / f"real-{name}")
        (folder / name).symlink_to(folder / f"real-{name}")


def move_deep(folder: Path) -> Sequence[object]:
    place = folder.parent.joinpath(*["d" * 100] * 20)
    place.parent.mkdir(parents=True)
    return [folder.rename(place)]


def split_in_parts(change: Callable[[Path], object]) -> Change:
    """Split a scene into a file for each view, and change the last of them."""

    def both(folder: Path) -> None:
        head, rows = (folder / "scene.ply").read_bytes().split(b"end_header\n", 1)
        count = len(rows) // (4 * 17 * 3)
        head = re.sub(rb"element vertex \d+", b"element vertex %d" % count, head)
        for part in range(3):
            size = len(rows) // 3
            content = head + b"end_header\n" + rows[size * part : size * (part + 1)]
            (folder / f"view_{part:03d}.ply").write_bytes(content)
        (folder / "scene.ply").unlink()
        change(folder / "view_002.ply")

    return both


def make_pipe(path: Path) -> None:
    """Put a pipe in the place of a file."""
    path.unlink(missing_ok=True)
    os.mkfifo(path)


def add_images(folder: Path) -> None:
    for i in range(500):
        (folder / "images" / f"other_{i}.png").write_bytes(b"")


def of_names() -> dict[str, Damage]:
    folders = {word: accept(rename(name), slow=word not in FEW) for word, name in FORMS.items()}
    plys = {
        word: accept(rename(FORMS[word][:240] + ".ply", "scene.ply"), slow=word not in FEW) for word in list(FORMS)[:5]
    }
    photos = {word: accept(rename_photos(form)) for word, form in OF_PHOTOS.items()}
    return {
        **{f"a folder named with {word}": damage for word, damage in folders.items()},
        **{f"a .ply named with {word}": damage for word, damage in plys.items()},
        **{f"photos named with {word}": damage for word, damage in photos.items()},
    }


def of_things() -> dict[str, Damage]:
    """Return damages by a pipe, a link to itself, a ring of links and a folder in the place of each file."""
    damages = {}
    for thing, make in {"link to itself": link_to_itself, "pipe": make_pipe}.items():
        damages |= {
            f"scene.ply as a {thing}": refuse(replace_with("scene.ply", make), place="scene.ply"),
            f"transforms.json as a {thing}": allow(replace_with("transforms.json", make), slow=make is link_to_itself),
            f"images as a {thing}": allow(replace_with("images", make)),
            f"images/view_000.png as a {thing}": refuse(
                replace_with("images/view_000.png", make), place="view_000.png"
            ),
        }
        for option, name in (
            ("--cameras", "c.json"), ("--cameras", "c.npz"), ("--cameras", "c.txt"), ("--images", "i"),
        ):  # fmt: skip
            change = add_arguments(
                option, f"{{}}/{name}", make=lambda folder, make=make, name=name: make(folder / name)
            )
            damages[f"{option} {name} as a {thing}"] = refuse(change, place=name)
        change = add_arguments("-o", "{}/out.ply", make=lambda folder, make=make: make(folder / "out.ply"))
        damages[f"the output as a {thing}"] = Damage(change, (READ, USAGE, REFUSED))
    for name in ("scene.ply", "transforms.json", "images", "images/view_000.png"):
        damages[f"{name} as a ring of links"] = allow(replace_with(name, link_in_ring), slow=name == "transforms.json")
        damages[f"{name} as a folder"] = allow(replace_with(name, os.mkdir), slow=name == "transforms.json")
    return damages


def of_arguments() -> dict[str, Damage]:
    return {
        "views as files of their own": accept(split_in_parts(lambda path: None)),
        "one of the views' files as a pipe": refuse(split_in_parts(make_pipe), place="view_002.ply"),
        "all files as links": accept(add_arguments(make=link_all)),
        "images as a folder that holds itself": allow(replace_with("images", make_endless)),
        "a folder that holds itself among the images": accept(
            add_arguments(make=lambda folder: make_endless(folder / "images" / "more"))
        ),
        "a path of 2,000 letters": accept(move_deep),
        "500 empty images beside the photos": accept(add_arguments(make=add_images), slow=True),
        "no scene.ply in the folder": refuse(
            add_arguments(make=lambda folder: remove(folder / "scene.ply")), place="scene", other_kind=True
        ),
        "an output inside scene.ply": refuse(add_arguments("-o", "{}/scene.ply/a.ply"), place="a.ply"),
        "an output inside transforms.json": refuse(add_arguments("-o", "{}/transforms.json/a.ply"), place="a.ply"),
        "the device /dev/zero as the scene": refuse(lambda folder: ["/dev/zero"], place="/dev/zero"),
        "/dev/null as the scene": refuse(lambda folder: ["/dev/null"], place="/dev/null"),
        "the device /dev/zero as cameras": refuse(add_arguments("--cameras", "/dev/zero"), place="/dev/zero"),
        "the device /dev/zero as images": refuse(add_arguments("--images", "/dev/zero"), place="/dev/zero"),
        "scene.ply as cameras": refuse(add_arguments("--cameras", "{}/scene.ply"), place="scene.ply", other_kind=True),
        "a folder's name of 5,000 letters": refuse(lambda folder: [folder / ("x" * 5000) / "a.ply"], place="a.ply"),
    }


ALL = of_names() | of_things() | of_arguments()
# Who reads a pipe or a device waits for ever: processes within limits alone try that
ENDLESS = leave_to_sweep({name: damage for name, damage in ALL.items() if "pipe" in name or "device" in name})
DAMAGES = {"scene": ALL | ENDLESS}
