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

from .case import EITHER, HEIGHT, READ, VIEWS, WIDTH, Case, Spoil, cameras_of, names, sparse, without_transforms

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
        "extrinsics": np.linalg.inv(c2w)[:, :3],
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


def zipped(kind: str, name: str, make: Callable[[Any], bytes], method: int = zipfile.ZIP_DEFLATED) -> Spoil:
    """A good file with one member replaced by other bytes."""

    def spoil(folder: Path) -> None:
        arrays = arrays_of(folder, kind)
        (folder / "transforms.json").unlink()
        with zipfile.ZipFile(folder / kind, "w", method) as file:
            for key, value in arrays.items():
                file.writestr(f"{key}.npy", make(value) if key == name else member(value))

    return spoil


def bytes_of(kind: str, change: Callable[[bytes], bytes]) -> Spoil:
    def spoil(folder: Path) -> None:
        saved(kind, lambda arrays, folder: None)(folder)
        path = folder / kind
        path.write_bytes(change(path.read_bytes()))

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


def scaled(name: str, factor: float) -> Callable[[Arrays, Path], None]:
    def change(arrays: Arrays, _: Path) -> None:
        with np.errstate(all="ignore"):
            arrays[name] = arrays[name] * factor

    return change


def replaced(name: str, value: Any) -> Callable[[Arrays, Path], None]:
    return lambda arrays, _: arrays.update({name: value})


def as_type(name: str, dtype: str) -> Callable[[Arrays, Path], None]:
    return lambda arrays, _: arrays.update({name: arrays[name].astype(dtype)})


def _of_kind(kind: str, poses: str, Ks: str, images: str) -> dict[str, Case]:
    cases = {"as it is": Case(saved(kind, lambda arrays, folder: None), READ)}
    for name in (poses, Ks, images) if kind == "views.npz" else (poses,):
        cases[f"{name} missing"] = Case(saved(kind, replaced(name, None)), EITHER)
        cases[f"{name} as an object"] = Case(saved(kind, lambda a, folder, name=name: pickled(a, folder, name)))
        for dtype in ("complex64", "U8", "datetime64[s]", "bool"):
            change = replaced(name, np.zeros((VIEWS, 3, 3), dtype))
            cases[f"{name} as {dtype}"] = Case(saved(kind, change))
        cases[f"{name} empty"] = Case(saved(kind, replaced(name, np.zeros((0, 3, 3)))))
        cases[f"{name} as one number"] = Case(saved(kind, replaced(name, np.array(1.0))))
        for shape in ((2**40, 2**40), (VIEWS, 2**31, 2**31), (2**62,), (-1, 3), (0,)):
            cases[f"{name} said to be {shape}"] = Case(zipped(kind, name, lambda v, s=shape: member(v, shape=s)))
        for dtype in ("|O", "<U1000000000", "|V1000000000", "<f16", "garbage"):
            cases[f"{name} said to be of {dtype}"] = Case(zipped(kind, name, lambda v, d=dtype: member(v, d)), EITHER)
        cases[f"{name} of nested brackets"] = Case(zipped(kind, name, lambda _: brackets(9000)))
        cases[f"{name} of half a header"] = Case(zipped(kind, name, lambda v: member(v)[:20]))
        cases[f"{name} of half its bytes"] = Case(zipped(kind, name, lambda v: member(v)[: len(member(v)) // 2]))
        for factor in (np.nan, np.inf, 1e300, 0.0):
            cases[f"{name} times {factor}"] = Case(saved(kind, scaled(name, factor)), EITHER)
    cases["images of no pixels"] = Case(saved(kind, replaced(images, np.zeros((VIEWS, 0, 0, 3), np.uint8))))
    cases["a bomb of images"] = Case(zipped(kind, images, bomb(2**27, (VIEWS, 3800, 3800, 3))))
    cases["a bomb of floats"] = Case(zipped(kind, images, lambda _: member(np.zeros((VIEWS, 1400, 1400, 3), "<f4"))))
    cases["a header of 60 MB"] = Case(zipped(kind, images, lambda _: long_header(60 << 20)))
    cases["20,000 poses"] = Case(
        saved(kind, lambda a, _: a.update({poses: np.tile(np.eye(4), (20_000, 1, 1)), Ks: None}))
    )
    cases["a bomb of poses"] = Case(zipped(kind, poses, bomb(2**27, (2**27,))))
    for method in ("ZIP_BZIP2", "ZIP_LZMA"):
        cases[method] = Case(zipped(kind, images, member, getattr(zipfile, method)), EITHER)
    return {f"{kind}: {word}": replace(case, named=kind) for word, case in cases.items()}


def long_header(size: int) -> bytes:
    return b"\x93NUMPY\2\0" + struct.pack("<I", size) + bytes(size)


def brackets(depth: int) -> bytes:
    head = b"{'descr': " + b"(" * depth + b"'<f8'" + b")" * depth + b"}\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head


def _archives(kind: str) -> dict[str, Case]:
    def damage(data: bytes) -> bytes:
        middle = len(data) // 2
        return data[:middle] + bytes(255 - byte for byte in data[middle : middle + 64]) + data[middle + 64 :]

    def method(number: int) -> Callable[[bytes], bytes]:
        """Another method of compression in the directory."""
        return lambda data: patched(data, 8, 10, lambda _: number)

    cases = {
        "nothing": lambda _: b"", "text": lambda _: b"text", "half": lambda data: data[: len(data) // 2],
        "all but the last byte": lambda data: data[:-1], "damaged in the middle": damage,
        "an unknown compression": method(99), "deflate that is none": method(8),
        "encrypted": lambda data: patched(data, 6, 8, lambda flags: flags | 1),
        "the directory alone": lambda data: data[data.index(b"PK\x01\x02") :],
        "a single array": lambda _: member(np.zeros(3)),
    }  # fmt: skip
    out = {f"{kind}: {word}": Case(bytes_of(kind, change), EITHER, kind) for word, change in cases.items()}
    out[f"{kind}: 8 GB of zeros"] = Case(lambda folder: _zeros(folder, kind), (3,), kind)
    return out


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
    **_archives("views.npz"),
    **_archives("results.npz"),
    "pickle named views.npz": Case(raw_pickle),
    "pickles in an archive": Case(member_pickle),
}
for value in (np.nan, np.inf, -1.0, 0.0):
    CASES[f"results.npz: depth {value}, no images"] = Case(
        saved("results.npz", lambda a, _, v=value: a.update(image=None, depth=np.full_like(a["depth"], v))), EITHER
    )
CASES["results.npz: depth of text"] = Case(saved("results.npz", as_type("depth", "U3")), EITHER)
CASES["views.npz: an order that is none"] = Case(saved("views.npz", replaced("order", np.array("a\nb" * 100))))
CASES["views.npz: an order of objects"] = Case(saved("views.npz", lambda a, folder: pickled(a, folder, "order")))
