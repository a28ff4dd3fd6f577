"""Every damaged file ends in a result or in one clear line: in bounded time and memory, and nothing is executed.

The table of sound files and of what is done to them is in ``tests/damage``. The default run tries much that is quick,
in this process. The sweep tries the rest, most of it in processes of their own within limits of time and memory. It
asks ``inspect``, too, which refuses by the same line what ``compact`` refuses.
"""

from __future__ import annotations

import os
import re
import shutil
import signal
import sys
from pathlib import Path

import cv2
import pytest
from damage import DAMAGES, SOUNDS, generic
from damage.arrays import MARKER
from damage.sounds import COMPACT, INSPECT, OF_CAMERAS, TINY
from forked_commands import FAILED, CommandServer, Limits, Outcome, refused_by_inspect, run_forked
from messages import ERROR, names, says
from sweeps import sweep
from tiny_scene import edited_json

from gsmerge.cli import main
from gsmerge.errors import SceneError
from gsmerge.io import read_ply

from .conftest import Run, listing

FREE_MEMORY, MEMORY_PER_BYTE = 64e6, 20  # the budget of a reader, as SECURITY.md has it
FREE_SECONDS, SECONDS_PER_BYTE = 5, 2e-6
SANITIZED = "libasan" in os.environ.get("LD_PRELOAD", "")  # which keeps what is freed
MEMORY_MARGIN, SECONDS_MARGIN = 20 if SANITIZED else 2, 10  # a scene is read and placed; a slow machine
MOST_SECONDS, MOST_MEMORY = 100, 2**30  # of sparse files, whose budget is more than a machine has
OPTIONS = {"-o", "--images"}  # what they name is nothing for ``inspect``
# One or two of each kind of harm, that take little time: in the default run within limits, too
OFTEN = (
    "scene.ply: a count of 9223372036854775808", "scene.ply: NaN in half of the positions",
    "scene.ply: 8 GB of zeros as lists", "glb: 100,000 nodes with the same Gaussians",
    "sog: a million equal Gaussians", "spz: 500,000 equal Gaussians of degree 4",
    "splat: 1 TB of zeros in its place", "gsm: 1 TB of zeros in its place", "Streamed SOG: one chunk by two names",
    "transforms.json: a photo's path that is a device",
    "transforms.json: a camera_model of 3 MB for 10,000 frames with poses",
    "COLMAP binary: an image with 18446744073709551615 points",
    "COLMAP binary: a camera 60000 pixels wide",
    "views.npz: poses as objects that would run code", "results.npz: zeros as photos of 1400 x 1400 floats",
    "photos: a PNG that claims 60000 x 60000",
    "scene: a folder named with line breaks", "scene: scene.ply as a pipe", "scene: images as a link to itself",
    "scene: the device /dev/zero as cameras", "scene: the output as a pipe",
)  # fmt: skip
HOSTILE = ("1 TB", "100,000", "10,000 digits", "1e999")  # of what is done to every kind, this may take time or memory
# Of the rest, which shortens a file or puts bytes in its place, a third is tried within limits: of each kind others
UNLIMITED = {
    f"{kind}: {name}"
    for number, (kind, damages) in enumerate(generic.DAMAGES.items())
    for i, name in enumerate(damages)
    if SOUNDS[kind].words and (i + number) % 3 and not any(words in name for words in HOSTILE)
}
QUICK = [name for name, (_, damage) in DAMAGES.items() if not damage.slow]
BY_COMMANDS = [name for name, (kind, _) in DAMAGES.items() if SOUNDS[kind].words and name not in UNLIMITED]
# Of what the sweep tries within limits, with the same checks, a third is in the default run
QUICK = [name for i, name in enumerate(QUICK) if i % 3 == 0 or name not in BY_COMMANDS]
COMPACTED = ("one position of 1e30", "NaN in half of the positions", "opacities of 1e38", "rotations of 1e38")

