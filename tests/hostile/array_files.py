"""``.npz`` files: objects that would run code, bombs, shapes and types that lie."""

from __future__ import annotations

import io
import os
import pickle
import struct
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from gsmerge.kernels.matrices import invert

from .case import (
    EITHER,
    HEIGHT,
    READ,
    VIEWS,
    WIDTH,
    Case,
    Spoil,
    add_bomb,
    cameras_of,
    names,
    sparse,
    without_transforms,
)

MARKER = "executed"
Arrays = dict[str, Any]


class Payload:
    """Makes a folder when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = str(path)

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (self.path,)


def arrays_of(folder: Path, kind: str) -> Arrays:
    import cv2

    c2w, K = cameras_of(folder)
    images = np.stack([cv2.imread(str(folder / "images" / f"{name}.png"))[..., ::-1] for name in names()])
    Ks = np.tile(K, (VIEWS, 1, 1))
    if kind == "views.npz":
        return {"c2w": c2w, "K": Ks, "images": images}
    return {
        "extrinsics": invert(c2w)[:, :3],
        "intrinsics": Ks,
        "image": images,
        "depth": np.ones((VIEWS, HEIGHT, WIDTH), np.float32),
    }


def saved(kind: str, change: Callable[[Arrays, Path], Any]) -> Spoil:
    def spoil(folder: Path) -> None:
        arrays = arrays_of(folder, kind)
        (folder / "transforms.json").unlink()
        change(arrays, folder)
        np.savez(folder / kind, **{name: value for name, value in arrays.items() if value is not None})

    return spoil


def member(value: Any, dtype: str | None = None, shape: tuple[int, ...] | None = None) -> bytes:
    """An ``.npy`` whose header may tell another type or shape than its bytes have."""
    array = np.asarray(value)
    descr = dtype or np.lib.format.dtype_to_descr(array.dtype)
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        stream, {"descr": descr, "fortran_order": False, "shape": array.shape if shape is None else shape}
    )
    return stream.getvalue() + array.tobytes()


def zipped(kind: str, name: str, make: Callable[[Any], bytes]) -> Spoil:
    """A good file with one member replaced by other bytes."""

    def spoil(folder: Path) -> None:
        arrays = arrays_of(folder, kind)
        (folder / "transforms.json").unlink()
        with zipfile.ZipFile(folder / kind, "w", zipfile.ZIP_DEFLATED) as file:
            for key, value in arrays.items():
                file.writestr(f"{key}.npy", make(value) if key == name else member(value))

    return spoil


def bytes_of(kind: str, change: Callable[[bytes], bytes]) -> Spoil:
    def spoil(folder: Path) -> None:
        saved(kind, lambda arrays, folder: None)(folder)
        path = folder / kind
        path.write_bytes(change(path.read_bytes()))

    return spoil


def with_bomb(kind: str, name: str, method: int) -> Spoil:
    """A file with a member that unpacks to far more than it promises; an array of that name is replaced."""

    def spoil(folder: Path) -> None:
        saved(kind, lambda arrays, _: arrays.pop(name, None))(folder)
        add_bomb(folder / kind, f"{name}.npy", method, member(np.zeros((VIEWS, 4, 4))))

    return spoil


def bomb(size: int, shape: tuple[int, ...]) -> Callable[[Any], bytes]:
    head = member(np.zeros(0, np.uint8), "|u1", shape)
    return lambda _: head + bytes(size)


def pickled(arrays: Arrays, folder: Path, name: str) -> None:
    arrays[name] = np.array([Payload(folder / MARKER)], dtype=object)


def raw_pickle(folder: Path) -> None:
    without_transforms(folder)
    (folder / "views.npz").write_bytes(pickle.dumps(Payload(folder / MARKER)))


def member_pickle(folder: Path) -> None:
    without_transforms(folder)
    with zipfile.ZipFile(folder / "views.npz", "w") as file:
        for name in ("c2w.npy", "K.npy", "images.npy", "c2w", "K", "images"):
            file.writestr(name, pickle.dumps(Payload(folder / MARKER)))


def _of_kind(kind: str, poses: str, Ks: str, images: str) -> dict[str, Case]:
    cases = {
        "as it is": Case(saved(kind, lambda arrays, folder: None), READ),
        "poses as an object": Case(saved(kind, lambda arrays, folder: pickled(arrays, folder, poses))),
        "poses of nested brackets": Case(zipped(kind, poses, lambda _: brackets(9000))),
        "20,000 poses": Case(saved(kind, lambda a, _: a.update({poses: np.tile(np.eye(4), (20_000, 1, 1)), Ks: None}))),
        "a bomb of poses": Case(zipped(kind, poses, bomb(2**27, (2**27,)))),
        "a bomb of images": Case(zipped(kind, images, bomb(2**27, (VIEWS, 3800, 3800, 3)))),
        "a bomb of floats": Case(zipped(kind, images, lambda _: member(np.zeros((VIEWS, 1400, 1400, 3), "<f4")))),
        "a header of 60 MB": Case(zipped(kind, images, lambda _: long_header(60 << 20))),
        "encrypted": Case(bytes_of(kind, lambda data: patched(data, 6, 8, lambda flags: flags | 1)), EITHER),
        "an unknown compression": Case(bytes_of(kind, lambda data: patched(data, 8, 10, lambda _: 99)), EITHER),
        "the directory alone": Case(bytes_of(kind, lambda data: data[data.index(b"PK\x01\x02") :])),
        "8 GB of zeros": Case(lambda folder: _zeros(folder, kind)),
        "poses of bzip2": Case(with_bomb(kind, poses, zipfile.ZIP_BZIP2), says=(f"{poses}.npy", "method 12")),
        "poses of LZMA": Case(with_bomb(kind, poses, zipfile.ZIP_LZMA), says=(f"{poses}.npy", "method 14")),
        "poses that promise less": Case(with_bomb(kind, poses, zipfile.ZIP_DEFLATED), EITHER),
        "bzip2 that nothing reads": Case(with_bomb(kind, "more", zipfile.ZIP_BZIP2), says=("more.npy", "method 12")),
    }
    for shape in ((2**40, 2**40), (VIEWS, 2**31, 2**31), (2**62,), (-1, 3)):
        cases[f"poses said to be {shape}"] = Case(zipped(kind, poses, lambda v, s=shape: member(v, shape=s)))
    for dtype in ("|O", "<U1000000000", "|V1000000000"):
        cases[f"poses said to be of {dtype}"] = Case(zipped(kind, poses, lambda v, d=dtype: member(v, d)), EITHER)
    return {f"{kind}: {word}": replace(case, named=kind) for word, case in cases.items()}


def long_header(size: int) -> bytes:
    return b"\x93NUMPY\2\0" + struct.pack("<I", size) + bytes(size)


def brackets(depth: int) -> bytes:
    head = b"{'descr': " + b"(" * depth + b"'<f8'" + b")" * depth + b"}\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head


def _zeros(folder: Path, kind: str) -> None:
    without_transforms(folder)
    sparse(folder / kind, 2**33)


def patched(data: bytes, in_member: int, in_directory: int, change: Callable[[int], int]) -> bytes:
    """Another number of 16 bits at these places of every member's head and of its line in the directory."""
    out = bytearray(data)
    for mark, offset in ((b"PK\x03\x04", in_member), (b"PK\x01\x02", in_directory)):
        at = data.find(mark)
        while at >= 0:
            struct.pack_into("<H", out, at + offset, change(*struct.unpack_from("<H", out, at + offset)))
            at = data.find(mark, at + 4)
    return bytes(out)


CASES = {
    **_of_kind("views.npz", "c2w", "K", "images"),
    **_of_kind("results.npz", "extrinsics", "intrinsics", "image"),
    "pickle named views.npz": Case(raw_pickle),
    "pickles in an archive": Case(member_pickle),
    "views.npz: an order of objects": Case(saved("views.npz", lambda a, folder: pickled(a, folder, "order"))),
}
