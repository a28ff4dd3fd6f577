"""What nobody foresaw: one line, the right code, a traceback only on request, no half-written file."""

from __future__ import annotations

import errno
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from .conftest import Run, listing


class Broken:
    """Stands in for a stage and fails."""

    def __init__(self, error: BaseException) -> None:
        self.error = error

    def __call__(self, *_: object, **__: object) -> None:
        raise self.error


@pytest.mark.parametrize(
    ("error", "code", "line"),
    [
        (KeyError("lost"), 1, "gsmerge: error: unexpected error: KeyError: 'lost'; run again with --debug\n"),
        (ValueError("two\nlines"), 1, "gsmerge: error: unexpected error: ValueError: two; run again with --debug\n"),
        (MemoryError(), 1, "gsmerge: error: out of memory; use a smaller scene or fewer --threads\n"),
        (KeyboardInterrupt(), 130, "gsmerge: error: interrupted\n"),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, BaseException) else "",
)
def test_failures_inside_the_work(
    error: BaseException, code: int, line: str, scene_copy: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gsmerge.compact_file.compact", Broken(error))
    before = listing(scene_copy)
    outcome = run("compact", scene_copy, "--quiet")
    assert (outcome.code, outcome.err, outcome.out) == (code, line, "")
    assert listing(scene_copy) == before


def test_debug_shows_the_traceback(scene_copy: Path, run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gsmerge.compact_file.compact", Broken(KeyError("lost")))
    outcome = run("compact", scene_copy, "--quiet", "--debug")
    assert outcome.code == 1
    assert outcome.err.startswith("Traceback (most recent call last):")
    assert "Traceback" not in run("compact", scene_copy, "--quiet").err  # and is forgotten by the next call


@pytest.mark.parametrize("command", ["compact", "encode", "decode"])
def test_failures_while_writing_leave_nothing(
    command: str, scene_copy: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    def half(path: Path, *_: object, **__: object) -> None:
        Path(path).write_bytes(b"ply\n")
        raise OSError(28, "No space left on device")

    quick = ("--superpixels", 40, "--no-robust")
    given: Path = scene_copy
    if command == "decode":
        given = scene_copy / "kept.gsm"
        assert run("encode", scene_copy, "-o", given, *quick).code == 0
    for place in ("gsmerge.compact_file", "gsmerge.io"):
        monkeypatch.setattr(f"{place}.write_gaussians", half)
    monkeypatch.setattr("gsmerge.encoded.gsm_file.save_encoded", half)
    before = listing(scene_copy)
    more = {"compact": (*quick, "--fit", "none"), "encode": quick, "decode": ()}[command]
    outcome = run(command, given, "--quiet", *more)
    assert outcome.code == 3
    assert outcome.err.count("\n") == 1
    assert {"compact": "scene.compact.ply", "encode": "scene.gsm", "decode": "kept.compact.ply"}[command] in outcome.err
    assert "No space left" in outcome.err
    assert listing(scene_copy) == before


def test_a_gpu_that_is_not_there_is_wrong_usage(scene_copy: Path, run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """Told before any work; ``auto`` takes the CPU, and says so in the report."""
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    outcome = run("compact", scene_copy, "--device", "cuda")
    assert outcome.code == 2
    assert outcome.err.count("\n") == 1
    assert 'device: expected "cpu" or a CUDA device that can be used, got "cuda", but torch finds no' in outcome.err
    plan = run("compact", scene_copy, "--device", "auto", "--dry-run", "--json")
    assert plan.code == 0
    assert '"device": "cpu"' in plan.out


@pytest.mark.parametrize("more", [("--report", "none/report.json"), ("--levels", 2), ("--report", "report.json")])
def test_several_outputs_are_all_there_or_none(
    more: tuple[object, ...], scene_copy: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A report that cannot be written, a disk that is full at the second level, or at the end."""
    from gsmerge.io import write_gaussians

    def full(path: Path, *arguments: Any, **named: Any) -> None:
        if "level1" in str(path):
            raise OSError(errno.ENOSPC, "No space left on device")
        write_gaussians(path, *arguments, **named)

    def no_room(*_: object) -> str:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("gsmerge.compact_file.write_gaussians", full)
    monkeypatch.setattr("gsmerge.compact_file.to_json", no_room)
    before = listing(scene_copy)
    where = [scene_copy / word if isinstance(word, str) and word.endswith("json") else word for word in more]
    quick = ("--superpixels", 40, "--no-robust", "--fit", "none")
    outcome = run("compact", scene_copy, "-o", scene_copy / "out.ply", *quick, *where, "--quiet")
    assert (outcome.code, outcome.err.count("\n")) == (3, 1), outcome.err
    assert listing(scene_copy) == before


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="signals as POSIX has them")
@pytest.mark.parametrize(("name", "code"), [("SIGTERM", 143), ("SIGHUP", 129), ("SIGINT", 130)])
def test_a_signal_ends_it_in_order(name: str, code: int, scene_copy: Path, root: Path) -> None:
    """Whenever it comes: no file is left, and one line says why."""
    before = listing(scene_copy)
    command = [sys.executable, "-m", "gsmerge", "compact", str(scene_copy), "-o", str(scene_copy / "out.ply"), "-q"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, cwd=root) as process:
        while process.poll() is None and listing(scene_copy) == before:
            time.sleep(0.002)
        process.send_signal(signal.Signals[name])
        _, err = process.communicate()
    assert process.returncode == code
    assert err == f"gsmerge: error: {'interrupted' if code == 130 else f'ended by {name}'}\n"
    assert listing(scene_copy) == before


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="signals as POSIX has them")
def test_an_ignored_signal_stays_ignored(scene_copy: Path, run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """As under nohup."""
    seen = []
    monkeypatch.setattr("gsmerge.compact_file.compact", lambda *_, **__: seen.append(signal.getsignal(signal.SIGHUP)))
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        run("compact", scene_copy, "--quiet")
    finally:
        signal.signal(signal.SIGHUP, before)
    run("compact", scene_copy, "--quiet")
    assert seen[0] == signal.SIG_IGN
    assert callable(seen[1])
    assert signal.getsignal(signal.SIGHUP) == before
