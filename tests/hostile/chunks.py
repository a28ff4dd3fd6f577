"""``.torch`` chunks: objects that would run code, shapes that lie, bytes that are missing."""

from __future__ import annotations

import io
import pickle
import struct
import zipfile
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from gsmerge.kernels.matrices import invert

from .array_files import MARKER, Payload
from .case import EITHER, HEIGHT, READ, VIEWS, WIDTH, Case, Spoil, names, sparse, without_transforms

NAME = "chunk.torch"
MANY = 10_000  # views, the most that are read
# Pickles of a tuple of two tuples of two, and so on: whoever hashes or prints it does not end
NESTED = b")q\0" + b"".join(b"h%c\x86q%c" % (i, i + 1) for i in range(60))
GREEDY = b"\x80\x02c__builtin__\nbytearray\n\x8a\x06\0\0\0\0\0\x01\x85R."  # a pickle of bytearray(2**40)


def entry_of(folder: Path) -> dict[str, Any]:
    """The scene as a chunk has it."""
    c2w, K = without_transforms(folder)
    head = [K[0, 0] / WIDTH, K[1, 1] / HEIGHT, K[0, 2] / WIDTH, K[1, 2] / HEIGHT, 0, 0]
    rows = np.concatenate([np.tile(head, (VIEWS, 1)), invert(c2w)[:, :3].reshape(VIEWS, 12)], 1)
    files = [cv2.imread(str(folder / "images" / f"{name}.png")) for name in names()]
    images = [torch.from_numpy(cv2.imencode(".jpg", image)[1].reshape(-1).copy()) for image in files]
    return {"key": "scene", "cameras": torch.from_numpy(rows).float(), "images": images}


def saved(change: Callable[[dict[str, Any], Path], Any]) -> Spoil:
    """What the change returns is saved; the entry itself where it returns nothing."""

    def spoil(folder: Path) -> None:
        entry = entry_of(folder)
        changed = change(entry, folder)
        torch.save([entry] if changed is None else changed, folder / NAME)

    return spoil


def replaced(key: str, value: Any) -> Callable[[dict[str, Any], Path], None]:
    return lambda entry, _: entry.update({key: value})


def bytes_of(change: Callable[[bytes], bytes]) -> Spoil:
    def spoil(folder: Path) -> None:
        saved(lambda entry, _: None)(folder)
        (folder / NAME).write_bytes(change((folder / NAME).read_bytes()))

    return spoil


def with_pickle(make: Callable[[Path, bytes], bytes], method: int = zipfile.ZIP_STORED) -> Spoil:
    """A good chunk with another structure."""

    def spoil(folder: Path) -> None:
        saved(lambda entry, _: None)(folder)
        data = (folder / NAME).read_bytes()
        with zipfile.ZipFile(io.BytesIO(data)) as source, zipfile.ZipFile(folder / NAME, "w", method) as target:
            for member in source.infolist():
                content = source.read(member)
                structure = member.filename.endswith("data.pkl")
                target.writestr(member.filename, make(folder, content) if structure else content)

    return spoil


class Call:
    """Pickles as a call of a function."""

    def __init__(self, function: Callable[..., Any], *arguments: object) -> None:
        self.function, self.arguments = function, arguments

    def __reduce__(self) -> tuple[Any, ...]:
        return self.function, self.arguments


def tensor(shape: Any, strides: Any, offset: Any = 0, *more: object) -> Call:
    """A tensor of a form that torch does not make."""
    storage = torch.zeros(VIEWS * 18)._typed_storage()
    return Call(torch._utils._rebuild_tensor_v2, storage, offset, shape, strides, False, OrderedDict(), *more)


def directory(change: Callable[[bytearray, int, int], None]) -> Spoil:
    """Another directory of the archive; ``change`` gets its bytes, and where the first line and the end begin."""

    def changed(data: bytes) -> bytes:
        out = bytearray(data)
        change(out, data.index(b"PK\1\2"), data.rindex(b"PK\6\6"))
        return bytes(out)

    return bytes_of(changed)


