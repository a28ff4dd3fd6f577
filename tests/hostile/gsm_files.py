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


def with_settings(**changes: Any) -> Spoil:
    def spoil(path: Path) -> None:
        with_header(settings=header(path)["settings"] | changes)(path)

    return spoil


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


def both(*spoils: Spoil) -> Spoil:
    def spoil(path: Path) -> None:
        for each in spoils:
            each(path)

    return spoil


def cut(share: float) -> Spoil:
    return lambda path: path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])


# What every file holds, in numbers that nothing real has; all finite but the last
WILD_NUMBERS: dict[str, Spoil] = {
    "intrinsics of zeros": with_array("cameras.Ks", np.zeros_like),
    "intrinsics of 1e6": with_array("cameras.Ks", lambda a: a * [[1e9], [1e9], [1]]),
    "views of zeros": with_array("cameras.viewmats", np.zeros_like),
    "views of 3e38": with_array("cameras.viewmats", filled(3e38)),
    "views of 1e300": with_array("cameras.viewmats", filled(1e300)),
    "means of 3e38": with_array("features.means", filled(3e38)),
    "negative weights": with_array("features.weights", filled(-1.0)),
    "negative gains": with_array("features.gains", filled(-1.0)),
    "gains of 1e12": with_array("features.gains", filled(1e12)),
    "an origin of 1e20": with_array("frame.origin", filled(1e20)),
    "a unit of 1e30": with_header(unit=1e30),
    "views of 65536 x 65536": with_header(width=65536, height=65536),
    "views of more pixels than bytes": with_header(width=8000, height=8000),
    "infinity in features.means": with_array("features.means", filled(float("inf"))),
}


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
}
# What is wrong with the header of a state
GSM_HEADERS: dict[str, Spoil] = {
    "networks": with_text("{}", "gsmerge-networks"),
    "no schema": without("schema"),
    "an older schema": with_header(schema=0),
    "a newer schema": with_header(schema=3, gsmerge="9.9"),
    "no settings": without("settings"),
    "settings in a list": with_header(settings=[]),
    "no unit": without("unit"),
    "a unit of zero": with_header(unit=0.0),
    "a unit that is none": with_header(unit=float("nan")),
    "no width": without("width"),
    "views without pixels": with_header(width=0),
    "k of nine": with_settings(k=9),
    "k of words": with_settings(k="many"),
    "most of none": with_settings(max_k=0),
    "an opacity of two": with_settings(min_opacity=2.0),
    "a share that is none": with_settings(min_contribution=float("nan")),
    "a width of true": with_header(width=True),
    "options and batches by number": with_about(options=5, batches=5),
    "a source by number": with_about(source=5),
    "notes in an object": with_about(notes={}),
    "a version of true": with_about(gsmerge=True),
    "a million objects": with_about(notes=[[]] * 3_000_000),
    "harmonics of degree 5": both(
        with_array("features.shN", lambda a: np.zeros((len(a), 35, 3), np.float32)),
        with_array("kept.shN", lambda a: np.zeros((len(a), 35, 3), np.float32)),
    ),
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
