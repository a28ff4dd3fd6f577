"""Ways to damage a file in the safetensors format: a state, networks."""

from __future__ import annotations

import json
import pickle
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors import safe_open
from safetensors.numpy import load_file, save_file

from gsmerge.errors import SceneError

Spoil = Callable[[Path], Any]


def entry(path: Path) -> tuple[str, dict[str, Any]]:
    """The one entry of a file's metadata: its name, which says the format, and the header in it, without checksums.

    Whoever makes a hostile file makes no checksums, or right ones.
    """
    size = int.from_bytes(path.read_bytes()[:8], "little")
    ((form, text),) = json.loads(path.read_bytes()[8 : 8 + size])["__metadata__"].items()
    return form, {name: value for name, value in json.loads(text).items() if name != "checksums"}


def header(path: Path) -> dict[str, Any]:
    return entry(path)[1]


def with_text(text: str, name: str | None = None) -> Spoil:
    """Another text in place of the header, under the file's own format or another."""
    return lambda path: save_file(load_file(path), path, {name or entry(path)[0]: text})


def with_header(**changes: Any) -> Spoil:
    return lambda path: with_text(json.dumps(header(path) | changes))(path)


def with_about(**changes: Any) -> Spoil:
    def spoil(path: Path) -> None:
        with_header(about=header(path)["about"] | changes)(path)

    return spoil


def without(name: str) -> Spoil:
    def spoil(path: Path) -> None:
        said = header(path)
        with_text(json.dumps({key: value for key, value in said.items() if key != name}))(path)

    return spoil


def with_array(name: str, change: Callable[[np.ndarray], np.ndarray] | None) -> Spoil:
    def spoil(path: Path) -> None:
        (form, said), arrays = entry(path), load_file(path)
        array = arrays.pop(name)
        if change is not None:
            arrays[name] = np.ascontiguousarray(change(array))  # as safetensors takes it to be
        save_file(arrays, path, {form: json.dumps(said)})

    return spoil


def damaged(name: str) -> Spoil:
    """The signs of an array changed behind the back of its checksum."""

    def spoil(path: Path) -> None:
        arrays = load_file(path)
        with safe_open(path, "np") as file:
            save_file(arrays | {name: -arrays[name]}, path, file.metadata())

    return spoil


def filled(value: float) -> Callable[[np.ndarray], np.ndarray]:
    def change(array: np.ndarray) -> np.ndarray:
        array = array.copy()
        array.flat[array.size // 2] = value
        return array

    return change


def cut(share: float) -> Spoil:
    return lambda path: path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])


def with_metadata(metadata: object) -> Spoil:
    """Another value in the place of the texts by name of a safetensors file."""

    def spoil(path: Path) -> None:
        data = path.read_bytes()
        size = int.from_bytes(data[:8], "little")
        head = json.dumps({**json.loads(data[8 : 8 + size]), "__metadata__": metadata}).encode()
        path.write_bytes(len(head).to_bytes(8, "little") + head + data[8 + size :])

    return spoil


# What is wrong with any file
UNREADABLE: dict[str, Spoil] = {
    "missing": Path.unlink,
    "empty": lambda path: path.write_bytes(b""),
    "a few bytes": cut(0.0001),
    "half": cut(0.5),
    "all but the end": cut(0.999),
    "a byte too many": lambda path: path.write_bytes(path.read_bytes() + b"x"),
    "a PLY file": lambda path: path.write_text("ply\nformat ascii 1.0\nend_header\n"),
    "a pickle": lambda path: path.write_bytes(pickle.dumps({"a": 1}) * 9),
    "a huge header": lambda path: path.write_bytes(b"\xff" * 8 + path.read_bytes()[8:]),
    "no header": lambda path: save_file(load_file(path), path),
    "no JSON": with_text("{"),
    "a list": with_text("[]"),
    "deep JSON": with_text("[" * 100_000),
    **{
        f"metadata as {json.dumps(value)}": with_metadata(value)
        for value in ([1, "a"], "text", 7, True, {"gsmerge": 1}, {"gsmerge": ["a"]}, {"gsmerge": {"a": "b"}})
    },
}
# What is wrong with the header of a state
GSM_HEADERS: dict[str, Spoil] = {
    "networks": with_text("{}", "gsmerge-networks"),
    "no schema": without("schema"),
    "an older schema": with_header(schema=0),
    "a newer schema": with_header(schema=9, gsmerge="9.9"),
    "no kind": without("kind"),
    "another kind": with_header(kind="mood"),
    "no width": without("width"),
    "views without pixels": with_header(width=0),
    "views of 65536 x 65536": with_header(width=65536, height=65536),
    "a width of true": with_header(width=True),
    "no names": without("names"),
    "batches by number": with_about(batches=5),
    "batches of numbers": with_about(batches=[5]),
    "about in a list": with_header(about=[]),
    "a million objects": with_about(notes=[[]] * 3_000_000),
}


def of_arrays(arrays: Iterable[str], floats: Iterable[str]) -> dict[str, Spoil]:
    """Each array missing, of another type and of another shape; those of numbers with a NaN."""
    damages: dict[str, Spoil] = {}
    for name in arrays:
        damages[f"no {name}"] = with_array(name, None)
        damages[f"{name} of doubles"] = with_array(
            name, lambda a: a.astype(np.float32 if a.dtype == np.float64 else np.float64)
        )
        damages[f"{name} of another shape"] = with_array(name, lambda a: a[None])
    return damages | {f"NaN in {name}": with_array(name, filled(float("nan"))) for name in floats}


def assert_refused_in_one_line(load: Callable[[Path], object], path: Path) -> str:
    """The line, which begins with the name of the file."""
    with pytest.raises(SceneError) as said:
        load(path)
    text = str(said.value)
    assert text.startswith(f"{path}: ")
    assert "\n" not in text
    assert len(text) < 400 + len(str(path))
    return text