def many_members(folder: Path) -> None:
    without_transforms(folder)
    line, count = struct.pack("<4s6H3L5H2L", b"PK\1\2", *[0] * 16), 100_000
    end = struct.pack("<4s4H2LH", b"PK\5\6", 0, 0, 65535, 65535, count * len(line), 0, 0)
    (folder / NAME).write_bytes(line * count + end)


def two_structures(folder: Path) -> None:
    saved(lambda entry, _: None)(folder)
    with zipfile.ZipFile(folder / NAME, "a") as archive:
        archive.writestr("other/data.pkl", b"\x80\x02N.")


def zeros(folder: Path) -> None:
    without_transforms(folder)
    sparse(folder / NAME, 2**33)


def older_form(folder: Path) -> None:
    torch.save([entry_of(folder)], folder / NAME, _use_new_zipfile_serialization=False)


def bare_pickle(folder: Path) -> None:
    without_transforms(folder)
    (folder / NAME).write_bytes(pickle.dumps(Payload(folder / MARKER)))


def renamed(_: Path, content: bytes) -> bytes:
    """A structure that sets the fields of a tensor."""
    end = content.index(b"tq\x0fR") + 4
    return content[:end] + b"}X\x04\0\0\0pathX\x01\0\0\0/sb" + content[end:]


def moved(_: Path, content: bytes) -> bytes:
    """A structure whose first tensor begins behind its storage."""
    assert b"K\0K\x03K\x12\x86" in content
    return content.replace(b"K\0K\x03K\x12\x86", b"J\xff\xff\xff\0K\x03K\x12\x86")


def two_sizes(entry: dict[str, Any], _: Path) -> None:
    lower = cv2.imencode(".jpg", np.zeros((HEIGHT - 2, WIDTH, 3), np.uint8))[1]
    entry["images"][1] = torch.from_numpy(lower.reshape(-1).copy())


def wide_photos(entry: dict[str, Any], _: Path) -> None:
    """Photos of 150 MB in 0.6."""
    data = cv2.imencode(".jpg", np.zeros((4096, 4096, 3), np.uint8))[1].reshape(-1)
    entry["images"] = [torch.from_numpy(data.copy()) for _ in range(VIEWS)]


