"""Running the command line inside the test's own process."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from batches import FAST, NAMES, InlinePool, finish, results
from forked_commands import CommandServer
from messages import ERROR, says
from shared import make_once

from gsmerge.cli import main

CHART_TARGETS = ("--targets", "{parent}/targets/transforms.json")
CHART_FAST = ("--grid", "budget=1%,2%", "--set", "fit=none", "--set", "lpips=none")


@dataclass(frozen=True)
class Outcome:
    """What a command left behind."""

    code: int
    out: str
    err: str


Run = Callable[..., Outcome]


@pytest.fixture(scope="session")
def smallest_scene(make_scene: Callable[..., Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three views of 24 x 16 with cameras and images. Read only."""
    folder = make_scene(tmp_path_factory.mktemp("smallest") / "scene", num_views=3, width=24, height=16)
    shutil.rmtree(folder / "targets")
    return folder


@pytest.fixture
def small_copy(small_scene: Path, tmp_path: Path) -> Path:
    """A copy of the small scene that a test may change."""
    return Path(shutil.copytree(small_scene, tmp_path / "scene"))


@pytest.fixture
def smallest_copy(smallest_scene: Path, tmp_path: Path) -> Path:
    """A copy of the smallest scene that a test may change."""
    return Path(shutil.copytree(smallest_scene, tmp_path / "scene"))


@pytest.fixture(scope="session")
def compacted_scene(made_scene: Path, shared: Path) -> Path:
    """``small.ply``, which the defaults make of the made scene, and the report ``run.json``. Read only."""

    def make(place: Path) -> None:
        place.mkdir()
        words = ("compact", made_scene, "-o", place / "small.ply", "--json")
        with open(place / "run.json", "w", encoding="utf-8") as report, redirect_stdout(report):
            assert main([str(word) for word in words]) == 0

    return make_once(shared / "compacted", make)


@pytest.fixture(scope="session")
def charted_scene(make_scene: Callable[..., Path], shared: Path) -> Path:
    """A scene ``room``, and ``out`` with the charts of two merges, seconds of drawing. Read only."""

    def make(place: Path) -> None:
        scene = make_scene(place / "room", num_views=3, width=64, height=48)
        words = ("lab", "chart", scene, "-o", place / "out", *CHART_TARGETS, *CHART_FAST, "-q")
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("gsmerge.batch.run.ProcessPool", InlinePool)
            assert main([str(word) for word in words]) == 0

    return make_once(shared / "charted", make)


@pytest.fixture(scope="session")
def server(smallest_scene: Path) -> Iterator[CommandServer]:
    """A process that has imported what the commands need, which takes it two seconds."""
    with CommandServer([("inspect", smallest_scene)]) as server:
        yield server


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    """``run("compact", path, "--k", 2, code=0)``: exit code, which is checked where one is given, stdout, stderr."""

    def call(*arguments: object, code: int | None = None) -> Outcome:
        capsys.readouterr()
        actual = main([str(argument) for argument in arguments])
        captured = capsys.readouterr()
        assert code in (None, actual), f"{actual}: {captured.err}"
        return Outcome(actual, captured.out, captured.err)

    return call


@pytest.fixture(scope="session")
def rooms(make_scene: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four folders with small scenes. Read only."""
    folder = tmp_path_factory.mktemp("batch") / "rooms"
    for name in NAMES:
        make_scene(folder / Path(name).stem, num_views=3, width=96, height=64, seed=NAMES.index(name))
    return folder


@pytest.fixture(scope="session")
def undisturbed(rooms: Path) -> dict[str, str]:
    """What a batch that nothing happens to makes of them."""
    out = rooms.parent / "undisturbed"
    assert finish(rooms, "--output", out, *FAST, "--jobs", 2, "-q") == 0
    assert sorted(results(out)) == NAMES
    return results(out)


def listing(folder: Path) -> dict[str, int]:
    """Every file below a folder with its size, hidden ones too."""
    return {str(p.relative_to(folder)): p.stat().st_size for p in sorted(folder.rglob("*")) if p.is_file()}


def assert_refused(outcome: Outcome, code: int, place: object, *values: object) -> None:
    """One line on stderr, and nothing else, which names a place and has these values (:func:`messages.says`)."""
    assert (outcome.code, outcome.out, outcome.err.count("\n")) == (code, "", 1), outcome.err
    assert outcome.err.startswith(ERROR)
    assert says(outcome.err.removeprefix(ERROR).strip(), place, *values), outcome.err