of_linux = pytest.mark.skipif(sys.platform != "linux", reason="limits of memory and time as Linux has them")


def limits(num_bytes: int) -> Limits:
    """Return limits far above what a reader of so many bytes may take."""
    seconds = SECONDS_MARGIN * (FREE_SECONDS + SECONDS_PER_BYTE * num_bytes)
    return Limits(MOST_MEMORY + min(MEMORY_PER_BYTE * num_bytes, MOST_MEMORY), min(seconds, MOST_SECONDS))


def size_of(folder: Path) -> int:
    return sum(path.lstat().st_size for path in folder.rglob("*") if path.is_file())


def spoil(name: str, folder: Path, *, quick: bool = False) -> tuple[Path, list[str]]:
    """Make a sound file and damage it -> its path, and the command with its arguments.

    ``quick``: cameras are read by ``inspect``, without the Gaussians beside them, which take a tenth of a second.
    """
    kind, damage = DAMAGES[name]
    sound = SOUNDS[kind]
    path = sound.put(folder / "scene")
    other = damage.change(path)
    if quick and sound.scene is OF_CAMERAS and not damage.in_scene:
        return path, ["inspect", str(path)]
    target = folder / "scene" if sound.scene else path
    arguments = [str(argument) for argument in (other if isinstance(other, list) else [target])]
    words = sound.words[: 1 if damage.compacts else None]
    return path, [*words, *arguments]


def one_line(err: str) -> None:
    assert err.startswith(ERROR)
    assert err.endswith("\n")
    assert err.count("\n") == 1
    assert err[:-1].isprintable()
    assert len(err) < 6000
    assert "unexpected" not in err.split(":")[2]


def check(outcome: Outcome, name: str, path: Path) -> None:
    """Check that a command did what is expected of a damage: the exit code, and the only line on stderr."""
    assert outcome.code in (0, 2, 3), outcome
    kind, damage = DAMAGES[name]
    places = [damage.place] if damage.place else [place for place in (path.name, SOUNDS[kind].named) if place]
    if outcome.code == 0 and 0 not in damage.codes:  # of files beside the Gaussians, what is refused is left out
        lines = [line for line in (outcome.out + outcome.err).split("\n") if re.search(" (is|are) left out: ", line)]
        assert len(lines) == 1, outcome
        one_line(f"{ERROR}{lines[0]}\n")
        assert any(place in lines[0] for place in places)
        assert names(lines[0], *damage.says)
        return
    assert outcome.code in damage.codes, outcome.err
    if outcome.code == 0:
        assert "gsmerge: warning" not in outcome.err
        return
    one_line(outcome.error)
    line = outcome.error.removeprefix(ERROR).strip()
    if damage.codes == (3,) and "out of memory" not in line:
        assert any(says(line, place, *damage.says) for place in places), outcome.err


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


@pytest.mark.parametrize("kind", SOUNDS)
def test_sound_files_are_read(kind: str, tmp_path: Path, run: Run) -> None:
    sound = SOUNDS[kind]
    path = sound.put(tmp_path / "scene")
    sound.read(path)
    if sound.words:
        run(*sound.words, tmp_path / "scene" if sound.scene else path, code=0)


