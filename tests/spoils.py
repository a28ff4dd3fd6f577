"""Ways to damage a ``.gsm`` file, of an encoded scene or of a state."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from safetensors.torch import load_file, save_file
from torch import Tensor

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


def with_tensor(name: str, change: Callable[[Tensor], Tensor] | None) -> Spoil:
    def spoil(path: Path) -> None:
        (form, said), tensors = entry(path), load_file(path)
        tensor = tensors.pop(name)
        if change is not None:
            tensors[name] = change(tensor)
        save_file(tensors, path, {form: json.dumps(said)})

    return spoil


def filled(value: float) -> Callable[[Tensor], Tensor]:
    def change(tensor: Tensor) -> Tensor:
        tensor = tensor.clone()
        tensor.view(-1)[len(tensor.view(-1)) // 2] = value
        return tensor

    return change


def cut(share: float) -> Spoil:
    return lambda path: path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
