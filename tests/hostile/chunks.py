"""``.torch`` chunks: objects that would run code, shapes that lie, bytes that are missing."""

from __future__ import annotations

import io
import pickle
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from .array_files import MARKER, Payload
from .case import EITHER, HEIGHT, READ, VIEWS, WIDTH, Case, Spoil, names, sparse, without_transforms

NAME = "chunk.torch"
GREEDY = b"\x80\x02c__builtin__\nbytearray\n\x8a\x06\0\0\0\0\0\x01\x85R."  # a pickle of bytearray(2**40)


def entry_of(folder: Path) -> dict[str, Any]:
    """The scene as a chunk has it."""
    c2w, K = without_transforms(folder)
    head = [K[0, 0] / WIDTH, K[1, 1] / HEIGHT, K[0, 2] / WIDTH, K[1, 2] / HEIGHT, 0, 0]
    rows = np.concatenate([np.tile(head, (VIEWS, 1)), np.linalg.inv(c2w)[:, :3].reshape(VIEWS, 12)], 1)
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


def _shapes() -> dict[str, Case]:
    zeros, byte, shape = torch.zeros(VIEWS, 18), torch.zeros(1, dtype=torch.uint8), "[v,18], found"
    no_numbers, no_tensors, objects = "cameras of numbers", "images as tensors", "objects"
    cameras: dict[str, tuple[Any, str]] = {
        "17 columns": (zeros[:, :17].clone(), f"{shape} [3, 17]"),
        "one row": (torch.zeros(18), f"{shape} [18]"),
        "text": ("many", f"{shape} str"),
        "a list": ([[0.0] * 18] * VIEWS, f"{shape} list"),
        "None": (None, ""),
        "no rows": (torch.zeros(0, 18), "10000 cameras, found 0"),
        "2^40 rows": (torch.zeros(1, 18).expand(2**40, 18), "10000 cameras"),
        "integers": (zeros.int(), no_numbers),
        "bool": (zeros.bool(), no_numbers),
        "bfloat16": (zeros.bfloat16(), no_numbers),
        "complex": (zeros.to(torch.complex64), no_numbers),
        "sparse": (zeros.to_sparse(), objects),
        "no values": (torch.empty(VIEWS, 18, device="meta"), objects),
        "NaN": (torch.full((VIEWS, 18), torch.nan), "finite"),
        "1e38": (torch.full((VIEWS, 18), 1e38), ""),
        "zeros": (zeros, "orthonormal"),
    }
    images: dict[str, tuple[Any, str]] = {
        "too few": ([byte], "found 1"),
        "one text": ("abc", "found str"),
        "empty": ([byte[:0].clone()] * VIEWS, "decoded"),
        "2^40 bytes": ([byte.expand(2**40)] * VIEWS, no_tensors),
        "floats": ([torch.zeros(9)] * VIEWS, no_tensors),
        "no values": ([torch.empty(9, dtype=torch.uint8, device="meta")] * VIEWS, objects),
        "numbers": ([1] * VIEWS, no_tensors),
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
        "a structure of 20 MB": Case(with_pickle(lambda _, content: content + bytes(20 << 20))),
        "a structure of nested lists": Case(with_pickle(lambda *_: b"\x80\x02" + b"]" * 99_999 + b"a" * 99_998 + b".")),
        "a structure that names another file": Case(with_pickle(renamed), says=objects),
        "a tensor past its numbers": Case(with_pickle(moved), says=("damaged",)),
        "2^40 bytes asked for": Case(with_pickle(lambda *_: GREEDY)),
    }


CASES = {f"chunk: {name}": replace(c, named=NAME) for name, c in (_shapes() | _bytes()).items()}
