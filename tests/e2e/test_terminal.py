"""A person sees whole lines in a terminal of 80 columns: commands run in one, and their bytes become a screen."""

from __future__ import annotations

import os
import re
import select
import struct
import sys
from itertools import product
from pathlib import Path

import pytest
from messages import ERROR
from sweeps import sweep

from gsmerge.runtime.documents import wrap_line

from .conftest import Run

pty = pytest.importorskip("pty")
COLUMNS, ROWS = 80, 50


def screen(data: bytes) -> list[str]:
    """Return the lines of a terminal after these bytes: cursor up, erase line, wrapping at the last column."""
    lines, row, column = [""], 0, 0
    text = data.decode("utf-8")
    for match in re.finditer(r"\x1b\[([\d;?]*)([A-Za-z])|(.)", text, re.DOTALL):
        number, control, letter = match.groups()
        if control == "A":
            row = max(0, row - int(number or 1))
        elif control == "K":
            lines[row] = ""
        elif letter == "\r":
            column = 0
        elif letter == "\n":
            row += 1
        elif letter:
            row, column = (row + 1, 0) if column == COLUMNS else (row, column)
            lines += [""] * (row + 1 - len(lines))
            lines[row] = lines[row][:column].ljust(column) + letter + lines[row][column + 1 :]
            column += 1
        lines += [""] * (row + 1 - len(lines))
    return [line.rstrip() for line in lines if line.strip()]


def in_terminal(
    *words: object, interrupt_at: bytes | None = None, kind: str = "xterm", columns: int = COLUMNS
) -> tuple[int, bytes]:
    """Return exit code and bytes of Python in a terminal; type Ctrl-C once ``interrupt_at`` has been printed."""
    import fcntl
    import termios

    pid, terminal = pty.fork()
    if pid == 0:
        environment = {**os.environ, "TERM": kind, "COLUMNS": str(columns)}
        os.execve(sys.executable, [sys.executable, *map(str, words)], environment)
    fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack("HHHH", ROWS, columns, 0, 0))
    output = b""
    while select.select([terminal], [], [], 300)[0]:
        try:
            block = os.read(terminal, 1 << 16)
        except OSError:  # the end, on Linux
            break
        if not block:
            break
        output += block
        if interrupt_at is not None and interrupt_at in output:
            os.write(terminal, b"\x03")
            interrupt_at = None
    code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    os.close(terminal)
    return code, output


def test_compact_ends_with_a_table_of_its_result(small_copy: Path, tmp_path: Path) -> None:
    out = tmp_path / "small.ply"
    sizes = ("--set", "superpixels=200", "--set", "fit_steps=20")
    code, output = in_terminal("-m", "gsmerge", "compact", small_copy, "-o", out, *sizes)
    lines = screen(output)
    assert code == 0
    first = next(i for i, line in enumerate(lines) if line.startswith("  Gaussians"))
    assert "".join(lines[:first]) == str(out)
    words = [line.split()[0] for line in lines[first:] if line.startswith("  ") and line.split()[0].isalpha()]
    words = [word for word in words if word != "left"]  # goes on from the line of new views
    assert words[:8] == ["Gaussians", "file", "new", "its", "not", "time", "cameras", "next"]
    assert any("next       gsmerge view" in line for line in lines)
    text = re.sub(r"\x1b\[[^A-Za-z]*[A-Za-z]", "", output.decode())
    stages = set(re.findall(r"━ +(?:[-:\d]+ +)+(prepare|match|fit)", text))
    assert stages == {"prepare", "match", "fit"}
    assert "/17" not in output.decode()


@sweep(
    ("kind", "words"),
    [
        *product(["xterm"], ["--help", "compact --help", "lab --help", "compact", "inspect {scene}"]),
        *product(["dumb", "", "unknown"], ["compact --help", "inspect {scene}"]),
    ],
    often=7,
)
def test_lines_fit_a_narrow_terminal_of_any_kind(kind: str, words: str, small_scene: Path) -> None:
    """Nothing is wider than it, and one without a known name gets no escape sequences."""
    given = words.format(scene=small_scene).split()
    code, output = in_terminal("-m", "gsmerge", *given, kind=kind, columns=40)
    assert code == (2 if words == "compact" else 0)
    assert kind == "xterm" or b"\x1b" not in output
    text = re.sub(r"\x1b\[[^A-Za-z]*[A-Za-z]", "", output.decode())
    assert max(len(line) for line in re.split(r"[\r\n]+", text) if str(small_scene) not in line) <= 40


@pytest.mark.usefixtures("foreground")
def test_ctrl_c_leaves_no_bar(small_copy: Path, tmp_path: Path) -> None:
    long = ("--set", "superpixels=200", "--set", "fit_steps=100000")
    words = ("-m", "gsmerge", "compact", small_copy, "-o", tmp_path / "small.ply", *long)
    code, output = in_terminal(*words, interrupt_at=b"photos")
    assert code == 130
    lines = screen(output)
    assert lines == [f"{ERROR}interrupted"]
    assert list(tmp_path.glob("small*")) == []


def test_lines_are_wrapped_between_words() -> None:
    assert wrap_line("note: one two three", 14) == ["note: one two", "  three"]
    assert wrap_line("a/path/longer/than/the/line", 10) == ["a/path/longer/than/the/line"]
    assert wrap_line("x" * 300 + " y", None) == ["x" * 300 + " y"]
    assert wrap_line("  PSNR  20.0 dB  in four of them", 30, 14) == [
        "  PSNR  20.0 dB  in four of",
        "              them",
    ]


@pytest.mark.slow
def test_inspect_recognises_a_compact_scene(small_scene: Path, tmp_path: Path, run: Run) -> None:
    out, words = tmp_path / "small.ply", ("--fit", "none", "--set", "superpixels=200")
    assert "already" not in run("compact", small_scene, "-o", out, *words).err
    views = ("--cameras", small_scene / "transforms.json", "--images", small_scene / "images")
    assert run("compact", out, "-o", tmp_path / "smaller.ply", *words, *views, code=0).err.count("already (") == 1
    scored = run("evaluate", small_scene, out, "--set", "views=2", "--lpips", "none")
    assert "scores assume results of 2 views" in scored.err
    assert "more" not in run("evaluate", small_scene, out, "--lpips", "none").err
