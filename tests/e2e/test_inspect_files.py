"""``gsmerge inspect`` calls sound files of every format ok, and names every kind of fault by its cause."""

from __future__ import annotations

import json
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from damage.tensors import negate
from former_formats import compressed_bytes
from messages import ERROR, says
from shared import write_smallest
from sweeps import sweep

import gsmerge
from gsmerge.cli import main
from gsmerge.io import write_gaussians
from gsmerge.method.networks.checkpoint import IN_PACKAGE

from .conftest import Run, assert_refused, listing

# The last two without cameras, among whose views their rows would be looked for at length
FORMATS = ("scene.ply", "a.spz", "a.splat", "away/a.compressed.ply", "away/a.sog")
OTHERS = ("state.gsm", "networks.safetensors", "transforms.json", "views.npz")
Spoil = Callable[[Path], object]


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a sound file of every kind. Read only."""
    folder = write_smallest(tmp_path_factory.mktemp("sound") / "room")
    (folder / "away").mkdir()
    for name in FORMATS[1:]:
        gaussians = gsmerge.read_ply(folder / "scene.ply").gaussians
        if name.endswith(".compressed.ply"):
            (folder / name).write_bytes(compressed_bytes(gaussians))
        else:
            write_gaussians(folder / name, gaussians)
    shutil.copy(IN_PACKAGE["shipped"], folder / "networks.safetensors")
    cameras = gsmerge.read_cameras(folder / "transforms.json")
    np.savez(folder / "views.npz", extrinsics=cameras.viewmats[:, :3], intrinsics=cameras.Ks)
    small = ["--set", "superpixels=60", "--set", "checkpoint=none", "--quiet"]
    assert main(["extend", str(folder / "state.gsm"), str(folder), *small]) == 0
    return folder


def test_inspect_calls_sound_files_ok(sound: Path, run: Run) -> None:
    before = listing(sound)
    done = run("inspect", *(sound / name for name in (*FORMATS, *OTHERS)), code=0)
    assert [line.split(": ")[0] for line in done.out.splitlines()] == [
        f"ok     {sound / name}" for name in (*FORMATS, *OTHERS)
    ]
    assert "scene.ply: 1,152 Gaussians, 17-column export, 3 cameras, 3 photos" in done.out
    assert "views.npz: 3 cameras" in done.out
    assert run("inspect", sound / "a.spz", "-q", code=0).out == ""
    assert listing(sound) == before


def test_json_of_inspect_describes_sound_and_missing_files(sound: Path, run: Run, tmp_path: Path) -> None:
    done = run("inspect", sound / "scene.ply", tmp_path / "none.spz", "--json")
    assert done.code == 3
    document = json.loads(done.out)
    first, second = document["files"]
    assert (first["kind"], first["count"], first["problems"]) == ("Gaussians", 1152, [])
    assert first["file_bytes"] == (sound / "scene.ply").stat().st_size
    assert (second["kind"], second["problems"], document["num_wrong"]) == ("", ["no such file or folder"], 1)
    assert says(done.err.removeprefix(ERROR), tmp_path / "none.spz", "no such file", "1 of 2")


def flip(place: int) -> Spoil:
    """Flip one bit of the byte at a place, from the end where it is negative."""

    def spoil(path: Path) -> None:
        data = bytearray(path.read_bytes())
        data[place] ^= 1
        path.write_bytes(data)

    return spoil


def member_bit(path: Path) -> None:
    """Flip one bit in a file of an archive."""
    with zipfile.ZipFile(path) as archive:
        info = archive.infolist()[-1]
    flip(info.header_offset + 30 + len(info.filename) + info.compress_size // 2)(path)


# How a sound file is spoiled, the place in it that is named, if any, and the values
WRONG: dict[str, tuple[Any, ...]] = {
    "fewer rows": (
        "scene.ply",
        lambda path: path.write_bytes(path.read_bytes()[:40_000]),
        "truncated or damaged",
        "'vertex'",
        1152,
    ),
    "the stream's checksum": ("a.spz", flip(-6), "", "gzip", ".spz"),
    "half a splat": ("a.splat", lambda path: path.write_bytes(path.read_bytes()[:-5]), "", "32 bytes"),
    "a bit of a sog": ("away/a.sog", member_bit, "", "CRC-32"),
    "a bit of an npz": ("views.npz", member_bit, "", "CRC-32"),
    "a bit of a gsm": ("state.gsm", flip(-9), "", "checksum"),
    "an array of a gsm": ("state.gsm", negate("means"), "means", "checksum"),
    "no file": ("scene.ply", Path.unlink, "", "no such file"),
}


@pytest.mark.parametrize("case", WRONG)
def test_inspect_names_the_cause_of_a_wrong_file(case: str, sound: Path, tmp_path: Path, run: Run) -> None:
    name, spoil, place, *found = WRONG[case]
    path = Path(shutil.copy(sound / name, tmp_path))
    spoil(path)
    assert_refused(run("inspect", path, "-q"), 3, f"{path}{place and ': '}{place}", *found)
    done = run("inspect", path, sound / "a.spz")
    assert (done.code, done.out.startswith(f"wrong  {path}: ")) == (3, True)
    assert says(done.err.splitlines()[-1].removeprefix(ERROR), path, "refused", "1 of 2")


# What no result is left of, and beside it what is sound, as are Gaussians that are tiny for their views
@sweep(
    ("name", "value", "code"),
    [("opacities", 1e-5, 3), ("opacities", 1e-4, 0), ("scales", 1e-13, 0), ("scales", 0.01, 0), ("means", 1e6, 0),
     ("opacities", 0, 3), ("opacities", 1e-13, 3)], often=2,
)  # fmt: skip
def test_a_scene_that_shows_nothing_is_refused(
    name: str, value: float, code: int, smallest_scene: Path, tmp_path: Path, run: Run
) -> None:
    scene = Path(shutil.copytree(smallest_scene, tmp_path / "room"))
    gaussians = gsmerge.read_ply(scene / "scene.ply").gaussians
    array = getattr(gaussians, name)
    array[:] = array * value if name == "means" else value
    gsmerge.write_ply(scene / "scene.ply", gaussians, overwrite=True)
    run("compact", scene, "-o", tmp_path / "out.ply", "-q", code=code)


def test_gaussians_that_no_view_shows_are_counted_in_results_alone(small_scene: Path, tmp_path: Path, run: Run) -> None:
    """Rows of pixels hide each other where views overlap: their cameras show them all the same."""
    out = tmp_path / "compact.ply"
    run("compact", small_scene, "-o", out, "--fit", "none", code=0)
    run("convert", small_scene / "scene.ply", tmp_path / "scene.ply", code=0)  # which says who wrote it
    files, views = (out, tmp_path / "scene.ply"), ("--cameras", small_scene)
    documents = [json.loads(run("inspect", file, *views, "--json", code=0).out) for file in files]
    assert [document["num_unseen"] is None for document in documents] == [False, True]
