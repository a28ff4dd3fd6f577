"""Every hostile input ends in a result or in one clear line: in bounded time and memory, and nothing is executed.

Each runs in a process of its own. What ``compact`` refuses, ``inspect`` refuses by the same line.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import sys
from pathlib import Path

import cv2
import pytest
from forked_commands import FAILED, CommandServer, Limits, Outcome, refused_by_inspect, run_forked
from hostile import CASES, MARKER
from hostile.case import Case
from messages import ERROR, names
from sweeps import sweep
from tiny_scene import edited_json

from .conftest import Run, listing

FREE_MEMORY, MEMORY_PER_BYTE = 64e6, 20  # the budget of a reader, as SECURITY.md has it
FREE_SECONDS, SECONDS_PER_BYTE = 5, 2e-6
SANITIZED = "libasan" in os.environ.get("LD_PRELOAD", "")  # which keeps what is freed
MEMORY_MARGIN, SECONDS_MARGIN = 20 if SANITIZED else 2, 10  # a scene is read and placed; a slow machine
MOST_SECONDS, MOST_MEMORY = 100, 2**30  # of sparse files, whose budget is more than a machine has
OPTIONS = {"-o", "--images"}  # what they name is nothing for ``inspect``
FOR_OTHER_REASONS = ("nothing where the scene was", "the ply as cameras")  # sound files of another kind than expected
# One or two of each kind, and of each kind of harm, that take little time: the default run; all others are in the sweep
OFTEN = (
    "ply: count 9223372036854775808", "ply: half of the positions NaN", "ply: 8 GB of zeros as lists",
    "glb: copies without end", "sog: a million equal Gaussians", "spz: half a million of degree 4",
    "splat: 1 TB of zeros", "gsm: 1 TB of zeros", "lod: a chunk by two names",
    "transforms: path that is a device, no images", "transforms.json: large model, 10,000 frames with poses",
    "cameras: inside the ply, of spaces", "cameras: images.bin, 18446744073709551615 points",
    "views.npz: poses as an object", "results.npz: a bomb of floats", "image: PNG that claims 60000 x 60000",
    "image: .tiff masks of a tile of 26000 x 26000, <", "folder with line breaks", "scene.ply as a pipe",
    "images as a loop", "a device as cameras", "output out.ply, a pipe",
)  # fmt: skip
NAMES = sorted(CASES, key=lambda name: name not in OFTEN)
COMPACTED = ("one position 1e30", "half of the positions NaN", *(f"{what} 1e38" for what in ("colours", "opacities",
             "scales", "rotations")))  # fmt: skip

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="limits of memory and time as Linux has them")


def limits(num_bytes: int) -> Limits:
    """Far more than a reader of so many bytes may take."""
    seconds = SECONDS_MARGIN * (FREE_SECONDS + SECONDS_PER_BYTE * num_bytes)
    return Limits(MOST_MEMORY + min(MEMORY_PER_BYTE * num_bytes, MOST_MEMORY), min(seconds, MOST_SECONDS))


def size_of(folder: Path) -> int:
    return sum(path.lstat().st_size for path in folder.rglob("*") if path.is_file())


@pytest.fixture
def scene(smallest_copy: Path) -> Path:
    return smallest_copy


def one_line(err: str) -> None:
    assert err.startswith(ERROR)
    assert err.endswith("\n")
    assert err.count("\n") == 1
    assert err[:-1].isprintable()
    assert len(err) < 6000
    assert "unexpected" not in err.split(":")[2]


def within_budget(outcome: Outcome, num_bytes: int, *, describes: bool = False) -> None:
    """Check that a command ended by itself, had the memory it asked for, and took no more than its readers may.

    ``describes``: it says what it could read of what is refused.
    """
    assert outcome.code in (0, 2, 3), outcome
    budget = MEMORY_MARGIN * (FREE_MEMORY + MEMORY_PER_BYTE * num_bytes)
    assert outcome.peak < budget, f"{outcome.peak / 1e6:.0f} MB of {budget / 1e6:.0f}"
    assert "out of memory" not in outcome.err or budget > MOST_MEMORY
    if outcome.code:
        assert outcome.out == "" or (describes and outcome.out.startswith("file "))
        one_line(outcome.error)


def left_out(outcome: Outcome, case: Case) -> None:
    """Check that what was refused of files beside the Gaussians is named in one line."""
    lines = [line for line in (outcome.out + outcome.err).split("\n") if re.search(" (is|are) left out: ", line)]
    assert len(lines) == 1, outcome
    assert lines[0].isprintable()
    assert len(lines[0]) < 6000
    assert case.named in lines[0]
    assert names(lines[0], *case.says)


@sweep("name", NAMES, often=len(CASES.keys() & OFTEN))
def test_hostile_input_is_read_or_refused_in_one_line(name: str, scene: Path, server: CommandServer) -> None:
    case = CASES[name]
    arguments = [str(argument) for argument in case.spoil(scene) or [scene]]
    end_of_options = ["--"] * arguments[0].startswith("-")
    before, num_bytes = listing(scene.parent), size_of(scene.parent)
    words = ["compact", *([] if case.says else ["--dry-run"]), *end_of_options, *arguments]
    outcome = server.run(words, limits(num_bytes))
    within_budget(outcome, num_bytes)
    assert not list(scene.parent.rglob(MARKER))
    if outcome.code == 0 and 0 not in case.codes:
        left_out(outcome, case)
        return
    assert outcome.code in case.codes, outcome.err
    assert listing(scene.parent) == before
    if outcome.code == 0:
        assert "gsmerge: warning" not in outcome.err
        return
    assert case.named in outcome.err
    assert names(outcome.err, *case.says), outcome.err
    if outcome.code == 3 and name not in FOR_OTHER_REASONS and not OPTIONS & {*arguments}:
        files = [argument for argument in arguments if argument != "--cameras"]
        check = server.run(["inspect", "--quiet", "--", *files], limits(num_bytes))
        within_budget(check, num_bytes)
        refused_by_inspect(outcome, check)


@sweep("name", ["glb: a length of 2^62", "ply: 600000 rows of one place", *list(CASES)[::9]])
def test_hostile_input_can_be_inspected(name: str, scene: Path, server: CommandServer) -> None:
    arguments = [str(argument) for argument in CASES[name].spoil(scene) or [scene]]
    num_bytes = size_of(scene.parent)
    outcome = server.run(["inspect", "--", arguments[0]], limits(num_bytes))
    within_budget(outcome, num_bytes, describes=True)
    assert not list(scene.parent.rglob(MARKER))


@sweep("name", COMPACTED)
def test_odd_values_are_compacted(name: str, scene: Path, run: Run) -> None:
    CASES[f"ply: {name}"].spoil(scene)
    outcome = run("compact", scene, "-o", scene / "small.ply", "--set", "fit_steps=2", "--quiet", code=0)
    assert "gsmerge: warning" not in outcome.err
    actual = run("inspect", scene / "small.ply", "--json").out
    assert json.loads(actual)["num_nonfinite"] == 0


@pytest.mark.slow
def test_a_frame_of_67_million_pixels_is_drawn_in_bands(scene: Path, server: CommandServer) -> None:
    path = Path(shutil.copy(scene / "transforms.json", scene.parent / "path.json"))
    with edited_json(path) as data:
        focal, data["w"], data["h"] = 8190 / data["w"], 8190, 8190
        data |= {name: focal * data[name] for name in ("fl_x", "fl_y")} | {"cx": 4095, "cy": 4095}
        data["frames"] = data["frames"][:1]
    words = ["render", str(scene), "--path", str(path), "-o", str(scene / "out")]
    assert server.run(words, Limits(MOST_MEMORY, MOST_SECONDS)).code == 0
    assert cv2.imread(str(scene / "out" / "frame_00000.png"), cv2.IMREAD_REDUCED_GRAYSCALE_8).shape == (1023, 1023)


def test_limits_hold() -> None:
    """A process that takes more ends, however it ends."""
    limits = Limits(1 << 28, 0.3)
    assert run_forked(lambda: len(bytearray(1 << 30)), limits).code == FAILED
    filled = run_forked(lambda: len(bytearray(b"x") * (1 << 26)) >> 26, limits)
    assert filled.code == 1
    assert 6e7 < filled.peak < 1.2e8
    assert run_forked(lambda: sum(iter(int, 1)), limits).code == -signal.SIGPROF
