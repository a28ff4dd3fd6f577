"""Fixtures run the command line inside the test's own process."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path

import pytest
from batches import FAST, NAMES, finish, results
from forked_commands import CommandServer
from messages import ERROR, says
from shared import make_once, write_made, write_scene, write_small, write_smallest

from gsmerge.cli import main


@dataclass(frozen=True)
class Outcome:
    """What a command left behind."""

    code: int
    out: str
    err: str


Run = Callable[..., Outcome]


@pytest.fixture(scope="session")
def smallest_scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the scene of :func:`shared.write_smallest`. Read only."""
    return write_smallest(tmp_path_factory.mktemp("smallest") / "scene")


@pytest.fixture
def small_copy(tmp_path: Path) -> Path:
    """Return a small scene that a test may change."""
    return write_small(tmp_path / "scene")


@pytest.fixture
def smallest_copy(tmp_path: Path) -> Path:
    """Return a smallest scene that a test may change."""
    return write_smallest(tmp_path / "scene")


@pytest.fixture(scope="session")
def compacted_scene() -> Path:
    """Return ``small.ply``, which the defaults make of the made scene, and the report ``run.json``. Read only."""

    def make(place: Path) -> None:
        place.mkdir()
        words = ("compact", make_once("made", write_made), "-o", place / "small.ply", "--json")
        with open(place / "run.json", "w", encoding="utf-8") as report, redirect_stdout(report):
            assert main([str(word) for word in words]) == 0

    return make_once("compacted", make)


@pytest.fixture(scope="session")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[CommandServer]:
    """Yield a process that has imported what the commands need, which takes it two seconds."""
    with CommandServer([("inspect", write_smallest(tmp_path_factory.mktemp("server") / "scene"))]) as server:
        yield server


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    """Return ``run("compact", path, code=0)``, which gives exit code (checked if given), stdout and stderr."""

    def call(*arguments: object, code: int | None = None) -> Outcome:
        capsys.readouterr()
        actual = main([str(argument) for argument in arguments])
        captured = capsys.readouterr()
        assert code in (None, actual), f"{actual}: {captured.err}"
        return Outcome(actual, captured.out, captured.err)

    return call


def write_rooms(folder: Path) -> None:
    """Write four folders with small scenes."""
    for i, name in enumerate(NAMES):
        write_scene(folder / Path(name).stem, num_views=3, width=96, height=64, seed=i)


@pytest.fixture(scope="session")
def rooms() -> Path:
    """Return the folder of :func:`write_rooms`. Read only."""
    return make_once("four-rooms", write_rooms)


@pytest.fixture(scope="session")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Return what a batch that nothing happens to makes of the four rooms."""
    out = tmp_path_factory.mktemp("batch") / "undisturbed"
    assert finish(make_once("four-rooms", write_rooms), "--output", out, *FAST, "--jobs", 2, "-q") == 0
    assert sorted(results(out)) == NAMES
    return results(out)


def listing(folder: Path) -> dict[str, int]:
    """Return every file below a folder with its size, hidden ones too."""
    return {str(p.relative_to(folder)): p.stat().st_size for p in sorted(folder.rglob("*")) if p.is_file()}


def assert_refused(outcome: Outcome, code: int, place: object, *values: object) -> None:
    """Check for one line on stderr alone, which names a place and has these values (:func:`messages.says`)."""
    assert (outcome.code, outcome.out, outcome.err.count("\n")) == (code, "", 1), outcome.err
    assert outcome.err.startswith(ERROR)
    assert says(outcome.err.removeprefix(ERROR).strip(), place, *values), outcome.err
