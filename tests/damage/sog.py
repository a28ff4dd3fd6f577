"""Damages of ``.sog`` and Streamed SOG promise more than the pictures have, or lead out of their folder."""

from __future__ import annotations

import json
import shutil
import zipfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from .case import Change, Damage, accept, allow, refuse
from .changes import (
    add_bomb,
    change_beside,
    cut,
    drop_json,
    drop_member,
    edit_json,
    edit_member,
    pack_members,
    set_json,
    write_file,
)

BOX = {"min": [-9, -9, -9], "max": [9, 9, 9]}
HUGE = 10**400


def webp(width: int, height: int, value: int = 0, quality: int = 101, channels: int = 4) -> bytes:
    """Return a picture of one colour: a kilobyte, however large it is."""
    picture = np.full((height, width, channels), value, np.uint8)
    return cv2.imencode(".webp", picture, (cv2.IMWRITE_WEBP_QUALITY, quality))[1].tobytes()


def equal_files(count: int, bands: int) -> dict[str, bytes]:
    """Return the files of equal Gaussians."""
    side = int(np.ceil(count**0.5))
    names = {"means": ["a.webp", "a.webp"], "scales": ["a.webp"], "quats": ["b.webp"], "sh0": ["a.webp"]}
    codes = [index / 256 for index in range(256)]
    meta: dict[str, Any] = {key: {"files": files, "codebook": codes} for key, files in names.items()}
    meta["means"] |= {"mins": [0, 0, 0], "maxs": [1, 1, 1]}
    files = {"a.webp": webp(side, side, 99), "b.webp": webp(side, side, 252)}
    if bands:
        meta["shN"] = {"count": 64, "bands": bands, "codebook": codes, "files": ["c.webp", "d.webp"]}
        files |= {"c.webp": webp(64 * 15, 1, channels=3), "d.webp": webp(side, side)}
    return files | {"meta.json": json.dumps({"version": 2, "count": count} | meta).encode()}


def write_equal(count: int, bands: int) -> Change:
    return lambda path: write_file(path, pack_members(equal_files(count, bands)))


def replace_picture(name: str, *size: int, **settings: int) -> Change:
    """Put another picture in the place of a texture."""
    return edit_member(name, lambda _: webp(*size, **settings))


def swap_pictures(path: Path) -> None:
    """Put colours in the place of rotations, whose mode they lack."""
    with zipfile.ZipFile(path) as archive:
        colors = archive.read("sh0.webp")
    edit_member("quats.webp", lambda _: colors)(path)


def of_sog() -> dict[str, Damage]:
    return {
        "no version": refuse(drop_json("version"), "version 2"),
        "a version that is a list": refuse(set_json("version", value=[2]), "version 2"),
        "a count of 10^18": refuse(set_json("count", value=10**18), "count"),
        "a count of 400 digits": refuse(set_json("count", value=HUGE), "count"),
        "a count beyond the pixels": refuse(set_json("count", value=17), "4 x 4", 17),
        "a count in words": refuse(set_json("count", value="three\nlines"), "count"),
        "a million equal Gaussians": refuse(write_equal(1_000_000, 3), "126 MB"),
        "900 equal Gaussians": accept(write_equal(900, 3)),
        "a texture missing": refuse(drop_member("quats.webp")),
        "a texture outside the archive": refuse(
            set_json("quats", "files", value=["../../etc/passwd"]), "../../etc/passwd"
        ),
        "a codebook of one code": refuse(set_json("sh0", "codebook", value=[0.5]), 256),
        "a minimum of 400 digits": refuse(set_json("means", "mins", value=[HUGE] * 3), "too large"),
        "a minimum of NaN": refuse(set_json("means", "mins", value=[float("nan")] * 3), "NaN"),
        "a texture compressed with losses": refuse(replace_picture("scales.webp", 4, 4, quality=50), "without loss"),
        "a texture of a million pixels": refuse(
            replace_picture("scales.webp", 1024, 1024), "scales.webp", "1024 x 1024"
        ),
        "a texture cut off after its header": refuse(
            edit_member("scales.webp", lambda data: data[:25]), "scales.webp", "damaged"
        ),
        "colours in the place of rotations": refuse(swap_pictures, "mode"),
        "a palette of 10^9 colours": refuse(
            set_json("shN", value={"count": 10**9, "bands": 3, "files": ["a", "b"]}), 65536
        ),
        "meta.json packed by bzip2": refuse(
            add_bomb("meta.json", zipfile.ZIP_BZIP2), "'meta.json'", "method 12", place="a.sog", slow=True
        ),
        "meta.json that unpacks to more than it claims": refuse(add_bomb("meta.json", zipfile.ZIP_DEFLATED), slow=True),
    }


# Levels: an index of chunks, each a folder of a meta.json and its textures


def leaf(*files: int, count: int = 900) -> dict[str, Any]:
    children = [{"bound": BOX, "lods": {"0": {"file": file, "offset": 0, "count": count}}} for file in files]
    return {"bound": BOX, "children": children}


def write_chunks(count: int = 900, chunks: int = 1, bands: int = 0, **changes: Any) -> Change:
    """Write an index of equal chunks, whose entries are changed."""

    def change(path: Path) -> None:
        names = [f"{number}/meta.json" for number in range(chunks)]
        document = {"version": 1, "lodLevels": 1, "filenames": names, "tree": leaf(*range(chunks), count=count)}
        write_file(path, json.dumps(document | changes))
        for name in names:
            chunk = (path.parent / name).parent
            chunk.mkdir()
            for file, data in equal_files(count, bands).items():
                (chunk / file).write_bytes(data)

    return change


