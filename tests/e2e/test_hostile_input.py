"""Every hostile input ends in a result or in one clear line: in bounded time and memory, and nothing is executed."""

from __future__ import annotations

import json
import os
import resource
import shutil
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import pytest
from hostile import CASES, MARKER, Case
from messages import ERROR, names
from tiny_scene import edited_json

from .conftest import Run, listing

SECONDS = 100  # of processor time; what never ends takes more
BYTES = 2**30

COMPACTED = ("one position 1e30", "half of the positions NaN", "colours 1e38", "opacities 1e38", "scales 1e38",
             "rotations 1e38")  # fmt: skip
COMPACTED = tuple(f"ply: {name}" for name in COMPACTED)

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="limits of memory and time as Linux has them")


class TooLong(BaseException):
    """The time is over; no reader can take this for an error of its own."""


@contextmanager
def limits() -> Iterator[None]:
    """A block that may take so many seconds of processor time, and so much memory on top of what is in use."""
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    before = resource.getrlimit(resource.RLIMIT_AS)

    def stop(*_: object) -> None:
        raise TooLong

    handler = signal.signal(signal.SIGPROF, stop)
    resource.setrlimit(resource.RLIMIT_AS, (used + BYTES, before[1]))
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        resource.setrlimit(resource.RLIMIT_AS, before)
        signal.signal(signal.SIGPROF, handler)


@pytest.fixture(scope="module")
def small_scene(make_scene: Callable[..., Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three views of 24 x 16 with cameras and images. Read only."""
    folder = make_scene(tmp_path_factory.mktemp("small") / "scene", num_views=3, width=24, height=16)
    shutil.rmtree(folder / "targets")
    return folder


@pytest.fixture(scope="module", autouse=True)
def warm(small_scene: Path) -> None:
    """What is loaded once is loaded before memory is limited."""
    from gsmerge.cli import main

    assert main(["compact", str(small_scene), "--dry-run"]) == 0


@pytest.fixture
def scene(small_scene: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(small_scene, tmp_path / "scene"))


def one_line(err: str) -> None:
    assert err.startswith(ERROR)
    assert err.endswith("\n")
    assert err.count("\n") == 1
    assert err[:-1].isprintable()
    assert len(err) < 6000
    assert "unexpected" not in err.split(":")[2]


def sweep(cases: dict[str, Case]) -> list[Any]:
    """One in four by default and those with a text, all with -m slow: a tenth of a second each."""
    late = [i % 4 and not case.says for i, case in enumerate(cases.values())]
    return [pytest.param(name, marks=[pytest.mark.slow] * bool(slow)) for name, slow in zip(cases, late, strict=True)]


@pytest.mark.parametrize("name", sweep(CASES))
def test_hostile_input_is_read_or_refused_in_one_line(name: str, scene: Path, run: Run) -> None:
    case = CASES[name]
    arguments = [str(argument) for argument in case.spoil(scene) or [scene]]
    if arguments[0].startswith("-"):
        arguments.insert(0, "--")
    before = listing(scene.parent)
    with limits():
        outcome = run("compact", *([] if case.says else ["--dry-run"]), *arguments)
    assert outcome.code in case.codes, outcome.err
    assert not list(scene.parent.rglob(MARKER))
    assert listing(scene.parent) == before
    if outcome.code == 0:
        assert "gsmerge: warning" not in outcome.err
        return
    assert outcome.out == ""
    one_line(outcome.err)
    assert case.named in outcome.err
    assert names(outcome.err, *case.says), outcome.err


@pytest.mark.parametrize("name", [*list(CASES)[::12], "ply: 600000 rows of one place"])
def test_hostile_input_can_be_inspected(name: str, scene: Path, run: Run) -> None:
    arguments = [str(argument) for argument in CASES[name].spoil(scene) or [scene]]
    with limits():
        actual = run("inspect", "--", arguments[0])
    assert actual.code in (0, 3), actual.err
    if actual.code:
        one_line(actual.err)
    assert not list(scene.parent.rglob(MARKER))


@pytest.mark.parametrize("name", COMPACTED)
def test_odd_values_are_compacted(name: str, scene: Path, run: Run) -> None:
    CASES[name].spoil(scene)
    outcome = run("compact", scene, "-o", scene / "small.ply", "--set", "fit_steps=2", "--quiet", code=0)
    assert "gsmerge: warning" not in outcome.err
    actual = run("inspect", scene / "small.ply", "--json").out
    assert json.loads(actual)["num_nonfinite"] == 0


@pytest.mark.slow
def test_a_frame_of_67_million_pixels_is_drawn_in_bands(scene: Path, run: Run) -> None:
    path = Path(shutil.copy(scene / "transforms.json", scene.parent / "path.json"))
    with edited_json(path) as data:
        focal, data["w"], data["h"] = 8190 / data["w"], 8190, 8190
        data |= {name: focal * data[name] for name in ("fl_x", "fl_y")} | {"cx": 4095, "cy": 4095}
        data["frames"] = data["frames"][:1]
    with limits():
        run("render", scene, "--path", path, "-o", scene / "out", code=0)
    assert cv2.imread(str(scene / "out" / "frame_00000.png"), cv2.IMREAD_REDUCED_GRAYSCALE_8).shape == (1023, 1023)


def test_limits_hold() -> None:
    with pytest.raises(MemoryError), limits():
        bytearray(2 * BYTES)
    with limits():
        assert len(os.urandom(16)) == 16