def many_scans(entry: dict[str, Any], _: Path) -> None:
    """Progressive photos whose last scan, of 16 bytes, is there 40,000 times."""
    data = cv2.imencode(".jpg", np.zeros((2048, 2048), np.uint8), [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
    data = data[:-2] + data[data.rindex(b"\xff\xda") : -2] * 40_000 + data[-2:]
    entry["images"] = [torch.frombuffer(bytearray(data), dtype=torch.uint8) for _ in range(VIEWS)]


def one_photo(entry: dict[str, Any], _: Path) -> None:
    """A photo of 300 kB that has as many names as there are cameras."""
    entry.update(cameras=entry["cameras"][:1].repeat(MANY, 1), images=[torch.zeros(300_000, dtype=torch.uint8)] * MANY)


def printed_for_ever(entry: dict[str, Any], _: Path) -> list[dict[str, Any]]:
    key: list[Any] = ["a"]
    for _ in range(15):
        key = [key] * 10
    return [{**entry, "key": key}] * 2


def _shapes() -> dict[str, Case]:
    zeros, byte, shape = torch.zeros(VIEWS, 18), torch.zeros(1, dtype=torch.uint8), "[v,18], found"
    no_numbers, no_tensors, objects = "cameras of numbers", "images as tensors", "objects"
    cameras: dict[str, tuple[Any, str]] = {
        "17 columns": (zeros[:, :17].clone(), f"{shape} [3, 17]"),
        "None": (None, ""),
        "no rows": (torch.zeros(0, 18), "10000 cameras, found 0"),
        "2^40 rows": (torch.zeros(1, 18).expand(2**40, 18), "10000 cameras"),
        "integers": (zeros.int(), no_numbers),
        "bfloat16": (zeros.bfloat16(), no_numbers),
        "sparse": (zeros.to_sparse(), objects),
        "no values": (torch.empty(VIEWS, 18, device="meta"), objects),
        "NaN": (torch.full((VIEWS, 18), torch.nan), "finite"),
        "1e38": (torch.full((VIEWS, 18), 1e38), ""),
        "rows that overlap": (torch.zeros(99).as_strided((VIEWS, 18), (9, 1)), "overlapping"),
        "rows 2^40 apart": (tensor((VIEWS, 18), (2**40, 1)), "damaged"),
        "100,000 axes": (tensor((1,) * 100_000, (1,) * 100_000), objects),
        "fewer strides than axes": (tensor((VIEWS, 18), (18,)), objects),
        "a shape of text": (tensor("ab", (18, 1)), objects),
        "a start before the storage": (tensor((VIEWS, 18), (18, 1), -1), objects),
        "more about it": (tensor((VIEWS, 18), (18, 1), 0, {"neg": True}), objects),
        "a parameter of nothing": (Call(torch._utils._rebuild_parameter), objects),
        "a dictionary of pairs": (Call(OrderedDict, [("a", 1)]), objects),
        "zeros": (zeros, "orthonormal"),
    }
    images: dict[str, tuple[Any, str]] = {
        "too few": ([byte], "found 1"),
        "empty": ([byte[:0].clone()] * VIEWS, "decoded"),
        "2^40 bytes": ([byte.expand(2**40)] * VIEWS, no_tensors),
        "floats": ([torch.zeros(9)] * VIEWS, no_tensors),
        "no values": ([torch.empty(9, dtype=torch.uint8, device="meta")] * VIEWS, objects),
        "zeros": ([byte.repeat(99)] * VIEWS, "decoded"),
    }
    lists: dict[str, Any] = {
        "no scenes": [], "numbers": [1, 2], "one number": 5, "an object": {"a": 1}, "a tensor": torch.zeros(3),
    }  # fmt: skip
    cases = {
        f"{key} of {word}": Case(saved(replaced(key, value)), says=(says,))
        for key, values in {"cameras": cameras, "images": images}.items()
        for word, (value, says) in values.items()
    }
    listed = ("list",)
    cases |= {word: Case(saved(lambda *_, value=value: value), says=listed) for word, value in lists.items()}
    cases["one scene and a part of one"] = Case(saved(lambda entry, _: [entry, {"key": "b"}]), says=listed)
    cases["images that are one tensor"] = Case(saved(one_photo), says=("tensors", "once"))
    cases["images of 150 MB in few bytes"] = Case(saved(wide_photos), says=("memory", "1 photos"))
    cases["images of 40,000 scans"] = Case(saved(many_scans), says=("steps", "scans"))
    cases["a key of many lists"] = Case(saved(printed_for_ever), says=("key", "2"))
    cases["a key that is no text"] = Case(saved(lambda entry, _: [{**entry, "key": "\ud800"}, {**entry, "key": "b"}]))
    cases["images of two sizes"] = Case(saved(two_sizes), says=("images", "size"))
    cases["images of 200 bytes"] = Case(saved(lambda e, _: e.update(images=[image[:200] for image in e["images"]])))
    cases["no photos"] = Case(saved(replaced("images", None)), EITHER)
    cases["as it is"] = Case(saved(lambda entry, _: None), READ)
    cases["several scenes"] = Case(saved(lambda entry, _: [{**entry, "key": key} for key in "ab"]))
    cases["a key twice"] = Case(saved(lambda entry, _: [entry, entry]))
    cases["keys of numbers"] = Case(saved(lambda entry, _: [{**entry, "key": 7}, {**entry, "key": "a\nb"}]))
    return cases


def _bytes() -> dict[str, Case]:
    cut, objects = ("chunk", "torch"), ("damaged", "objects")
    shares = {f"{share} of it": Case(bytes_of(lambda d, s=share: d[: int(s * len(d))]), says=cut)
              for share in (0.0, 0.01, 0.5, 0.99)}  # fmt: skip
    return shares | {
        "text": Case(bytes_of(lambda _: b"text"), says=cut),
        "all but the end": Case(bytes_of(lambda data: data[:-30])),
        "an older form": Case(older_form, says=("something",)),
        "packed members": Case(with_pickle(lambda _, x: x, zipfile.ZIP_DEFLATED), says=("packed",)),
        "8 GB of zeros": Case(zeros),
        "a pickle": Case(bare_pickle),
        "a payload": Case(saved(lambda _, folder: Payload(folder / MARKER)), says=objects),
        "a payload for cameras": Case(
            saved(lambda entry, folder: entry.update(cameras=Payload(folder / MARKER))), says=objects
        ),
        "a structure that runs": Case(with_pickle(lambda folder, _: pickle.dumps(Payload(folder / MARKER), 2))),
        "a structure of half": Case(with_pickle(lambda _, content: content[: len(content) // 2])),
        "20 MB behind the structure": Case(with_pickle(lambda _, content: content + bytes(20 << 20)), READ),
        "a structure of nested lists": Case(with_pickle(lambda *_: b"\x80\x02" + b"]" * 99_999 + b"a" * 99_998 + b".")),
        "a structure that names another file": Case(with_pickle(renamed), says=objects),
        "a tensor past its numbers": Case(with_pickle(moved), says=("damaged",)),
        "2^40 bytes asked for": Case(with_pickle(lambda *_: GREEDY)),
    }


def _structures() -> dict[str, Case]:
    """Structures that ask for more than they are, and archives that say what is not."""
    one_hash = {2**61 * i - i: None for i in range(1, 1000)}
    contents: dict[str, tuple[bytes, str]] = {
        "tuples 60 deep as a key": (b"\x80\x02})" + b"2\x86" * 60 + b"K\x01s.", "instruction"),
        "nested tuples as a key": (b"\x80\x02}" + NESTED + b"Ns.", "keys"),
        "nested tuples as a name": (b"\x80\x04" + NESTED + b"\x8c\1a\x93.", "str"),
        "nested tuples as a storage": (
            b"\x80\x02(X\7\0\0\0storagectorch\nFloatStorage\n" + NESTED + b"X\3\0\0\0cpuK\1tQ.", "storage",
        ),
        "a list in itself": (b"\x80\x02]q\0h\0a.", "list"),
        "numbers of one hash as keys": (pickle.dumps(one_hash, 2), "keys"),
    }  # fmt: skip
    cases = {
        word: Case(with_pickle(lambda *_, c=content: c), says=(says,)) for word, (content, says) in contents.items()
    }
    size = 2**31 - 16
    return cases | {
        "100,000 members": Case(many_members, says=("damaged",)),
        "two structures": Case(two_structures, says=("damaged",)),
        "a structure said to have 2 GB": Case(
            directory(lambda out, line, _: struct.pack_into("<2L", out, line + 20, size, size)), says=("members",)
        ),
        "members behind the file": Case(
            directory(lambda out, line, _: struct.pack_into("<L", out, line + 42, size)), says=("members",)
        ),
        "members before the file": Case(
            directory(lambda out, _, end: struct.pack_into("<Q", out, end + 48, len(out) - 1)), says=("members",)
        ),
        "a directory said to have 4 GB": Case(
            directory(lambda out, _, end: struct.pack_into("<Q", out, end + 40, 2**32)), says=("damaged",)
        ),
    }


CASES = {f"chunk: {name}": replace(c, named=NAME) for name, c in (_shapes() | _bytes() | _structures()).items()}
