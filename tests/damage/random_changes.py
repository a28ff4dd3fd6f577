"""Change files at random so that they stay files of their format: members, chunks, keys, header lines, then bytes."""

from __future__ import annotations

import gzip
import io
import json
import re
import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any

FINDINGS = Path(__file__).parent / "findings"  # files that a reader failed on; the tests read them
Change = Callable[[bytes, Random], bytes]

PIECES = (b"\0" * 8, b"\xff" * 8, b"-1", b"99999999999", b"nan", b"1e999", b"\n", b"list uchar", b"[" * 50, b"9" * 5000)
VALUES = (None, True, -1, 0, 1, 24, 2.5, 2**31, 2**63, 10**400, 1e300, float("nan"), float("inf"), "", "wide",
          "9" * 5000, "../a", "\0", [], [1, 2], {}, {"a": 1}, [[1.0] * 4] * 4, [[[]]])  # fmt: skip
WORDS = ("", "0", "-1", "nan", "1e999", "4294967296", "9" * 30, "list", "uchar", "int", "double", "float", "property",
         "element", "vertex", "chunk", "sh", "x", "#", ",", "ascii", "\0", "é", "PINHOLE", "OPENCV")  # fmt: skip


def mutate(data: bytes, random: Random, leaf: Change | None = None) -> bytes:
    """Change something in a file; ``leaf`` changes bytes without a structure that is known here."""
    leaf = leaf or splice
    if random.random() > 0.1:
        for start, change in FORMS:
            if re.match(start, data, re.DOTALL):
                try:
                    return change(data, random, leaf)
                except (ValueError, KeyError, EOFError, OSError, zlib.error, struct.error, zipfile.BadZipFile,
                        NotImplementedError, RuntimeError, RecursionError):  # fmt: skip
                    break
    return leaf(data, random)


def splice(data: bytes, random: Random) -> bytes:
    """Overwrite, remove, put in or repeat a few bytes, or cut the end off."""
    changed = bytearray(data)
    for _ in range(random.randint(1, 3)):
        start, length = random.randint(0, len(changed)), random.choice((0, 1, 1, 4, 8, 24))
        piece = random.choice((random.randbytes(random.choice((1, 1, 4, 8))), random.choice(PIECES), data[start:][:24]))
        changed[start : start + length] = piece
    return bytes(changed[: random.randint(0, len(changed))] if random.random() < 0.1 else changed)


def change_zip(data: bytes, random: Random, leaf: Change) -> bytes:
    """Change, rename, leave out or repeat a member of an archive."""
    with zipfile.ZipFile(io.BytesIO(data)) as source:
        members = [(entry, source.read(entry)) for entry in source.infolist() if entry.file_size < 1 << 22]
    at = random.randrange(len(members))
    entry, content = members[at]
    what = random.random()
    if what < 0.05 and len(members) > 1:
        del members[at]
    elif what < 0.15:
        entry.filename = random.choice([other.filename for other, _ in members] + ["../a", "a" * 300])
    else:
        members[at] = (entry, mutate(content, random, leaf))
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as file:
        for entry, content in {entry.filename: (entry, content) for entry, content in members}.values():
            file.writestr(entry.filename, content, entry.compress_type, 1)
    return packed.getvalue()


def change_gzip(data: bytes, random: Random, leaf: Change) -> bytes:
    """Change the unpacked stream."""
    return gzip.compress(leaf(gzip.decompress(data), random), 1)


def change_png(data: bytes, random: Random, leaf: Change) -> bytes:
    """Change a chunk, the pixels unpacked, and mend its checksum."""
    chunks, at = [], 8
    while at + 8 <= len(data):
        size = int.from_bytes(data[at : at + 4], "big")
        chunks.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + size]))
        at += size + 12
    chosen = random.randrange(len(chunks))
    name, body = chunks[chosen]
    packed = name == b"IDAT" and random.random() < 0.5
    body = zlib.compress(leaf(zlib.decompress(body), random)) if packed else leaf(body, random)
    chunks[chosen] = (name, body)
    if random.random() < 0.1:
        chunks.insert(chosen, (random.choice((b"tRNS", b"PLTE", b"iCCP", b"eXIf", name)), random.randbytes(9)))
    packs = [struct.pack(">I", len(b)) + n + b + struct.pack(">I", zlib.crc32(n + b)) for n, b in chunks]
    return data[:8] + b"".join(packs)


def change_safetensors(data: bytes, random: Random, leaf: Change) -> bytes:
    """Change the header, or the numbers."""
    end = 8 + int.from_bytes(data[:8], "little")
    header, numbers = data[8:end], data[end:]
    if random.random() < 0.7:
        header = change_json(header, random, leaf)
    else:
        numbers = leaf(numbers, random)
    return struct.pack("<Q", len(header)) + header + numbers


