"""Changes that make a sound file of some format a hostile one, for ``hostile.py``."""

from __future__ import annotations

import gzip
import io
import json
import random
import struct
import zipfile
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np

Mutate = Callable[[random.Random, bytes], bytes]
WORDS: list[Any] = [float("nan"), float("inf"), -1, 0, 1e300, 1e-300, 10**400, 2**31, 2**63, "wide", "", None, True,
                    [], {}, [1, 2], {"a": 1}, "../../etc/passwd", "a\0b", "\u202e", -0.0, 1e9]  # fmt: skip
PIECES = [b"\0" * 8, b"\xff" * 8, b"-1", b"99999999999", b"nan", b"1e999", b"\n", b"list uchar", b"{", b'"', b" "]


def change_bytes(rng: random.Random, data: bytes) -> bytes:
    """Some pieces overwritten, removed, put in, or taken from elsewhere; sometimes the end is missing."""
    out = bytearray(data)
    for _ in range(rng.randint(1, 4)):
        start = rng.randint(0, len(out))
        elsewhere = rng.randint(0, max(len(data) - 1, 0))
        piece = rng.choice([rng.randbytes(rng.randint(0, 16)), rng.choice(PIECES), data[elsewhere : elsewhere + 24]])
        out[start : start + rng.choice([0, len(piece), rng.randint(0, 24)])] = piece
    return bytes(out[: rng.randint(0, len(out))] if rng.random() < 0.15 else out)


def change_words(rng: random.Random, data: bytes) -> bytes:
    """Some little-endian words of binary data become extreme numbers."""
    out = bytearray(data)
    for _ in range(rng.choice([1, 1, 3, 50])):
        if len(out) < 8:
            break
        value = rng.choice([
            struct.pack("<f", rng.choice([float("nan"), float("inf"), -float("inf"), 3e38, -3e38, 1e-40, 0.0])),
            struct.pack("<I", rng.choice([0, 1, 2**31 - 1, 2**31, 2**32 - 1])),
            struct.pack("<Q", rng.choice([0, 2**32, 2**40, 2**63, 2**64 - 1])),
        ])  # fmt: skip
        start = rng.randint(0, len(out) - len(value)) // 4 * 4
        out[start : start + len(value)] = value
    return bytes(out)


def change_text(rng: random.Random, data: bytes) -> bytes:
    """Some words of a text become others, or lines are lost, repeated or exchanged."""
    lines = data.split(b"\n")
    for _ in range(rng.randint(1, 3)):
        at = rng.randrange(len(lines))
        action = rng.choice(["word", "word", "word", "lose", "repeat", "exchange"])
        if action == "word":
            words = lines[at].split(b" ")
            value = rng.choice(WORDS)
            words[rng.randrange(len(words))] = str(value).encode("utf-8", "replace")
            lines[at] = b" ".join(words)
        elif action == "lose" and len(lines) > 1:
            del lines[at]
        elif action == "repeat":
            lines.insert(at, lines[at])
        else:
            other = rng.randrange(len(lines))
            lines[at], lines[other] = lines[other], lines[at]
    return b"\n".join(lines)


def change_head(size: int) -> Mutate:
    """Words of the first bytes, which hold a header of text."""
    return lambda rng, data: change_text(rng, data[:size]) + data[size:]


def change_ply_head(rng: random.Random, data: bytes) -> bytes:
    return change_head(data.index(b"end_header"))(rng, data)


def change_json(rng: random.Random, data: bytes) -> bytes:
    """Some entries of a document become others, or are lost or repeated."""
    document = json.loads(data)
    for _ in range(rng.randint(1, 3)):
        places = list(_places(document))
        if not places:
            break
        holder, key = rng.choice(places)
        action = rng.choice(["value", "value", "value", "lose", "repeat"])
        if action == "value":
            holder[key] = rng.choice(WORDS)
        elif action == "lose":
            del holder[key]
        elif isinstance(holder, list):
            holder.insert(key, holder[key])
        else:
            holder[rng.choice(["", "a", "frames", "w", "h", "K"])] = holder[key]
    return json.dumps(document).encode()


def _places(value: Any) -> list[tuple[Any, Any]]:
    out = []
    keys = list(value) if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else ()
    for key in keys:
        out += [(value, key), *_places(value[key])]
    return out


def change_lines(rng: random.Random, data: bytes) -> bytes:
    """Lines that are documents."""
    lines = data.splitlines()
    at = rng.randrange(len(lines))
    lines[at] = rng.choice([change_json, change_bytes])(rng, lines[at])
    return b"\n".join(lines) + rng.choice([b"\n", b"\n", b""])


def inside_gzip(change: Mutate) -> Mutate:
    return lambda rng, data: gzip.compress(change(rng, gzip.decompress(data)), 1)


def inside_zip(change: Callable[[str], Mutate]) -> Mutate:
    """One member of an archive is changed, sometimes lost."""

    def mutate(rng: random.Random, data: bytes) -> bytes:
        out = io.BytesIO()
        with zipfile.ZipFile(io.BytesIO(data)) as source, zipfile.ZipFile(out, "w") as target:
            chosen, lost = rng.choice(source.namelist()), rng.random() < 0.05
            for name in source.namelist():
                content = source.read(name)
                if name == chosen and lost:
                    continue
                target.writestr(name, change(name)(rng, content) if name == chosen else content)
        return out.getvalue()

    return mutate


def in_safetensors(rng: random.Random, data: bytes) -> bytes:
    """Header or arrays of a safetensors file."""
    size = int.from_bytes(data[:8], "little")
    head, body = data[8 : 8 + size], data[8 + size :]
    part = rng.random()
    if part < 0.4:
        head = change_json(rng, head)
    elif part < 0.6:  # the document in its metadata
        document = json.loads(head)
        texts = {key: text for key, text in document.get("__metadata__", {}).items() if text.startswith("{")}
        for key, text in texts.items():
            document["__metadata__"][key] = change_json(rng, text.encode()).decode()
        head = json.dumps(document).encode()
    else:
        body = change_words(rng, body)
    return len(head).to_bytes(8, "little") + head + body


def another_picture(rng: random.Random, data: bytes) -> bytes:
    """A sound picture of another size, depth or kind."""
    size = rng.choice([(1, 1), (2, 3), (3000, 1), (31, 47), (2000, 3000)])
    shape = (*size, rng.choice([1, 3, 4]))
    values = np.random.default_rng(rng.randrange(99)).integers(0, 256, shape)
    if rng.random() < 0.3:
        return cv2.imencode(".png", values.astype(np.uint16) * 257)[1].tobytes()
    return cv2.imencode(rng.choice([".png", ".jpg", ".bmp", ".tiff", ".webp"]), values.astype(np.uint8))[1].tobytes()


def member(name: str) -> Mutate:
    """How a member of an archive is changed."""
    return any_of(change_json, change_bytes) if name.endswith(".json") else any_of(
        change_bytes, change_words, *([another_picture] if name.endswith(".webp") else [])
    )  # fmt: skip


def any_of(*changes: Mutate) -> Mutate:
    return lambda rng, data: rng.choice(changes)(rng, data)
