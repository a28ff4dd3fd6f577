"""Damages of ``.npz`` files hold code, bombs, shapes and types that lie, and arrays that make no sense."""

from __future__ import annotations

import io
import os
import pickle
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from .case import Change, Damage, accept, allow, refuse
from .changes import add_bomb, edit_bytes, edit_member, pack_members, read_members, write_file
from .sounds import TINY

MARKER = "executed"
VIEWS = len(TINY.c2w)
Arrays = dict[str, Any]


class Payload:
    """Makes a folder when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = str(path)

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (self.path,)


def npy(value: Any, dtype: str | None = None, shape: tuple[int, ...] | None = None) -> bytes:
    """Return an ``.npy`` whose header may tell another type or shape than its bytes have."""
    array = np.asarray(value)
    descr = dtype or np.lib.format.dtype_to_descr(array.dtype)
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        stream, {"descr": descr, "fortran_order": False, "shape": array.shape if shape is None else shape}
    )
    return stream.getvalue() + array.tobytes()


def load_array(data: bytes) -> np.ndarray:
    array: np.ndarray = np.load(io.BytesIO(data))
    return array


def put_array(name: str, value: Any) -> Change:
    """Put another array, or bytes, into the file; leave it out for None."""
    data = value if isinstance(value, bytes) else npy(value)

    def change(contents: bytes) -> bytes:
        others = {key: part for key, part in read_members(contents).items() if key != f"{name}.npy"}
        return pack_members(others if value is None else others | {f"{name}.npy": data}, zipfile.ZIP_DEFLATED)

    return edit_bytes(change)


def edit_array(name: str, change: Callable[[np.ndarray], np.ndarray]) -> Change:
    """Change the values of an array."""
    return edit_member(f"{name}.npy", lambda data: npy(change(load_array(data))))


def put_objects(name: str) -> Change:
    """Put objects into the file, which make a folder when they are read."""

    def change(path: Path) -> None:
        stream = io.BytesIO()
        np.save(stream, np.array([Payload(path.parent / MARKER)], dtype=object), allow_pickle=True)
        put_array(name, stream.getvalue())(path)

    return change


def write_pickles(path: Path) -> None:
    """Write an archive of pickles by the arrays' names."""
    data = pickle.dumps(Payload(path.parent / MARKER))
    names = {name.removesuffix(end) for name in read_members(path.read_bytes()) for end in ("", ".npy")}
    write_file(path, pack_members(dict.fromkeys(names | {f"{name}.npy" for name in names}, data)))


def bomb_of(size: int, shape: tuple[int, ...]) -> bytes:
    return npy(np.zeros(0, np.uint8), "|u1", shape) + bytes(size)


def brackets(depth: int) -> bytes:
    head = b"{'descr': " + b"(" * depth + b"'<f8'" + b")" * depth + b"}\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head


def of_cameras(poses: str, Ks: str, images: str) -> dict[str, Damage]:
    """Return damages of a file of these arrays, which has the cameras of a scene."""
    damages = {
        "the same arrays packed again": accept(edit_bytes(lambda data: pack_members(read_members(data)))),
        "poses as objects that would run code": refuse(put_objects(poses)),
        "a pickle that would run code": refuse(
            lambda path: write_file(path, pickle.dumps(Payload(path.parent / MARKER)))),
        "an archive of pickles that would run code": refuse(write_pickles),
        "a type of poses of 9,000 nested brackets": refuse(put_array(poses, brackets(9000))),
        "20,000 poses": refuse(put_array(poses, np.tile(np.eye(4), (20_000, 1, 1))), slow=True),
        "128 MB of zeros as poses": refuse(put_array(poses, bomb_of(2**27, (2**27,))), slow=True),
        "zeros as photos of 3800 x 3800": refuse(put_array(images, bomb_of(2**27, (VIEWS, 3800, 3800, 3))), slow=True),
        "zeros as photos of 1400 x 1400 floats": refuse(put_array(images, np.zeros((VIEWS, 1400, 1400, 3), "<f4")),
                                                        slow=True),
        "photos with a header of 60 MB": refuse(
            put_array(images, b"\x93NUMPY\2\0" + struct.pack("<I", 60 << 20) + bytes(60 << 20)), slow=True),
        "poses that unpack to more than they claim": allow(
            add_bomb(f"{poses}.npy", zipfile.ZIP_DEFLATED, npy(np.zeros((VIEWS, 4, 4)))), slow=True),
    }  # fmt: skip
    start = npy(np.zeros((VIEWS, 4, 4)))
    for name, method, number in ((poses, "BZIP2", 12), (poses, "LZMA", 14), ("more", "BZIP2", 12)):
        change = add_bomb(f"{name}.npy", getattr(zipfile, f"ZIP_{method}"), start)
        damages[f"{name} packed by {method}"] = refuse(change, f"{name}.npy", f"method {number}", slow=True)
    for shape in ((2**40, 2**40), (VIEWS, 2**31, 2**31), (2**62,), (-1, 3)):
        damages[f"poses that claim the shape {shape}"] = refuse(edit_member(f"{poses}.npy", relabel(shape=shape)))
    for dtype in ("|O", "<U1000000000", "|V1000000000"):
        damages[f"poses that claim the type {dtype}"] = allow(edit_member(f"{poses}.npy", relabel(dtype=dtype)))
    return damages


def relabel(**said: Any) -> Callable[[bytes], bytes]:
    return lambda data: npy(load_array(data), **said)


DAMAGES = {
    "views.npz": {
        **of_cameras("c2w", "K", "images"),
        "an order as objects that would run code": refuse(put_objects("order")),
        "an unknown order": refuse(put_array("order", np.array("magic")), "'order'", "magic"),
        "intrinsics of four dimensions": refuse(put_array("K", np.ones((4, 3, 3, 1))), "(4, 3, 3, 1)"),
    },
    "results.npz": {
        **of_cameras("extrinsics", "intrinsics", "image"),
        "intrinsics of zeros": refuse(edit_array("intrinsics", np.zeros_like), "focal"),
        "intrinsics of ones": refuse(edit_array("intrinsics", np.ones_like), "0 0 1"),
        "poses of zeros": refuse(edit_array("extrinsics", np.zeros_like), "orthonormal"),
    },
}
