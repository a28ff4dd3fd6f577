"""Sound files of every kind are cut, filled with zeros, and other content takes their place."""

from __future__ import annotations

import gzip
import io
import pickle
import tarfile
from pathlib import Path, PurePath

from .case import Damage, allow, leave_to_sweep, refuse
from .changes import cut, edit_bytes, edit_entries, fill_with_zeros, pack_members, write, write_json
from .sounds import SOUNDS

TERABYTE = 2**40
BRACKETS = 100_000
LFS = b"version https://git-lfs.github.com/spec/v1\noid sha256:" + b"0" * 64 + b"\nsize 63327587\n"
PAGE = b"\n<!doctype HTML>\n<head><title>\n Virus scan\n warning</title></head>"

# Endings of kinds
WITH_JSON, ZIPPED, TEXTS = (".json", ".sog", ".glb"), (".sog", ".npz"), (".txt",)
SCENES = (".ply", ".spz", ".splat", ".sog", ".npz", ".glb", ".gsm", ".safetensors")
PARTS_MAY_BE_SOUND = (*TEXTS, ".splat")  # rows that are read one by one
ASKED = ("SHARP", "dataparser")  # readers that are asked whether a file has what they know
LINES = ("list of scenes", "values of --set")  # whose lines are damaged at random alone
FILES = [kind for kind, sound in SOUNDS.items() if PurePath(sound.name).suffix and kind not in LINES]


def _archive(add: str) -> bytes:
    stream = io.BytesIO()
    if add == "tar":
        with tarfile.open(fileobj=stream, mode="w") as archive:
            archive.addfile(tarfile.TarInfo("scene.ply"))
        return stream.getvalue()
    return pack_members({"scene.ply": b"ply\n"})


# What stands in the place of files that were copied or downloaded, and what the line says of it
OTHER_CONTENT: dict[str, tuple[bytes, tuple[str, ...]]] = {
    "a pointer of Git LFS": (LFS, ("LFS", "git lfs pull")),
    "a web page": (PAGE, ("web page", "'Virus scan warning'", "download")),
    "a server's error as JSON": (b'{"error": "Not found"}', ("text", "Not found", "download")),
    "a server's error as text": (b"404: Not Found", ("text", "404: Not Found")),
    "a zip": (_archive("zip"), ("zip", "unpack")),
    "a gzip": (gzip.compress(b"ply\n", mtime=0), ("gzip", "unpack")),
    "a tar": (_archive("tar"), ("tar", "unpack")),
    "a 7z": (b"7z\xbc\xaf\x27\x1c\0\4", ("7z", "unpack")),
    "a rar": (b"Rar!\x1a\x07\x01\0", ("rar", "unpack")),
    "a PLY file": (b"ply\nformat ascii 1.0\n", ("PLY", ".ply")),
}
# Where such content is what the kind consists of, so that its own reader says what is wrong
OWN = {"a zip": (".sog", ".npz"), "a gzip": (".spz",), "a PLY file": (".ply", ".safetensors")}


def _pieces(kind: str) -> dict[str, Damage]:
    """Return damages of a file as bytes."""
    outcome = allow if kind == "ply as text" or PurePath(SOUNDS[kind].name).suffix in PARTS_MAY_BE_SOUND else refuse
    shares = {share: outcome(cut(share)) for share in (0.3, 0.9)}
    shares |= leave_to_sweep({share: outcome(cut(share)) for share in (0.0001, 0.05, 0.5)})
    return {
        **{f"cut off after {100 * share:g}%": damage for share, damage in shares.items()},
        "the last thousandth cut off": allow(cut(0.999)),
        "an empty file": refuse(write(b"")),
        **({} if SOUNDS[kind].scene else {"no such file": refuse(Path.unlink, "no such file")}),
        "5,000 zero bytes in its place": refuse(write(bytes(5000))),
        "a pickle in its place": refuse(write(pickle.dumps({"a": 1}) * 9)),
        "bytes of all values in its place": outcome(write(bytes(range(256)))),
        "a byte more at the end": allow(edit_bytes(lambda data: data + b"x")),
        "1 TB of zeros in its place": refuse(fill_with_zeros(TERABYTE)),
        "1 TB of zeros at the end": allow(fill_with_zeros(TERABYTE, None)),
    }


def _other_content(kind: str, suffix: str) -> dict[str, Damage]:
    """Return damages by other content; the line says what it is, except where a kind's own reader refuses it."""
    if suffix in SCENES:
        names = list(OTHER_CONTENT)
    else:
        names = ["a pointer of Git LFS", "a web page"] if suffix in (".json", ".png") else []
    damages = {}
    for name in names:
        data, said = OTHER_CONTENT[name]
        own = kind == "photos" or suffix in OWN.get(name, ())  # of several photos, one is left out in fewer words
        damages[f"{name} in its place"] = refuse(write(data), *(() if own else said))
    return damages


def _json() -> dict[str, Damage]:
    """Return damages of a document of JSON."""
    return {
        "100,000 open brackets as JSON": refuse(write_json(b"[" * BRACKETS)),
        "100,000 objects in one another as JSON": refuse(write_json(b'{"a":' * BRACKETS)),
        "a number of 10,000 digits as JSON": refuse(write_json(b"9" * 10_000)),
        "the number 1e999 as JSON": refuse(write_json(b"1e999")),
        "an open brace as JSON": refuse(write_json(b"{")),
        **{f"{text} as JSON": refuse(write_json(text.encode())) for text in ("[]", "[1]", "{}", "7", '"a"', "null")},
    }


def _archives() -> dict[str, Damage]:
    """Return damages of a zip that holds the file's parts."""
    return {
        "an encrypted archive": allow(edit_entries(6, 8, lambda flags: flags | 1)),
        "an archive of an unknown compression": refuse(edit_entries(8, 10, lambda _: 99), "method 99"),
        "an archive without its members": refuse(edit_bytes(lambda data: data[data.index(b"PK\x01\x02") :])),
    }


def _all(kind: str) -> dict[str, Damage]:
    suffix = PurePath(SOUNDS[kind].name).suffix
    other, first = _other_content(kind, suffix), next(k for k in FILES if SOUNDS[k].name.endswith(suffix))
    damages = _pieces(kind) | (other if kind == first else leave_to_sweep(other))
    damages |= _json() if suffix in WITH_JSON else {}
    damages |= _archives() if suffix in ZIPPED else {}
    if kind in ASKED:
        damages = {name: allow(damage.change) for name, damage in damages.items()}
    return leave_to_sweep(damages) if SOUNDS[kind].rare else damages


DAMAGES: dict[str, dict[str, Damage]] = {kind: _all(kind) for kind in FILES}
