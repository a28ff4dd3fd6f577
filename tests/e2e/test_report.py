"""``gsmerge report`` as users call it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from .conftest import Run


@pytest.fixture
def small(scene_copy: Path, run: Run) -> Path:
    out = scene_copy / "small.ply"
    outcome = run("compact", scene_copy, "-o", out, "--fit", "none", "-q", "--report", scene_copy / "run.json")
    assert outcome.code == 0
    return out


def test_markdown_on_stdout(scene_copy: Path, small: Path, run: Run) -> None:
    outcome = run("report", scene_copy / "scene.ply", small, "--lpips", "none", "--targets", scene_copy / "targets")
    assert (outcome.code, outcome.err) == (0, "")
    assert "| small.ply |" in outcome.out


def test_files_of_every_kind(scene_copy: Path, small: Path, run: Run) -> None:
    outputs = [scene_copy / f"report{suffix}" for suffix in (".md", ".html", ".json")]
    flags = [part for path in outputs for part in ("-o", path)]
    outcome = run(
        "report", scene_copy / "scene.ply", small, "--lpips", "none", "--sizes", "48,96", *flags,
        "--compact-report", scene_copy / "run.json",
    )  # fmt: skip
    assert outcome.code == 0, outcome.err
    assert outcome.out == ""
    document = json.loads(outputs[2].read_text())
    spent = json.loads((scene_copy / "run.json").read_text())["total_seconds"]
    assert document["after"][0]["merge_seconds"] == spent
    assert [speed["width"] for speed in document["before"]["speeds"][:2]] == [48, 96]
    assert "data:image/webp;base64," in outputs[1].read_text()
    again = run("report", scene_copy / "scene.ply", small, "--lpips", "none", "-o", outputs[0])
    assert again.code == 2
    assert "--overwrite" in again.err


def test_a_scene_without_cameras(scene_copy: Path, small: Path, run: Run) -> None:
    (scene_copy / "transforms.json").unlink()
    outcome = run(
        "report", scene_copy / "scene.ply", small, "--order", "none", "--lpips", "none", "--sizes", "32", "--json"
    )
    assert outcome.code == 0, outcome.err
    document = json.loads(outcome.out)
    assert document["quality"]["reference"] == "renders of the input"
    assert any("placed" in note for note in document["notes"])


def test_names_that_are_no_text(scene_copy: Path, small: Path, run: Run) -> None:
    odd = small.rename(scene_copy / "odd\udcff\x1b[31m.ply")
    outputs = [scene_copy / f"report{suffix}" for suffix in (".md", ".html", ".json")]
    flags = ("--lpips", "none", "--sizes", "32")
    outcome = run("report", scene_copy, odd, *flags, *(part for path in outputs for part in ("-o", path)))
    assert outcome.code == 0, outcome.err
    assert all("odd" in path.read_text(encoding="utf-8") for path in outputs)
    outcome = run("report", scene_copy, odd, *flags)
    assert outcome.code == 0, outcome.err
    assert r"odd\udcff\x1b[31m.ply" in outcome.out
    assert run("evaluate", scene_copy, odd, "--lpips", "none", "--csv", scene_copy / "a.csv").code == 0


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (("-o", "report.txt"), 2, "ends in .md, .html, .json"),
        (("--sizes", "0"), 2, "expected pixels"),
        (("--sizes", "many"), 2, "expected pixels"),
        (("--merge-seconds", "1", "--merge-seconds", "2"), 2, "the merge time of each of 1"),
        (("--compact-report", "transforms.json"), 3, "total_seconds"),
        (("--compact-report", "scene.ply"), 3, "cannot be read as text"),
    ],
)
def test_bad_calls(
    arguments: tuple[str, ...], code: int, words: str, scene_copy: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(scene_copy)
    outcome = run("report", "scene.ply", "scene.ply", "--lpips", "none", *arguments)
    assert outcome.code == code
    assert words in outcome.err
    assert outcome.err.count("\n") == 1
