"""Commands show their progress as bars, as lines or as events."""

from __future__ import annotations

import io
import json
import re
import warnings
from contextlib import redirect_stderr

import pytest

from gsmerge.cli.console import RunEnd, json_progress, plain_warnings, say, stage_progress, total_progress
from gsmerge.errors import Doubt
from gsmerge.runtime.record import RunPart, begin_part, expect_parts, record_run, report_progress


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True

    def lines(self) -> list[str]:
        """Return what was ever printed, in lines, without colours and movements of the cursor."""
        return [line.strip() for line in re.split(r"[\r\n]+", re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", self.getvalue()))]


@pytest.fixture(autouse=True)
def terminal_of_100_columns(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "100")
    for name in ("NO_COLOR", "FORCE_COLOR", "TTY_COMPATIBLE", "TTY_INTERACTIVE"):
        monkeypatch.delenv(name, raising=False)


@pytest.mark.parametrize(("columns", "bar"), [("80", 16), ("40", 8)])
def test_the_bar_of_a_run_fills_beside_the_name_of_the_stage(
    monkeypatch: pytest.MonkeyPatch, columns: str, bar: int
) -> None:
    """By the shares of expected parts, or else by the steps that are counted."""
    monkeypatch.setenv("COLUMNS", columns)
    with redirect_stderr(Terminal()) as terminal, stage_progress(quiet=False) as progress:
        progress("read: small.ply", 3, 3)
    with redirect_stderr(terminal), stage_progress(quiet=False) as progress, record_run(progress):
        expect_parts([RunPart("build", 1.0, 3.0)])
        begin_part("build")
        report_progress("fit: photos 20.0 dB", 100, 100)
    lines = [line for line in terminal.lines() if "━" in line]
    assert all(len(line) < int(columns) for line in lines)
    (read,) = {line for line in lines if line.endswith("read: small.ply")}
    assert "━" * bar in read
    assert any("done" in line and "━" * bar in line for line in lines)


def test_each_run_is_one_line_without_a_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    """Why a run failed is not in its line, since the last lines of a batch say so."""
    with total_progress(4, quiet=False) as progress:
        progress(RunEnd("room", "failed", 1, "no photos", 1, 0.25))
        progress(RunEnd("garden", "done", 2, "", 1, 0.5))
        progress(RunEnd("hall", "failed", 3, "hall/a.ply: no rows", 2, 0.75))
        progress(RunEnd("attic", "skipped", 4, "", 2, 1.0))
    lines = ["1/4 room failed", "2/4 garden done, 1 failed", "3/4 hall failed"]
    lines.append("4/4 attic skipped, since it was done before, 2 failed")
    assert capsys.readouterr().err.splitlines() == lines


def test_events_of_runs_have_the_whole_name_of_the_scene(capsys: pytest.CaptureFixture[str]) -> None:
    """Also after others have failed, and with a space in them."""
    with json_progress(), total_progress(2, quiet=True) as progress:
        progress(RunEnd("my room", "failed", 1, "no photos", 1, 0.25))
        progress(RunEnd("garden", "done", 2, "", 1, 1.0))
    events = [json.loads(line) for line in capsys.readouterr().err.splitlines()]
    assert [(event["scene"], event["status"], event["error"]) for event in events] == [
        ("my room", "failed", "no photos"), ("garden", "done", None),
    ]  # fmt: skip
    assert [event["failed"] for event in events] == [1, 1]
    assert events[0]["seconds_left"] == pytest.approx(3 * events[0]["seconds"], abs=0.1)
    assert [event["share"] for event in events] == [0.25, 1.0]
    assert events[1]["seconds_left"] == 0


def test_a_doubtful_run_is_marked_in_lines_and_events(capsys: pytest.CaptureFixture[str]) -> None:
    """Lines of JSON have all notes, and a warning even if the command is quiet."""
    worse = "the result shows its own photos worse than the input does: 20.00 dB, 30.00 dB before"
    run = "room", "done", 1, "", 0, 1.0, ["no masks", Doubt(worse)]
    with total_progress(1, quiet=False) as progress:
        progress(RunEnd(*run))
    assert capsys.readouterr().err == "1/1 room done, doubtful\n"
    with json_progress(), total_progress(1, quiet=True) as progress:
        progress(RunEnd(*run))
        say("1 of 1 results", kind="warning", quiet=True)
    events = [json.loads(line) for line in capsys.readouterr().err.splitlines()]
    said = [(kind, event[kind]) for event in events for kind in ("note", "warning", "doubts") if kind in event]
    warned = ("warning", f"room: {worse}"), ("doubts", [worse]), ("warning", "1 of 1 results")
    assert said == [("note", "room: no masks"), *warned]


def test_brackets_in_names_are_no_markup_in_bars() -> None:
    with redirect_stderr(Terminal()) as terminal, total_progress(2, quiet=False) as progress:
        progress(RunEnd("z[/b]", "done", 2, "", 0, 1.0))
    assert "z[/b] done" in terminal.getvalue()
    with redirect_stderr(Terminal()) as terminal, stage_progress(quiet=False) as move:
        move("[/b]: z[/b]", 1, 2)
    assert terminal.getvalue().count("[/b]") > 1


def test_bars_of_stages_escape_control_characters() -> None:
    with redirect_stderr(Terminal()) as terminal, stage_progress(quiet=False) as progress:
        progress("inspect: a\x1b]0;title\x07.ply", 1, 2)
    assert "\x1b]" not in terminal.getvalue()
    assert r"a\x1b]0;title\x07.ply" in terminal.getvalue()


def test_numeric_warnings_are_printed_as_one_note(capsys: pytest.CaptureFixture[str]) -> None:
    with plain_warnings():
        warnings.simplefilter("always")
        for text in ("Mean of empty slice", "invalid value encountered in divide"):
            warnings.warn(text, RuntimeWarning, stacklevel=1)
        warnings.warn("old", UserWarning, stacklevel=1)
    first, second = capsys.readouterr().err.splitlines()
    assert first == "note: some numbers are too large or undefined (Mean of empty slice)"
    assert second == "gsmerge: warning: old"
