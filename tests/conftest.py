"""Fixtures for the whole suite: scenes that the project makes itself; and how the suite runs in several processes."""

from __future__ import annotations

import gc
import os
import signal
import sys
from collections.abc import Callable, Generator, Iterator
from pathlib import Path
from typing import Any

import pytest
import shared
from browser import NO_BROWSER
from floors import at_least_the_floor
from shared import write_made, write_small
from sweeps import in_words

ROOT = Path(__file__).resolve().parent.parent
MAX_PROCESSES = 8  # a process takes about 1 GB
WORKER = os.environ.get("PYTEST_XDIST_WORKER", "")

# Many containers ask for none, and each process of the run would compile the package and the tests anew
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
# The processes of a run take all processors; threads of each would only wait for one another. No result depends on
# their number, which the tests of that choose themselves
if WORKER:
    os.environ.setdefault("GSMERGE_THREADS", "1")
if not os.access(ROOT, os.W_OK):  # where hypothesis keeps its examples
    import hypothesis

    hypothesis.settings.register_profile("read-only", database=None)
    hypothesis.settings.load_profile("read-only")


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """A process for each processor, or as many as the variable says; for named test files this one alone."""
    if os.environ.get("PYTEST_XDIST_AUTO_NUM_WORKERS"):
        return int(os.environ["PYTEST_XDIST_AUTO_NUM_WORKERS"])
    if any(".py" in argument for argument in config.args):
        return 0
    return min(len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1, MAX_PROCESSES)


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(collector: pytest.Collector) -> Generator[None, pytest.CollectReport, Any]:
    """Every second process collects from the end, so that each compiles half of the tests and reads the other half."""
    report = yield
    if isinstance(collector, pytest.Directory) and WORKER[-1:] in tuple("13579"):
        report.result = report.result[::-1]
    return report


def pytest_make_parametrize_id(val: object) -> str | None:
    """Name cases by their values also where pytest would count them: ``options0`` says nothing."""
    return in_words(val)


def pytest_collection_finish() -> None:
    """Seek no cycles in what stays. Torch has one thread: its own cost more than the sizes of these tests take."""
    gc.collect()
    gc.freeze()
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(1)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put files in order. Tests with the fixture have the mark of that name, which ``measure_floors.py`` finds."""
    items.sort(key=lambda item: item.path)
    for item in items:
        if "floor" in getattr(item, "fixturenames", ()):
            item.add_marker("floor")


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> Generator[None, None, None]:
    """End with a line that nobody overlooks where the pages were not tried in a browser."""
    yield
    skipped = [one for one in terminalreporter.stats.get("skipped", ()) if NO_BROWSER in str(one.longrepr)]
    if skipped:
        files = " and ".join(sorted({one.nodeid.partition("::")[0] for one in skipped}))
        terminalreporter.section("the pages were NOT tested", red=True, bold=True)
        terminalreporter.line(
            f"{len(skipped)} tests were skipped, {NO_BROWSER}: run .ci/chromium, then {files}", red=True
        )


@pytest.fixture(scope="session")
def torch() -> Any:
    """The library; tests that take it are skipped where it is not installed."""
    return pytest.importorskip("torch", reason="torch is not installed")


@pytest.fixture(scope="session")
def root() -> Path:
    """The repository's root."""
    return ROOT


@pytest.fixture(scope="session", autouse=True)
def _shared_folder(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Tell :mod:`shared` which folder all processes of a run share."""
    base = tmp_path_factory.getbasetemp()
    shared.PLACE[:] = [(base.parent if WORKER else base) / "shared"]


@pytest.fixture
def foreground() -> Iterator[None]:
    """Signals do what they do in a shell's foreground, in children too; ``nohup`` and ``&`` let them be ignored."""
    usual = {"SIGINT": signal.default_int_handler, "SIGHUP": signal.SIG_DFL, "SIGTERM": signal.SIG_DFL}
    numbers = {getattr(signal, name): handler for name, handler in usual.items() if hasattr(signal, name)}
    before = {number: signal.signal(number, handler) for number, handler in numbers.items()}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture
def floor(request: pytest.FixtureRequest) -> Callable[..., None]:
    """``floor(value, "what of several")``: at least the floor of ``floors.csv``."""
    name = request.node.nodeid.removeprefix("tests/")
    return lambda value, part="": at_least_the_floor(f"{name}{part and f' {part}'}", float(value))


@pytest.fixture(scope="session")
def made_scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The scene of :func:`shared.write_made`. Read only."""
    return write_made(tmp_path_factory.mktemp("made") / "scene")


@pytest.fixture(scope="session")
def small_scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The scene of :func:`shared.write_small`. Read only."""
    return write_small(tmp_path_factory.mktemp("small") / "scene")


@pytest.fixture
def scene_copy(tmp_path: Path) -> Path:
    """A made scene that a test may change."""
    return write_made(tmp_path / "scene")
