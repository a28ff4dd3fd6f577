"""What nobody foresaw ends in one line and the right code, with a traceback on request and no half-written file."""

from __future__ import annotations

import ctypes
import errno
import itertools
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from messages import ERROR
from sweeps import sweep

import gsmerge
from gsmerge.errors import OUT_OF_MEMORY, SceneError
from gsmerge.io import write_gaussians

from .conftest import Run, assert_refused, listing


class Broken:
    """Stands in for a stage and fails."""

    def __init__(self, error: BaseException) -> None:
        self.error = error

    def __call__(self, *_: object, **__: object) -> None:
        raise self.error


@pytest.mark.parametrize(
    ("error", "code", "line"),
    [
        (KeyError("lost"), 1, "unexpected error: KeyError: 'lost'; run again with --debug"),
        (ValueError("two\nlines"), 1, "unexpected error: ValueError: two; run again with --debug"),
        (MemoryError(), 3, OUT_OF_MEMORY),
        (cv2.error("OpenCV: error: (-4:Insufficient memory) Failed to allocate 9 bytes"), 3, OUT_OF_MEMORY),
        (ImportError("a.so: failed to map segment from shared object"), 3, OUT_OF_MEMORY),
        (PermissionError(13, "Denied", "a/b"), 3, "a/b: cannot be read or written (Denied)"),
        (KeyboardInterrupt(), 130, "interrupted"),
    ],
    ids=[
        "an unexpected KeyError",
        "an unexpected error of two lines",
        "no memory",
        "no memory in OpenCV",
        "no memory for a library",
        "no permission for a file",
        "Ctrl-C",
    ],
)
def test_failure_of_a_stage_is_one_line_with_its_exit_code(
    error: BaseException, code: int, line: str, smallest_copy: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gsmerge.run.compact_scene", Broken(error))
    before = listing(smallest_copy)
    outcome = run("compact", smallest_copy, "--quiet")
    assert (outcome.code, outcome.err, outcome.out) == (code, f"{ERROR}{line}\n", "")
    assert listing(smallest_copy) == before


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="the superuser may write anywhere")
def test_folder_without_permission_is_refused(smallest_copy: Path, run: Run) -> None:
    locked = smallest_copy / "locked"
    locked.mkdir(mode=0o500)
    assert_refused(run("compact", smallest_copy, "-o", locked / "small.ply"), 3, locked / "small.ply", "no permission")
    assert list(locked.iterdir()) == []