@sweep("name", [*QUICK, *sorted(UNLIMITED - {*QUICK})], often=len(QUICK))
def test_damaged_files_are_read_or_refused_in_one_line(
    name: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (kind, damage), (path, words) = DAMAGES[name], spoil(name, tmp_path, quick=True)
    before = listing(tmp_path)
    capfd.readouterr()
    if words[0] in ("compact", "inspect"):
        code, said = main(words), ""
    else:
        try:
            SOUNDS[kind].read(path)
            code, said = 0, ""
        except SceneError as error:
            code, said = 3, f"{ERROR}{error}\n"
    out, err = capfd.readouterr()
    assert not err or kind != "photo.png"  # whose library would print what it thinks of it
    check(Outcome(code, out, err + said, 0, 0), name, path)
    assert not list(tmp_path.rglob(MARKER))
    if damage.compacts and code == 0:
        return
    assert listing(tmp_path) == before


@of_linux
@sweep("name", sorted(BY_COMMANDS, key=lambda name: name not in OFTEN), often=len(OFTEN))
def test_damaged_files_are_read_within_a_budget(name: str, tmp_path: Path, server: CommandServer) -> None:
    damage, (path, words) = DAMAGES[name][1], spoil(name, tmp_path)
    before, num_bytes = listing(tmp_path), size_of(tmp_path)
    outcome = server.run(words, limits(num_bytes))
    within_budget(outcome, num_bytes, describes=words[0] == INSPECT[0])
    check(outcome, name, path)
    assert not list(tmp_path.rglob(MARKER))
    if damage.compacts and outcome.code == 0:
        return
    assert listing(tmp_path) == before
    if outcome.code == 3 and words[0] == COMPACT[0] and not damage.other_kind and not OPTIONS & {*words}:
        files = [word for word in words[1:] if not word.startswith("--")]
        checked = server.run(["inspect", "--quiet", "--", *files], limits(num_bytes))
        within_budget(checked, num_bytes)
        refused_by_inspect(outcome, checked)


@of_linux
@sweep("name", ["glb: values of 2^62 bytes", "scene.ply: 600,000 equal rows", *BY_COMMANDS[::9]])
def test_damaged_files_can_be_inspected(name: str, tmp_path: Path, server: CommandServer) -> None:
    words = spoil(name, tmp_path)[1]
    num_bytes = size_of(tmp_path)
    target = next(word for word in words[1:] if not word.startswith("-"))
    outcome = server.run(["inspect", "--", target], limits(num_bytes))
    within_budget(outcome, num_bytes, describes=True)
    assert not list(tmp_path.rglob(MARKER))


@sweep("name", COMPACTED)
def test_files_of_odd_values_are_compacted_to_finite_gaussians(name: str, tmp_path: Path, run: Run) -> None:
    scene = spoil(f"scene.ply: {name}", tmp_path)[0].parent
    outcome = run("compact", scene, "-o", scene / "small.ply", "--set", "fit_steps=2", "--quiet", code=0)
    assert "gsmerge: warning" not in outcome.err
    assert read_ply(scene / "small.ply").info.num_nonfinite == 0


@of_linux
@pytest.mark.slow
def test_a_frame_of_67_million_pixels_is_drawn_in_bands(tmp_path: Path, server: CommandServer) -> None:
    scene = TINY.save(tmp_path / "scene")
    path = Path(shutil.copy(scene / "transforms.json", tmp_path / "path.json"))
    with edited_json(path) as data:
        focal, data["w"], data["h"] = 8190 / data["w"], 8190, 8190
        data |= {name: focal * data[name] for name in ("fl_x", "fl_y")} | {"cx": 4095, "cy": 4095}
        data["frames"] = data["frames"][:1]
    words = ["render", str(scene), "--path", str(path), "-o", str(scene / "out")]
    assert server.run(words, Limits(MOST_MEMORY, MOST_SECONDS)).code == 0
    assert cv2.imread(str(scene / "out" / "frame_00000.png"), cv2.IMREAD_REDUCED_GRAYSCALE_8).shape == (1023, 1023)


@of_linux
def test_forked_process_ends_at_its_limits_of_memory_and_time() -> None:
    """A process that takes more ends, however it ends."""
    limits = Limits(1 << 28, 0.3)
    assert run_forked(lambda: len(bytearray(1 << 30)), limits).code == FAILED
    filled = run_forked(lambda: len(bytearray(b"x") * (1 << 26)) >> 26, limits)
    assert filled.code == 1
    assert 6e7 < filled.peak < 1.2e8
    assert run_forked(lambda: sum(iter(int, 1)), limits).code == -signal.SIGPROF
