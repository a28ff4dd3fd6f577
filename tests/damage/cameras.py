"""Damages of COLMAP models, lists of poses and files of Metashape promise more than there is."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

from .case import Change, Damage, allow, refuse
from .changes import change_beside, edit_bytes, fill_with_zeros, pack_at, swap, write, write_file

MILLION = "MILLION"  # stands for as many attributes, which take a second to name
NAME_IN_IMAGES = 72  # place of the first name in images.bin
POINTS_IN_IMAGES = NAME_IN_IMAGES + len("view_000.png\0")


def edit_lines(change: Callable[[list[str]], list[str]]) -> Change:
    """Change the lines of a text."""
    return edit_bytes(lambda data: "\n".join(change(data.decode().splitlines())).encode())


def of_binary() -> dict[str, Damage]:
    many = (2**63, 2**64 - 1)
    huge = fill_with_zeros(2**33)
    return {
        **{f"a count of {n} cameras": allow(change_beside("cameras.bin", pack_at(0, "<Q", n))) for n in many},
        **{
            f"a camera {n} pixels wide": allow(change_beside("cameras.bin", pack_at(16, "<Q", n)))
            for n in (60_000, 2**63)
        },
        **{f"a count of {n} images": allow(pack_at(0, "<Q", n)) for n in many},
        **{f"an image with {n} points": allow(pack_at(POINTS_IN_IMAGES, "<Q", n)) for n in (2**40, 2**61, 2**64 - 1)},
        "a million images": allow(edit_bytes(lambda d: struct.pack("<Q", 10**6) + d[8:] * 330_000), slow=True),
        "a photo's name of 1 MB": allow(edit_bytes(lambda d: d[:NAME_IN_IMAGES] + b"x" * 2**20 + d[NAME_IN_IMAGES:])),
        "a photo's name that is not UTF-8": allow(pack_at(NAME_IN_IMAGES, "<2B", 255, 254)),
        "a photo's name with line breaks": allow(pack_at(NAME_IN_IMAGES, "<3B", 10, 13, 27)),
        "8 GB of zeros as cameras.bin": refuse(change_beside("cameras.bin", huge)),
    }


def of_text() -> dict[str, Damage]:
    many = b"".join(b"%d SIMPLE_PINHOLE 1 1 1 1 1\n" % i for i in range(20_000))
    contents = {
        "a size of 5,000 digits": b"1 PINHOLE " + b"9" * 5000 + b" 16 20 20 12 8",
        "bytes of all values": bytes(range(256)), "20,000 cameras": many,
    }  # fmt: skip
    return {
        **{
            f"{word} in cameras.txt": refuse(change_beside("cameras.txt", write(data)))
            for word, data in contents.items()
        },
        "a million images": refuse(write(b"0 1 0 0 0 0 0 0 1 a\n" * 1_000_000), slow=True),
        "8 GB of zeros as cameras.txt": refuse(change_beside("cameras.txt", fill_with_zeros(2**33))),
    }


def of_pose_list() -> dict[str, Damage]:
    changes: dict[str, Callable[[list[str]], list[str]]] = {
        "a line of 1 MB": lambda _: ["1 " * 2**19], "50,000 equal poses": lambda x: [x[1]] * 50_000,
        "a zero byte in the first line": lambda x: [x[0] + " \0", *x[1:]],
        "4,000,000 lines of one number": lambda x: [x[0], "1\n" * 4_000_000],
        "15,000,000 blank lines at the end": lambda x: [*x, " \n" * 15_000_000],
        "15,000,000 comments at the end": lambda x: [*x, "#\n" * 15_000_000],
    }  # fmt: skip
    return {word: allow(edit_lines(change), slow=word[0].isdigit()) for word, change in changes.items()}


def add_element(tag: str) -> Change:
    """Put an element into a file of Metashape, behind its cameras."""
    return swap("</chunk>", f"{tag}</chunk>")


def nest_sensors(path: Path) -> None:
    """Nest 400 sensors, each in the one before; the innermost has 100,000 elements."""
    data, count = path.read_text(), 400
    start, end = data.index("<sensor "), data.index("</sensors>")
    sensor = data[start:end].replace("</sensor>", "")
    camera = data[data.index("<camera ") : data.index("</camera>")] + "</camera>"
    sensors = "".join(sensor.replace('id="0"', f'id="{i}"', 1) for i in range(count))
    cameras = "".join(camera.replace('sensor_id="0"', f'sensor_id="{i}"', 1) for i in range(count))
    head, tail = data[:start], data[data.index("</cameras>") :]
    write_file(path, f"{head}{sensors}{'<a/>' * 100_000}{'</sensor>' * count}</sensors><cameras>{cameras}{tail}")


def add_attributes(path: Path) -> None:
    add_element(f"<x {' '.join(f'a{i}=' + chr(39) * 2 for i in range(1_000_000))}/>")(path)


def of_metashape() -> dict[str, Damage]:
    """Return damages of XML whose parts a parser copies, or goes through again and again."""
    address = "u" * 1_000_000
    names = "".join(f"<a:b{i}/>" for i in range(3000))
    return {
        "400 sensors in one another": allow(nest_sensors, slow=True),
        "a million attributes": allow(add_attributes, slow=True),
        "100,000 elements in a namespace of 1 MB": allow(
            add_element(f"<x xmlns:a='{address}'>{'<a:b/>' * 100_000}</x>"), slow=True
        ),
        "3,000 names in a namespace of 1 MB": allow(add_element(f"<x xmlns:a='{address}'>{names}</x>"), slow=True),
        "400,000 elements in one another": allow(add_element("<a>" * 400_000 + "</a>" * 400_000), slow=True),
        "a component's number with a quote": allow(swap('<camera id="0"', '<camera component_id="a\'b" id="0"')),
        "another encoding than it has": allow(swap("UTF-8", "utf-7")),
        "a declared entity": allow(swap("<document>", "<!DOCTYPE x [<!ENTITY a 'aaaa'>]><document>")),
    }


DAMAGES = {
    "COLMAP binary": of_binary(), "COLMAP text": of_text(), "pose list": of_pose_list(), "Metashape": of_metashape(),
}  # fmt: skip