def change_glb(data: bytes, random: Random, leaf: Change) -> bytes:
    """Change the description, or the numbers."""
    size = int.from_bytes(data[12:16], "little")
    text, rest = data[20 : 20 + size], data[20 + size :]
    if random.random() < 0.7:
        text = change_json(text, random, leaf)
        text += b" " * (-len(text) % 4)
    else:
        rest = rest[:8] + leaf(rest[8:], random)
    return data[:8] + struct.pack("<2I", 20 + len(text) + len(rest), len(text)) + b"JSON" + text + rest


def change_ply(data: bytes, random: Random, leaf: Change) -> bytes:
    """Change lines of the header, or the rows."""
    head, mark, rows = data.partition(b"end_header\n")
    if random.random() < 0.5:
        return change_text(head, random, leaf) + mark + rows
    return head + mark + (change_text(rows, random, leaf) if b"format ascii" in head else leaf(rows, random))


def change_array(data: bytes, random: Random, leaf: Change) -> bytes:
    """Change type, shape or numbers of a stored array."""
    size = int.from_bytes(data[8:10], "little")
    header, numbers = data[10 : 10 + size], data[10 + size :]
    what = random.random()
    if what < 0.3:
        kind = random.choice(("<f4", "<f8", "<f2", "|u1", "<i8", "<U3", "<c8", "|b1", "<M8[s]", "|O", "|V0", ">f4"))
        header = re.sub(rb"'descr': '[^']*'", f"'descr': '{kind}'".encode(), header)
    elif what < 0.6:
        shape = tuple(random.choice((0, 1, 2, 3, 4, 5, 16, 1 << 40)) for _ in range(random.randint(0, 4)))
        header = re.sub(rb"'shape': \([^)]*\)", f"'shape': {shape}".encode(), header)
    elif what < 0.7:
        header = leaf(header, random)
    else:
        numbers = leaf(numbers, random)
    header = header[:65535]
    return data[:8] + struct.pack("<H", len(header)) + header + numbers


def change_text(data: bytes, random: Random, leaf: Change) -> bytes:
    """Change a word or a line."""
    lines = data.split(b"\n")
    at = random.randrange(len(lines))
    what = random.random()
    if what < 0.1:
        del lines[at]
    elif what < 0.2:
        lines.insert(at, lines[random.randrange(len(lines))])
    elif what < 0.25:
        lines[at:at] = lines * random.choice((2, 50))
    elif what < 0.8:
        words = lines[at].split(b" ")
        words[random.randrange(len(words))] = random.choice((*(w.encode() for w in WORDS), *words))
        lines[at] = b" ".join(words)
    else:
        lines[at] = leaf(lines[at], random)
    return b"\n".join(lines)


def change_json(data: bytes, random: Random, leaf: Change) -> bytes:
    """Change one or two values or keys; now and then the text."""
    if random.random() < 0.15:
        return leaf(data, random)
    document = [json.loads(data)]
    for _ in range(random.randint(1, 2)):
        change_value(document, random)
    return json.dumps(document[:1] and document[0]).encode("utf-8", "surrogatepass")


def change_value(document: Any, random: Random) -> None:
    """Change something in a list or object, in place."""
    keys = list(document) if isinstance(document, dict) else list(range(len(document)))
    if not keys:
        return
    key = random.choice(keys)
    value, what = document[key], random.random()
    if isinstance(value, list | dict) and value and what < 0.8:
        change_value(value, random)
    elif isinstance(value, str) and value[:1] == "{" and what < 0.9:
        inner = [json.loads(value)]
        change_value(inner, random)
        document[key] = json.dumps(inner[:1] and inner[0])
    elif what < 0.85:
        number = isinstance(value, int | float) and random.random() < 0.4
        document[key] = random.choice((value * 2, -value, value + 1, value // 3)) if number else random.choice(VALUES)
    elif what < 0.9:
        document[key] = document[random.choice(keys)]
    elif isinstance(document, dict):
        del document[key]
        if what > 0.95:
            document[random.choice((*(str(word) for word in WORDS), *map(str, keys)))] = value
    else:
        document[:] = document[:key] if what < 0.95 else document * 2


FORMS: tuple[tuple[bytes, Callable[[bytes, Random, Change], bytes]], ...] = (
    (rb"PK\x03\x04", change_zip),
    (rb"\x1f\x8b", change_gzip),
    (rb"\x89PNG", change_png),
    (rb"glTF", change_glb),
    (rb"ply\n", change_ply),
    (rb"\x93NUMPY", change_array),
    (rb".{7}\x00\{", change_safetensors),
    (rb"\s*[\[{]", change_json),
    (rb"[\t\n -~]*\Z", change_text),
)
