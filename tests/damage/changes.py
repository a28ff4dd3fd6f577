"""These functions change a file of any format: its bytes, its JSON document, the members of its archive."""

from __future__ import annotations

import io
import json
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from .case import Change

BOMB = 10 * (1 << 24)  # bytes that the member of :func:`add_bomb` unpacks to


def edit_bytes(change: Callable[[bytes], bytes]) -> Change:
    """Change the bytes of a file."""
    return lambda path: write_file(path, change(path.read_bytes()))


def write_file(path: Path, content: bytes | str) -> None:
    """Write bytes or text."""
    path.write_bytes(content.encode("utf-8", "surrogatepass") if isinstance(content, str) else content)


def write(data: bytes | str) -> Change:
    """Put other content in the place of a file."""
    return lambda path: write_file(path, data)


def cut(share: float) -> Change:
    """Keep that share of a file."""
    return edit_bytes(lambda data: data[: int(share * len(data))])


def pack_at(position: int, form: str, *values: Any) -> Change:
    """Put numbers at a position, as ``struct`` packs them."""
    return edit_bytes(put_numbers(position, form, *values))


def put_numbers(position: int, form: str, *values: Any) -> Callable[[bytes], bytes]:
    """Return a function that puts numbers at a position of bytes."""
    packed = struct.pack(form, *values)
    return lambda data: data[:position] + packed + data[position + len(packed) :]


def swap(old: bytes | str, new: bytes | str) -> Change:
    """Put other bytes in the place of some that the file has to have."""
    before, after = (part.encode("latin-1") if isinstance(part, str) else part for part in (old, new))

    def change(data: bytes) -> bytes:
        assert before in data, before
        return data.replace(before, after, 1)

    return edit_bytes(change)


def fill_with_zeros(size: int, start: bytes | None = b"") -> Change:
    """Make a file of that many bytes, of which only the start takes room on the disk: what it has if None."""

    def change(path: Path) -> None:
        first = path.read_bytes() if start is None else start
        with path.open("wb") as file:
            file.write(first)
            file.truncate(size)

    return change


def change_beside(name: str, change: Change) -> Change:
    """Change a file beside the sound one, at a path relative to it; it need not exist."""
    return lambda path: change(path.parent / name)


# JSON


def edit_json(change: Callable[[Any], Any]) -> Change:
    """Change the document of a file: of JSON, of a ``.glb``, or ``meta.json`` of an archive.

    What the change returns replaces the document, unless that is None.
    """

    def both(path: Path) -> None:
        text, pack = document(path.read_bytes())
        parsed = json.loads(text)
        other = change(parsed)
        write_file(path, pack(json.dumps(parsed if other is None else other).encode()))

    return both


def document(data: bytes) -> tuple[bytes, Callable[[bytes], bytes]]:
    """Return the JSON of a file, and a function that returns the file with other JSON."""
    if data[:4] == b"PK\3\4":
        return read_member(data, "meta.json"), lambda text: put_member(data, "meta.json", text)
    if data[:4] == b"glTF":
        end = 20 + int.from_bytes(data[12:16], "little")
        return data[20:end], lambda text: glb_bytes(text, data[end:])
    return data, lambda text: text


def glb_bytes(text: bytes, rest: bytes) -> bytes:
    """Return a ``.glb`` of that JSON, before chunks of other content."""
    text += b" " * (-len(text) % 4)
    return struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text) + len(rest), len(text), b"JSON") + text + rest


def write_json(data: bytes) -> Change:
    """Put other text in the place of the document of a file."""
    return edit_bytes(lambda before: document(before)[1](data))


def set_json(*keys: str | int, value: Any) -> Change:
    """Put a value at a place of the document; its last key may be new."""

    def change(parsed: Any) -> None:
        for key in keys[:-1]:
            parsed = parsed[key]
        parsed[keys[-1]] = value

    return edit_json(change)


def drop_json(*keys: str | int) -> Change:
    """Leave out a place of the document."""

    def change(parsed: Any) -> None:
        for key in keys[:-1]:
            parsed = parsed[key]
        del parsed[keys[-1]]

    return edit_json(change)


# Archives


def read_members(data: bytes) -> dict[str, bytes]:
    """Return the content of an archive by name."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def read_member(data: bytes, name: str) -> bytes:
    """Return the content of one member."""
    return read_members(data)[name]


def pack_members(contents: dict[str, bytes], method: int = zipfile.ZIP_STORED) -> bytes:
    """Return an archive of that content."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", method) as archive:
        for name, data in contents.items():
            archive.writestr(name, data)
    return stream.getvalue()


def put_member(data: bytes, name: str, content: bytes) -> bytes:
    """Return the archive, stored, with other content of a member, which may be new."""
    return pack_members(read_members(data) | {name: content})


def edit_member(name: str, change: Callable[[bytes], bytes]) -> Change:
    """Change the bytes of a member."""
    return edit_bytes(lambda data: put_member(data, name, change(read_member(data, name))))


def drop_member(name: str) -> Change:
    """Leave out a member."""
    return edit_bytes(
        lambda data: pack_members({key: value for key, value in read_members(data).items() if key != name})
    )


def add_bomb(name: str, method: int, start: bytes = b"") -> Change:
    """Put a member into an archive that unpacks to 168 MB, of which the directory promises 512 bytes."""

    def change(path: Path) -> None:
        rest = {key: value for key, value in read_members(path.read_bytes()).items() if key != name}
        write_file(path, pack_members(rest))
        with zipfile.ZipFile(path, "a", method) as archive:
            with archive.open(name, "w") as file:
                file.write(start)
                for _ in range(10):
                    file.write(bytes(BOMB // 10))
            archive.getinfo(name).file_size = 512

    return change


def edit_entries(in_member: int, in_directory: int, change: Callable[[int], int]) -> Change:
    """Change a number of 16 bits at these places of every member's head, and of its line in the directory."""

    def both(data: bytes) -> bytes:
        out = bytearray(data)
        for mark, offset in ((b"PK\x03\x04", in_member), (b"PK\x01\x02", in_directory)):
            start = data.find(mark)
            while start >= 0:
                struct.pack_into("<H", out, start + offset, change(*struct.unpack_from("<H", out, start + offset)))
                start = data.find(mark, start + 4)
        return bytes(out)

    return edit_bytes(both)
