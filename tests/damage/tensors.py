"""Damages of states and networks in safetensors files have wrong arrays or wrong parts of the header."""

from __future__ import annotations

import json
import pickle
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import safe_open
from safetensors.numpy import load_file, save_file

from gsmerge.io.formats import gsm

from .case import Change, Damage, refuse
from .changes import edit_bytes, fill_with_zeros, pack_at, pack_members, write

RESULTS = ("means", "quats", "scales", "opacities", "sh0", "shN", "viewmats", "Ks")
FEATURES = ("merged.means", "refined.latents", "views", "group", "samples.means", "saliency", "origin")
WEIGHT = "encoder.latent.weight"


def entry(path: Path) -> tuple[str, dict[str, Any]]:
    """Return the entry of a file's metadata: its name, which says the format, and the header, without checksums."""
    size = int.from_bytes(path.read_bytes()[:8], "little")
    ((form, text),) = json.loads(path.read_bytes()[8 : 8 + size])["__metadata__"].items()
    return form, {name: value for name, value in json.loads(text).items() if name != "checksums"}


def save(path: Path, arrays: dict[str, np.ndarray], form: str, header: Any) -> None:
    """Write a file whose checksums are right, as whoever makes a hostile file makes them."""
    if form == gsm.HEADER and isinstance(header, dict):
        header = header | {"checksums": gsm._checksums(header, arrays)}
    save_file(arrays, path, {form: header if isinstance(header, str) else json.dumps(header)})


def write_header(text: str, form: str | None = None) -> Change:
    """Put another text in place of the header, under the file's own format or another."""
    return lambda path: save(path, load_file(path), form or entry(path)[0], text)


def edit_header(change: Callable[[dict[str, Any]], dict[str, Any]]) -> Change:
    """Change the header."""

    def both(path: Path) -> None:
        form, said = entry(path)
        save(path, load_file(path), form, change(said))

    return both


def set_header(**changes: Any) -> Change:
    return edit_header(lambda said: said | changes)


def set_about(**changes: Any) -> Change:
    return edit_header(lambda said: said | {"about": said["about"] | changes})


def drop_entry(name: str) -> Change:
    return edit_header(lambda said: {key: value for key, value in said.items() if key != name})


def edit_arrays(change: Callable[[dict[str, np.ndarray]], Any]) -> Change:
    """Change the arrays by name, in place."""

    def both(path: Path) -> None:
        (form, said), arrays = entry(path), load_file(path)
        change(arrays)
        save(path, {name: np.ascontiguousarray(array) for name, array in arrays.items()}, form, said)

    return both


def edit_array(name: str, change: Callable[[np.ndarray], np.ndarray]) -> Change:
    return edit_arrays(lambda arrays: arrays.update({name: change(arrays[name])}))


def drop_array(name: str) -> Change:
    return edit_arrays(lambda arrays: arrays.pop(name))


def negate(name: str) -> Change:
    """Change the signs of an array behind the back of its checksum."""

    def change(path: Path) -> None:
        arrays = load_file(path)
        with safe_open(path, "np") as file:
            save_file(arrays | {name: -arrays[name]}, path, file.metadata())

    return change