def name_twice(path: Path) -> None:
    """Name two chunks that are one by a link."""
    write_chunks(filenames=["0/meta.json", "1/meta.json"], tree=leaf(0, 1))(path)
    (path.parent / "1").symlink_to("0")


def link_out(path: Path) -> None:
    (path.parent / "0_0").rename(path.parent.parent / "outside")
    (path.parent / "0_0").symlink_to(path.parent.parent / "outside")


def count_fewer(index: dict[str, Any]) -> None:
    """Put in a count that agrees with all of the index, and not with the chunk."""
    index["tree"]["lods"]["0"]["count"] -= 1
    index.update(count=index["count"] - 1, counts=[index["counts"][0] - 1, *index["counts"][1:]])


def forget(index: dict[str, Any]) -> None:
    """Leave out what writers before versions left out."""
    for key in ("version", "asset", "count", "counts"):
        del index[key]
    index["environment"] = None


def deepen(index: dict[str, Any]) -> None:
    for _ in range(300):
        index["tree"] = {"bound": BOX, "children": [index["tree"]]}


def add_name(name: str) -> Change:
    return edit_json(lambda index: index["filenames"].append(name))


def of_levels() -> dict[str, Damage]:
    chunk, lods = "0_0/meta.json", ("tree", "lods")
    return {
        "version 2": refuse(set_json("version", value=2), "version 1", 2),
        "a version that is a list": refuse(set_json("version", value=[]), "version 1"),
        "fewer levels than its tree": refuse(set_json("lodLevels", value=1), "level"),
        "a tree that is a list": refuse(set_json("tree", value=[])),
        "a node with both chunks and children": refuse(
            set_json("tree", "children", value=[]), "either children or lods"
        ),
        "a box whose minimum is above its maximum": refuse(
            set_json("tree", "bound", value={"min": [9, 9, 9], "max": [1, 1, 1]}), "bound"
        ),
        "a box of NaN": refuse(set_json("tree", "bound", "min", value=[float("nan")] * 3), "bound"),
        "a box of integers of 400 digits": allow(
            set_json("tree", "bound", value={"min": [HUGE] * 3, "max": [HUGE] * 3})
        ),
        "a count of 5 over a tree of 9": refuse(set_json("count", value=5), "the tree has 9"),
        "a file number beyond the list": refuse(set_json(*lods, "0", "file", value=2), "file"),
        "an offset of true": refuse(set_json(*lods, "0", "offset", value=True), "offset"),
        "a gap in a chunk's rows": refuse(set_json(*lods, "0", "offset", value=1), "runs of file 0"),
        "a level named by a word": refuse(set_json(*lods, "finest", value={}), "finest"),
        "one chunk in two levels": refuse(set_json(*lods, "1", "file", value=0), "two levels"),
        "a chunk in the folder above": refuse(add_name("../lod-meta.json"), "../lod-meta.json"),
        "a chunk in the folder above, as Windows writes it": refuse(add_name("..\\meta.json")),
        "a chunk not named meta.json": refuse(add_name("0_0/other.json"), "0_0/other.json"),
        "an environment in the folder above": refuse(set_json("environment", value="../meta.json"), "../meta.json"),
        "a chunk behind a link out of the folder": refuse(link_out, "link"),
        "one chunk by two names": refuse(name_twice, "link"),
        "a chunk missing": refuse(lambda path: shutil.rmtree(path.parent / "0_0"), place=chunk),
        "a texture missing": refuse(change_beside("0_0/quats.webp", Path.unlink), place="quats.webp"),
        "a texture of 16 million pixels": refuse(
            change_beside("0_0/scales.webp", lambda path: write_file(path, webp(4096, 4096, channels=3))),
            "4096 x 4096",
            place=chunk,
        ),
        "fewer rows than the chunk has": refuse(edit_json(count_fewer), 5, 6, place=chunk),
        "a texture outside the folder": refuse(
            change_beside(chunk, set_json("quats", "files", value=["../../etc/passwd"])),
            "../../etc/passwd",
            place=chunk,
        ),
        "a chunk's count of 10^15": refuse(change_beside(chunk, set_json("count", value=10**15)), "MB", place=chunk),
        "a chunk of version 1": refuse(change_beside(chunk, drop_json("version")), "version 2", 1, place=chunk),
        "a chunk's texture cut off halfway": refuse(
            change_beside("0_0/means_l.webp", cut(0.5)), "means_l.webp", place=chunk
        ),
        "two chunks of equal Gaussians": accept(write_chunks(chunks=2)),
        "four chunks of 180,000 equal Gaussians": refuse(write_chunks(180_000, 4, 3), slow=True),
        "100,000 names of chunks": accept(
            write_chunks(filenames=[f"{number}/meta.json" for number in range(100_000)]), slow=True
        ),
        "a tree 300 nodes deep": accept(edit_json(deepen)),
        "no version and no counts": accept(edit_json(forget)),
        "no chunks": refuse(lambda path: write_file(path, '{"version": 1, "filenames": [], "lodLevels": 1}')),
    }


DAMAGES = {"sog": of_sog(), "Streamed SOG": of_levels()}
