"""``.torch`` chunks: objects that would run code, shapes that lie, bytes that are missing."""

from __future__ import annotations

import io
import pickle
import zipfile
from collections.abc import Callable
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


def with_pickle(make: Callable[[Path, bytes], bytes]) -> Spoil:
    """A good chunk with another structure."""

    def spoil(folder: Path) -> None:
        saved(lambda entry, _: None)(folder)
        data = (folder / NAME).read_bytes()
        with zipfile.ZipFile(io.BytesIO(data)) as source, zipfile.ZipFile(folder / NAME, "w") as target:
            for member in source.infolist():
                content = source.read(member)
                structure = member.filename.endswith("data.pkl")
                target.writestr(member.filename, make(folder, content) if structure else content)

    return spoil


def zeros(folder: Path) -> None:
    without_transforms(folder)
    sparse(folder / NAME, 2**33)


def bare_pickle(folder: Path) -> None:
    without_transforms(folder)
    (folder / NAME).write_bytes(pickle.dumps(Payload(folder / MARKER)))


def _shapes() -> dict[str, Case]:
    row, byte = torch.zeros(1, 18), torch.zeros(1, dtype=torch.uint8)
    cameras: dict[str, Any] = {
        "17 columns": torch.zeros(VIEWS, 17), "one row": torch.zeros(18), "2^40 rows": row.expand(2**40, 18),
        "no rows": torch.zeros(0, 18), "NaN": torch.full((VIEWS, 18), torch.nan), "1e38": torch.full((VIEWS, 18), 1e38),
        "a list": [[0.0] * 18] * VIEWS, "bool": torch.zeros(VIEWS, 18, dtype=torch.bool), "None": None,
        "complex": torch.zeros(VIEWS, 18, dtype=torch.complex64), "sparse": torch.zeros(VIEWS, 18).to_sparse(),
    }  # fmt: skip
    images: dict[str, Any] = {
        "too few": [byte], "one text": "abc", "empty": [byte[:0]] * VIEWS, "2^40 bytes": [byte.expand(2**40)] * VIEWS,
        "floats": [torch.zeros(9)] * VIEWS, "numbers": [1] * VIEWS, "zeros": [byte.repeat(99)] * VIEWS,
    }  # fmt: skip
    cases = {f"cameras of {word}": Case(saved(replaced("cameras", value))) for word, value in cameras.items()}
    cases |= {f"images of {word}": Case(saved(replaced("images", value))) for word, value in images.items()}
    cases["no photos"] = Case(saved(replaced("images", None)), EITHER)
    cases["as it is"] = Case(saved(lambda entry, _: None), READ)
    cases["several scenes"] = Case(saved(lambda entry, _: [{**entry, "key": key} for key in "ab"]))
    cases["a key twice"] = Case(saved(lambda entry, _: [entry, entry]))
    cases["keys of numbers"] = Case(saved(lambda entry, _: [{**entry, "key": 7}, {**entry, "key": "a\nb"}]))
    cases["no scenes"] = Case(saved(lambda *_: []))
    cases["one number"] = Case(saved(lambda *_: 5))
    return cases


def _bytes() -> dict[str, Case]:
    return {
        "nothing": Case(bytes_of(lambda _: b"")),
        "text": Case(bytes_of(lambda _: b"text")),
        "half": Case(bytes_of(lambda data: data[: len(data) // 2])),
        "all but the end": Case(bytes_of(lambda data: data[:-30])),
        "8 GB of zeros": Case(zeros),
        "a pickle": Case(bare_pickle),
        "a payload": Case(saved(lambda _, folder: Payload(folder / MARKER))),
        "a payload for cameras": Case(saved(lambda entry, folder: entry.update(cameras=Payload(folder / MARKER)))),
        "a structure that runs": Case(with_pickle(lambda folder, _: pickle.dumps(Payload(folder / MARKER), 2))),
        "a structure of half": Case(with_pickle(lambda _, content: content[: len(content) // 2])),
        "a structure of 20 MB": Case(with_pickle(lambda _, content: content + bytes(20 << 20))),
        "a structure of nested lists": Case(with_pickle(lambda *_: b"\x80\x02" + b"]" * 99_999 + b"a" * 99_998 + b".")),
        "2^40 bytes asked for": Case(with_pickle(lambda *_: GREEDY)),
    }  # fmt: skip


CASES = {f"chunk: {name}": Case(c.spoil, c.codes, NAME) for name, c in (_shapes() | _bytes()).items()}