def fill(name: str, value: float) -> Change:
    """Put another value in the middle of an array."""

    def change(array: np.ndarray) -> np.ndarray:
        array = array.copy()
        array.flat[array.size // 2] = value
        return array

    return edit_array(name, change)


def set_metadata(metadata: object) -> Change:
    """Put another value in the place of the texts by name of a safetensors file."""

    def change(data: bytes) -> bytes:
        end = 8 + int.from_bytes(data[:8], "little")
        head = json.dumps({**json.loads(data[8:end]), "__metadata__": metadata}).encode()
        return len(head).to_bytes(8, "little") + head + data[end:]

    return edit_bytes(change)


def of_any() -> dict[str, Damage]:
    """Return what is wrong with any file."""
    metadata = ([1, "a"], "text", 7, True, {"gsmerge": 1}, {"gsmerge": ["a"]}, {"gsmerge": {"a": "b"}})
    values = (5, [1], None, "\0", "\ud800", "[" * 990 + "]" * 990)
    return {
        "a byte more at the end": refuse(edit_bytes(lambda data: data + b"x")),
        "the last byte cut off": refuse(edit_bytes(lambda data: data[:-1])),
        "a header that claims 2^64 bytes": refuse(pack_at(0, "8s", b"\xff" * 8)),
        "1 TB of zeros in its place": refuse(fill_with_zeros(2**40), "header"),
        "1 TB of zeros after an empty header": refuse(fill_with_zeros(2**40, (2).to_bytes(8, "little") + b"{}")),
        "1 TB of zeros at the end": refuse(fill_with_zeros(2**40, None)),
        "no header": refuse(lambda path: save_file(load_file(path), path)),
        "a header that is no JSON": refuse(write_header("{")),
        "a header that is a list": refuse(write_header("[]")),
        "a header of 100,000 open brackets": refuse(write_header("[" * 100_000)),
        **{f"metadata as {json.dumps(value)}": refuse(set_metadata(value)) for value in metadata},
        **{
            f"a header of {json.dumps(value)[:9]} in the metadata": refuse(set_metadata({gsm.HEADER: value}))
            for value in values
        },
    }


def of_each(arrays: Iterable[str], floats: Iterable[str]) -> dict[str, Damage]:
    """Return damages: each array missing, of another type or shape; those of numbers with a NaN."""
    damages: dict[str, Damage] = {}
    for name in arrays:
        damages[f"no array {name}"] = refuse(drop_array(name), name)
        damages[f"array {name} of another type"] = refuse(
            edit_array(name, lambda a: a.astype(np.float32 if a.dtype == np.float64 else np.float64)), name
        )
        damages[f"array {name} of another shape"] = refuse(edit_array(name, lambda a: a[None]), name)
    return damages | {f"NaN in {name}": refuse(fill(name, float("nan")), name) for name in floats}


def of_results() -> dict[str, Damage]:
    headers = {
        "the header of a file of networks": write_header("{}", "gsmerge-networks"),
        **{f"a header without {name}": drop_entry(name) for name in ("schema", "kind", "width", "names")},
        "schema 0": set_header(schema=0),
        "an unknown kind": set_header(kind="mood"),
        "views without pixels": set_header(width=0),
        "views of 65536 x 65536": set_header(width=65536, height=65536),
        "a width of true": set_header(width=True),
        "about as a list": set_header(about=[]),
        "one name for several views": set_header(names=["a"]),
        "names that are numbers": set_header(names=[1, 2]),
    }
    arrays = {
        "no array images": drop_array("images"),
        "images of fewer rows than the header says": edit_array("images", lambda a: a[:, 1:]),
        "one image fewer than views": edit_array("images", lambda a: a[1:]),
        "harmonics of degree 5": edit_array("shN", lambda a: np.zeros((len(a), 35, 3), np.float32)),
        "NaN in all positions": edit_array("means", lambda a: a * np.float32(np.nan)),
        "intrinsics of zeros": edit_array("Ks", np.zeros_like),
        "poses of zeros": edit_array("viewmats", np.zeros_like),
        "a pose of 1e300": fill("viewmats", 1e300),
    }
    return {
        **{name: refuse(change) for name, change in (headers | arrays).items()},
        **of_each(RESULTS, ("viewmats", "Ks")),
        "schema 2, of the version before": refuse(set_header(schema=2), "run extend again"),
        "schema 9, of a version to come": refuse(set_header(schema=9, gsmerge="9.9"), "update gsmerge"),
        "three million lists in the header": refuse(set_about(notes=[[]] * 3_000_000), slow=True),
        "signs of sh0 changed after it was written": refuse(negate("sh0"), "expected the checksum", place="a.gsm: sh0"),
    }


def of_features() -> dict[str, Damage]:
    changes = {
        "a header without networks": drop_entry("networks"),
        "networks of another size": set_header(networks={"width": 32, "heads": 2, "latent": 4}),
        "a unit of zero": set_header(unit=0.0),
        "a header without unit": drop_entry("unit"),
        "view numbers beyond the views": fill("views", 99),
        "merged view numbers below -1": fill("merged.views", -2),
        "groups of no members": edit_array("num_members", np.zeros_like),
        "samples without pixels": edit_array("samples.opacities", lambda a: a[:, :0]),
        "a merged mean of 3e38": fill("merged.means", 3e38),
    }
    return {
        **{name: refuse(change) for name, change in changes.items()},
        **of_each(FEATURES, ("merged.means", "refined.latents", "group", "saliency", "origin")),
        "signs of merged.sh0 changed after it was written": refuse(
            negate("merged.sh0"), "expected the checksum", place="a.gsm: merged.sh0"
        ),
    }


def of_checkpoint() -> dict[str, Damage]:
    changes = {
        "a file of torch in its place": write(pack_members({"archive/data.pkl": pickle.dumps({"a": 1})})),
        "a header of another program": write_header("{}", "networks"),
        "schema 1": set_header(schema=1),
        "no version": set_header(gsmerge=None),
        "no options": set_header(options=None),
        "unknown options": set_header(options={"depth": 3}),
        "enormous options": set_header(options={"width": 1000000000}),
        "options of another type": set_header(options={"width": "48"}),
        "bounds that bound nothing": set_header(options={"bounds": {"mean": 1e9}}),
        "bounds that are no table": set_header(options={"bounds": 3}),
        "unknown bounds": set_header(options={"bounds": {"far": 1.0}}),
        "sizes other than those of the weights": set_header(options={"width": 64}),
        "training that is no table": set_header(training=3),
        "a tensor too many": edit_arrays(lambda arrays: arrays.update(more=np.ones(1, np.float32))),
        "infinity in a weight": fill(WEIGHT, float("inf")),
    }
    damages = of_any() | of_each([WEIGHT], [WEIGHT]) | {name: refuse(change) for name, change in changes.items()}
    return {name: refuse(d.change, *(d.says or ("expected",)), slow=d.slow) for name, d in damages.items()}


DAMAGES = {
    "gsm to extend": {  # what ``extend`` alone reads
        "a number instead of batches": refuse(set_about(batches=5), "batches"),
        "numbers instead of the batches": refuse(set_about(batches=[5]), "batches"),
    },
    "gsm": of_any() | of_results(),
    "gsm of features": of_features(),
    "checkpoint": of_checkpoint(),
}