@pytest.mark.parametrize(
    ("file", "reader"),
    [
        ("scene.ply", "gsmerge.io.formats.rows.FileRows.__getitem__"),
        ("scene.sog", "gsmerge.io.formats.sog._read_packed"),
        ("scene.spz", "gsmerge.io.formats.spz._unpack"),
        ("views.npz", "numpy.lib.format.read_array"),
    ],
    ids=["scene.ply", "scene.sog", "scene.spz", "views.npz"],
)
def test_a_lack_of_memory_is_no_damage(
    file: str, reader: str, smallest_copy: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = smallest_copy / file
    if path.suffix == ".npz":
        np.savez(path, extrinsics=np.eye(4)[None], intrinsics=np.eye(3)[None])
        words: tuple[object, ...] = ("inspect", smallest_copy / "scene.ply", "--cameras", path)
    else:
        write_gaussians(path, gsmerge.read_ply(smallest_copy / "scene.ply").gaussians, overwrite=True)
        words = ("inspect", path)
    monkeypatch.setattr(reader, Broken(MemoryError("Unable to allocate 9 GiB")))
    assert_refused(run(*words), 3, "", OUT_OF_MEMORY)


@pytest.mark.parametrize(
    "words",
    ["compact nowhere.ply", "compact {} nowhere.ply", "compact nowhere.ply {}", "inspect nowhere.ply",
     "convert {} nowhere.ply -o out.ply", "render {} nowhere.ply -o out.png", "view nowhere.ply",
     "evaluate {} nowhere.ply", "batch nowhere.ply -o out", "compact {} --cameras nowhere.ply"],
)  # fmt: skip
def test_a_missing_file_is_bad_input_in_every_command(words: str, smallest_copy: Path, run: Run) -> None:
    scene = str(smallest_copy / "scene.ply")
    assert_refused(run(*(scene if word == "{}" else word for word in words.split())), 3, "nowhere.ply", "no such file")


def test_debug_shows_the_traceback(smallest_copy: Path, run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gsmerge.run.compact_scene", Broken(KeyError("lost")))
    outcome = run("compact", smallest_copy, "--quiet", "--debug", code=1)
    assert outcome.err.startswith("Traceback (")
    assert "Traceback" not in run("compact", smallest_copy, "--quiet").err  # and is forgotten by the next call


@pytest.mark.parametrize("kind", ["compact", "extend", "compact a state"])
def test_failures_while_writing_leave_nothing(
    kind: str, smallest_copy: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    def half(path: Path | object, *_: object, **__: object) -> None:
        if isinstance(path, Path):
            path.write_bytes(b"ply\n")
        raise OSError(28, "No space left on device")

    quick, state = ("--set", "superpixels=40"), smallest_copy / "kept.gsm"
    words, name = {
        "compact": (("compact", smallest_copy, *quick, "--fit", "none"), "scene.compact.ply"),
        "extend": (("extend", smallest_copy / "new.gsm", smallest_copy, *quick), "new.gsm"),
        "compact a state": (("compact", state, "--fit", "none"), "kept.compact.ply"),
    }[kind]
    if kind == "compact a state":
        assert run("extend", state, smallest_copy, *quick).code == 0
    monkeypatch.setattr("gsmerge.io.formats.write._write_ply", half)
    monkeypatch.setattr("gsmerge.io.formats.gsm.save", half)
    before = listing(smallest_copy)
    outcome = run(*words, "--quiet", code=3)
    assert outcome.err.count("\n") == 1
    assert name in outcome.err
    assert "No space" in outcome.err
    assert listing(smallest_copy) == before


@pytest.mark.parametrize("more", [("--levels", 2), ()])
def test_several_outputs_are_all_there_or_none(
    more: tuple[object, ...], smallest_copy: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A disk that is full at the second level, or at the end."""
    from gsmerge.io.formats import write

    calls, kept = itertools.count(), write._write_ply

    def full(path: Path, *arguments: Any) -> None:
        if next(calls) == 1:
            raise OSError(errno.ENOSPC, "No space left on device")
        kept(path, *arguments)

    def no_room(*_: object) -> str:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("gsmerge.io.formats.write._write_ply", full)
    monkeypatch.setattr("gsmerge.results.outputs.viewer_cameras", no_room)
    before = listing(smallest_copy)
    quick = ("--set", "superpixels=40", "--fit", "none")
    outcome = run("compact", smallest_copy, "-o", smallest_copy / "out.ply", *quick, *more, "--quiet")
    assert (outcome.code, outcome.err.count("\n")) == (3, 1), outcome.err
    assert listing(smallest_copy) == before


@pytest.mark.usefixtures("foreground")
@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="signals as POSIX has them")
@pytest.mark.parametrize(
    ("name", "code"),
    [("SIGTERM", 143), *(pytest.param(*each, marks=pytest.mark.slow) for each in (("SIGHUP", 129), ("SIGINT", 130)))],
)
def test_signal_ends_a_command_without_leaving_a_file(name: str, code: int, small_copy: Path, root: Path) -> None:
    """Whenever it comes: no file is left, and one line says why."""
    before = listing(small_copy)
    command = [sys.executable, "-m", "gsmerge", "compact", str(small_copy), "-o", str(small_copy / "out.ply"), "-q"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, cwd=root) as process:
        while process.poll() is None and listing(small_copy) == before:
            time.sleep(0.01)
        process.send_signal(signal.Signals[name])
        _, err = process.communicate()
    assert process.returncode == code
    assert err == f"{ERROR}{'interrupted' if code == 130 else f'ended by {name}'}\n"
    assert listing(small_copy) == before


@pytest.mark.usefixtures("foreground")
@pytest.mark.parametrize(("name", "code"), [("SIGTERM", 143), ("SIGINT", 130)], ids=["SIGTERM", "SIGINT"])
@pytest.mark.parametrize(
    "error",
    [None, SystemError("returned a result with an exception set"), SceneError("a.ply", "odd")],
    ids=["swallowed", "as an error of Python", "as an error of the scene"],
)
def test_signal_ends_a_command_where_other_code_swallows_it(
    name: str, code: int, error: Exception | None, smallest_copy: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Calls back into Python, with which kernels are loaded, cannot hand an exception on; libraries make another."""
    callback = ctypes.CFUNCTYPE(None)(lambda: signal.raise_signal(signal.Signals[name]))

    def compact(*_: object, **__: object) -> None:
        if error is None:
            callback()
            deadline = time.monotonic() + 60
            while time.monotonic() < deadline:
                time.sleep(0.001)
        try:
            signal.raise_signal(signal.Signals[name])
        except KeyboardInterrupt as interrupt:
            raise error from interrupt

    monkeypatch.setattr("gsmerge.run.compact_scene", compact)
    outcome = run("compact", smallest_copy, code=code)
    assert outcome.err == f"{ERROR}{'interrupted' if code == 130 else f'ended by {name}'}\n"
    assert not (smallest_copy / "scene.compact.ply").exists()


@pytest.mark.usefixtures("foreground")
@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="signals as POSIX has them")
def test_ignored_signal_stays_ignored(smallest_copy: Path, run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """As under nohup."""
    seen = []
    monkeypatch.setattr("gsmerge.run.compact_scene", lambda *_, **__: seen.append(signal.getsignal(signal.SIGHUP)))
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        run("compact", smallest_copy, "--quiet")
    finally:
        signal.signal(signal.SIGHUP, before)
    run("compact", smallest_copy, "--quiet")
    assert seen[0] == signal.SIG_IGN
    assert callable(seen[1])
    assert signal.getsignal(signal.SIGHUP) == before


QUICK = "--set superpixels=40 --fit none --set checkpoint=none"
ODD_PLACES = {
    "output is full": (f"$G compact . -o a.ply {QUICK} --json -q >/dev/full", 3, "printed"),
    "help is full": ("$G --help >/dev/full", 3, "printed"),
    "errors are full": ("$G compact none 2>/dev/full", 3, ""),
    "notes are full": (f"$G compact . -o a.ply {QUICK} 2>/dev/full", 0, ""),
    "output is closed": (f"$G compact . -o a.ply {QUICK} --json >&-", 0, ""),
    "errors are closed": ("$G compact none 2>&-", 3, ""),
    "output ends early": ("$G inspect . | head -c 10 >head && cat head", 0, ""),
    "a name of 300 letters": ("$G compact . -o $(printf 'a%.0s' $(seq 300)).ply", 3, "name too"),
    "a name of 251 letters": (f"$G compact . -q {QUICK} -o $(printf 'a%.0s' $(seq 247)).ply", 0, ""),
    "no working directory": ("mkdir gone && cd gone && rmdir ../gone && $G compact ..", 3, "working directory"),
    "names that the terminal cannot show": (
        f"export PYTHONIOENCODING=ascii; $G compact . -o '\N{SNOWMAN}.ply' {QUICK} >said && "
        "$G inspect '\N{SNOWMAN}.ply' >>said && test $(grep -c u2603.ply said) = 2", 0, "",
    ),
    # the picture takes 3.2 GB as numbers of 32 bits; the program alone takes well below 2 GB of addresses anywhere
    "little memory": ("ulimit -v 2000000; $G render . -o a.png --size 16384x16384", 3, "out of memory"),
}  # fmt: skip


@pytest.mark.skipif(sys.platform != "linux", reason="devices and limits as Linux has them")
@sweep("case", ODD_PLACES)
def test_odd_output_is_written_or_refused_in_one_line(case: str, smallest_copy: Path, root: Path) -> None:
    command, code, line = ODD_PLACES[case]
    env = {**os.environ, "PYTHONPATH": str(root), "G": f"{sys.executable} -m gsmerge"}
    words = ["sh", "-c", command]
    done = subprocess.run(words, capture_output=True, text=True, cwd=smallest_copy, env=env, check=False)
    assert done.returncode == code, done.stderr
    assert line in done.stderr
    if line:
        assert done.stderr.startswith(ERROR)
        assert done.stderr.count("\n") == 1
