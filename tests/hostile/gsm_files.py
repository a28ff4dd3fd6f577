"""Ways to damage a ``.gsm`` file, of an encoded scene or of a state."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from safetensors.numpy import load_file, save_file

Spoil = Callable[[Path], Any]


def entry(path: Path) -> tuple[str, dict[str, Any]]:
    """The one entry of a file's metadata: its name, which says the format, and the header in it."""
    size = int.from_bytes(path.read_bytes()[:8], "little")
    ((form, text),) = json.loads(path.read_bytes()[8 : 8 + size])["__metadata__"].items()
    return form, dict(json.loads(text))


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


def filled(value: float) -> Callable[[np.ndarray], np.ndarray]:
    def change(array: np.ndarray) -> np.ndarray:
        array = array.copy()
        array.flat[array.size // 2] = value
        return array

    return change


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
