"""Packed scenes and states that promise more than they have, contradict themselves, or are 1 TB."""

from __future__ import annotations

import gzip
import io
import json
import struct
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from .case import EITHER, READ, Case, Spoil, add_bomb, sparse

LOSSLESS = (cv2.IMWRITE_WEBP_QUALITY, 101)
BOX = {"min": [-9, -9, -9], "max": [9, 9, 9]}


def alone(folder: Path) -> Path:
    """An empty folder, as none of the scene's cameras are those of these Gaussians."""
    (folder / "alone").mkdir()
    return folder / "alone"


def webp(side: int, value: int, *settings: int) -> bytes:
    """A picture of one colour with alpha: a kilobyte, however large it is."""
    return cv2.imencode(".webp", np.full((side, side, 4), value, np.uint8), settings or LOSSLESS)[1].tobytes()


def sog_files(count: int, bands: int) -> dict[str, bytes]:
    """The files of equal Gaussians, ``meta.json`` the last."""
    side = int(np.ceil(count**0.5))
    names = {"means": ["a.webp", "a.webp"], "scales": ["a.webp"], "quats": ["b.webp"], "sh0": ["a.webp"]}
    codes = [index / 256 for index in range(256)]
    meta: dict[str, Any] = {key: {"files": files, "codebook": codes} for key, files in names.items()}
    meta["means"] |= {"mins": [0, 0, 0], "maxs": [1, 1, 1]}
    files = {"a.webp": webp(side, 99), "b.webp": webp(side, 252)}
    if bands:
        meta["shN"] = {"count": 64, "bands": bands, "codebook": codes, "files": ["c.webp", "d.webp"]}
        files["c.webp"] = cv2.imencode(".webp", np.zeros((1, 64 * 15, 3), np.uint8), LOSSLESS)[1].tobytes()
        files["d.webp"] = webp(side, 0)
    return files | {"meta.json": json.dumps({"version": 2, "count": count} | meta).encode()}


def packed(files: dict[str, bytes]) -> bytes:
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    return content.getvalue()


def sog(
    change: Callable[[dict[str, Any], dict[str, bytes]], object] = lambda meta, files: None,
    count: int = 900,
    bands: int = 0,
) -> Spoil:
    def spoil(folder: Path) -> Sequence[object]:
        files = sog_files(count, bands)
        meta = json.loads(files.pop("meta.json"))
        change(meta, files)
        path = alone(folder) / "a.sog"
        path.write_bytes(packed(files | {"meta.json": json.dumps(meta).encode()}))
        return [path]

    return spoil


def sog_bomb(method: int) -> Spoil:
    """A ``meta.json`` that unpacks to far more than the directory promises."""

    def spoil(folder: Path) -> Sequence[object]:
        path = alone(folder) / "a.sog"
        add_bomb(path, "meta.json", method)
        return [path]

    return spoil


def spz(count: int, degree: int) -> Spoil:
    """Equal Gaussians of that degree, which pack a thousandfold."""

    def spoil(folder: Path) -> Sequence[object]:
        header = struct.pack("<3I4B", 0x5053474E, 3, count, degree, 12, 0, 0)
        content = bytes(count * (17 + 3 * (degree + 1) ** 2))
        path = alone(folder) / "a.spz"
        path.write_bytes(gzip.compress(header + content, 1))
        return [path]

    return spoil


def enlarged(name: str, start: bytes = b"") -> Spoil:
    def spoil(folder: Path) -> Sequence[object]:
        path = alone(folder) / name
        sparse(path, 2**40, start)
        return [path]

    return spoil


def leaf(*files: int, count: int = 900) -> dict[str, Any]:
    children = [{"bound": BOX, "lods": {"0": {"file": file, "offset": 0, "count": count}}} for file in files]
    return {"bound": BOX, "children": children}


def index(count: int = 900, chunks: int = 1, bands: int = 0, **changes: Any) -> Spoil:
    """An index of equal chunks, whose entries are changed."""

    def spoil(folder: Path) -> Sequence[object]:
        names = [f"{number}/meta.json" for number in range(chunks)]
        tree = leaf(*range(chunks), count=count)
        document = {"version": 1, "lodLevels": 1, "filenames": names, "tree": tree} | changes
        path, files = alone(folder) / "lod-meta.json", sog_files(count, bands)
        path.write_text(json.dumps(document))
        for name in names:
            (path.parent / name).parent.mkdir()
            for file, data in files.items():
                (path.parent / name).with_name(file).write_bytes(data)
        return [path]

    return spoil


def linked(folder: Path) -> Sequence[object] | None:
    """Two chunks that are one by a link."""
    arguments = index(filenames=["0/meta.json", "1/meta.json"], tree=leaf(0, 1))(folder)
    (folder / "alone" / "1").symlink_to("0")
    return arguments


def _cases() -> dict[str, Case]:
    many = [f"{number}/meta.json" for number in range(100_000)]
    huge = {"bound": {"min": [10**400] * 3, "max": [10**400] * 3}, "children": []}
    return {
        "sog: as it is": Case(sog(bands=3), READ),
        "sog: count of 400 digits": Case(sog(lambda meta, files: meta.update(count=10**400))),
        "sog: meta.json of bzip2": Case(sog_bomb(zipfile.ZIP_BZIP2), says=("meta.json", "method 12")),
        "sog: meta.json that promises less": Case(sog_bomb(zipfile.ZIP_DEFLATED)),
        "sog: a million equal Gaussians": Case(sog(count=1_000_000, bands=3)),
        "spz: half a million of degree 4": Case(spz(500_000, 4)),
        "spz: 1 TB of zeros": Case(enlarged("a.spz"), named="a.spz"),
        "spz: 1 TB after a header": Case(enlarged("a.spz", gzip.compress(bytes(9), 1)), named="a.spz"),
        "splat: 1 TB of zeros": Case(enlarged("a.splat"), named="a.splat"),
        "gsm: 1 TB of zeros": Case(enlarged("a.gsm"), says=("header",)),
        "gsm: 1 TB after a header": Case(enlarged("a.gsm", struct.pack("<Q", 2) + b"{}"), named="a.gsm"),
        "lod: as it is": Case(index(chunks=2), READ),
        "lod: 100,000 names": Case(index(filenames=many), READ),
        "lod: a chunk by two names": Case(linked),
        "lod: many chunks of equal Gaussians": Case(index(180_000, 4, 3)),
        "lod: a box of huge integers": Case(index(tree=huge), EITHER),
    }


CASES = _cases()
