"""All commands share --json, --quiet, --dry-run and notes, and never replace their input."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

import numpy as np
import pytest
from messages import names
from shared import write_scene
from sweeps import sweep

import gsmerge
from gsmerge.cli import main
from gsmerge.drawing.render_files import picture_stems
from gsmerge.method.kernels import elementary

from .conftest import Run, assert_refused, listing

VIEWS = 3
WRITERS: dict[str, tuple[str, ...]] = {
    "compact": ("small.ply", "--set", "superpixels=100", "--fit", "none"),
    "render": ("renders",),
    "view": ("page.html", "--no-open"),
    "render --views 1": ("sheet.jpg",),
    "render --path orbit": ("walk.mp4", "--frames", "2"),
    "render --path spline": ("walk", "--frames", "3"),
}
OTHERS: dict[str, tuple[str, ...]] = {  # that take no scene, or several
    "compact a state": ("decoded.ply", "--effort", "draft"),
    "extend": ("state.gsm", "--set", "superpixels=100"),
    "generate": ("made", "--scenes", "1", "--views", "3", "--size", "24x16"),
}
COMMANDS = ("inspect", "evaluate", *WRITERS)
DRAFT = ("--effort", "draft")
MODES = 3  # of them, in the end, are modes of one command
PICTURES = {  # with their number
    "render": VIEWS,
    "render --views 1": 1,
    "render --path orbit": 1,
    "render --path spline": 3,
}


@pytest.fixture
def small_copy(tmp_path: Path) -> Path:
    """Return a scene with held-out views, of 24 x 16, that a test may change."""
    return write_scene(tmp_path / "scene", num_views=VIEWS, width=24, height=16)


def call(command: str, scene: Path) -> list[object]:
    """Return the command with its scene, its output, and what makes it fast."""
    targets = ["--targets", scene / "targets"]
    if command == "inspect":
        return [command, scene]
    if command == "evaluate":
        return [command, scene, *targets, "--lpips", "none"]
    output, *rest = (WRITERS | OTHERS)[command]
    if command == "compact a state":
        if not (scene / "kept.gsm").exists():
            small = ["--set", "superpixels=60", "--quiet"]
            assert main(["extend", str(scene / "kept.gsm"), str(scene), *small]) == 0
        return ["compact", scene / "kept.gsm", "-o", scene / output]
    if command == "extend":
        return [command, scene / output, scene, *rest]
    if command == "generate":
        return ["lab", command, "-o", scene / output, *rest]
    more = [scene / "scene.ply", *targets] if command == "view" else []
    return [*command.split(), scene, *more, "-o", scene / output, *rest]


def all_texts(value: object) -> list[str]:
    """Return the texts in a value of JSON, at any depth."""
    parts = value if isinstance(value, list) else [*value, *value.values()] if isinstance(value, dict) else []
    return [value] if isinstance(value, str) else [text for part in parts for text in all_texts(part)]


def spoil_rows(ply: Path) -> None:
    """Put NaN in one row, a log scale of 40 in another, and every opacity between 0 and 1."""
    head, data = ply.read_bytes().split(b"end_header\n", 1)
    rows = np.frombuffer(data, "<f4").reshape(-1, 17).copy()
    rows[3, 0], rows[7, 10] = np.nan, 40
    rows[:, 9] = 1 / (1 + elementary.exp(-rows[:, 9]))
    ply.write_bytes(head + b"end_header\n" + rows.tobytes())


@pytest.mark.parametrize("command", COMMANDS)
def test_json_is_alone_on_stdout_and_names_the_pictures(command: str, small_copy: Path, run: Run) -> None:
    before = listing(small_copy)
    outcome = run(*call(command, small_copy), "--json")
    assert (outcome.code, outcome.err) == (0, "")
    document = json.loads(outcome.out)
    assert document["schema_version"] == 2
    assert document["tool"]["version"] == gsmerge.__version__
    assert document["notes"] == document["doubts"] == []
    if command in PICTURES:
        written = sorted(str(small_copy / name) for name in set(listing(small_copy)) - set(before))
        assert sorted(document["pictures"]) == written
        assert len(written) == PICTURES[command]


@sweep("command", [*OTHERS, *COMMANDS], often=len(OTHERS) + len(COMMANDS) - MODES)
def test_quiet_prints_nothing_about_odd_rows(command: str, small_copy: Path, run: Run) -> None:
    spoil_rows(small_copy / "scene.ply")
    written = ["-o", small_copy / "scores.json"] if command == "evaluate" else []  # without it nothing would be left
    outcome = run(*call(command, small_copy), *written, "--quiet")
    assert (outcome.code, outcome.out, outcome.err) == (0, "", "")


@pytest.mark.skipif(sys.platform != "linux", reason="other systems allow no such names")
@pytest.mark.parametrize("command", ["extend", "compact a state", "evaluate", "inspect", *WRITERS, "batch"])
def test_json_keeps_the_bytes_of_names_that_are_not_utf_8(command: str, small_copy: Path, run: Run) -> None:
    """They are in the JSON, from which the bytes of the name follow."""
    name, photo = os.fsdecode(b"r\xe9sum\xe9"), os.fsdecode(b"\xff.png")
    cameras = small_copy / "transforms.json"
    document = json.loads(cameras.read_text())
    first = small_copy / document["frames"][0]["file_path"]
    first.rename(first.with_name(photo))
    document["frames"][0]["file_path"] = f"{first.parent.name}/{photo}"
    cameras.write_text(json.dumps(document))
    scene = small_copy.rename(small_copy.with_name(name))
    words = call(command, scene) if command != "batch" else ["batch", scene.parent, "-o", scene / "out", *DRAFT]
    outcome = run(*words, "--json")
    if command == "render --path orbit":  # OpenCV would end the process
        assert_refused(outcome, 3, "walk.mp4", "UTF-8")
        return
    assert (outcome.code, outcome.err) == (0, "")
    assert outcome.out.isascii()
    assert r"r\udce9sum\udce9" in outcome.out
    lines = outcome.out.splitlines() if command == "batch" else [outcome.out]
    assert any(name in text for line in lines for text in all_texts(json.loads(line)))


@pytest.mark.skipif(not hasattr(os, "geteuid"), reason="needs POSIX permissions")
@pytest.mark.parametrize("command", ["compact a state", "extend", *WRITERS])
def test_output_has_the_rights_of_its_photos_or_of_the_file_it_replaces(
    command: str, small_copy: Path, run: Run
) -> None:
    """Outputs that hold photos are as private as these, and what replaces a file takes its mode."""
    for path in (small_copy / "images").iterdir():
        path.chmod(0o600)
    words, before = call(command, small_copy), listing(small_copy)
    again = [] if command == "extend" else ["--overwrite"]
    assert run(*words, "-q").code == 0
    written = [small_copy / name for name in set(listing(small_copy)) - set(before)]
    usual = 0o600 if command in ("view", "extend", "render --views 1") else 0o644
    assert {path.stat().st_mode & 0o777 for path in written} == {usual}
    for path in written:
        path.chmod(0o604)
    if command == "extend":
        words += ["--set", "other_world=true"]
        with (small_copy / "transforms.json").open("a") as file:
            file.write("\n")  # another batch
    assert run(*words, *again, "-q").code == 0
    assert {path.stat().st_mode & 0o777 for path in written} == {0o604}


@pytest.mark.parametrize("command", ["compact", "compact a state"])
def test_a_dry_run_writes_nothing(command: str, small_copy: Path, run: Run) -> None:
    words = call(command, small_copy)
    before = listing(small_copy)
    outcome = run(*words, "--dry-run", code=0)
    assert (WRITERS | OTHERS)[command][0] in outcome.out
    assert "would" in outcome.out
    assert json.loads(run(*words, "--dry-run", "--json").out)["dry_run"] is True
    assert listing(small_copy) == before


@pytest.mark.parametrize(
    ("wish", "most"), [(("--budget", "auto"), 537), (("--budget", "2%"), 153), (("--budget", "20KB"), 286)]
)
def test_a_dry_run_knows_budgets(wish: tuple[str, ...], most: int, small_scene: Path, run: Run) -> None:
    arguments = ["compact", small_scene, "--set", "superpixels=200", *wish, "--dry-run"]
    plan = json.loads(run(*arguments, "--json").out)["compact"]
    assert plan["num_gaussians"] == most
    assert plan["superpixels_per_view"] is None
    assert f"{most:,} Gaussians" in run(*arguments).out


@pytest.mark.parametrize("command", COMMANDS)
def test_file_that_is_no_scene_is_refused_before_anything_is_written(command: str, small_copy: Path, run: Run) -> None:
    (small_copy / "scene.ply").write_text("These are notes, not Gaussians.\n")
    before = listing(small_copy)
    assert_refused(run(*call(command, small_copy)), 3, "scene.ply", ".ply file", "text")
    assert listing(small_copy) == before


def test_comment_on_the_way_to_render_is_passed_on(small_copy: Path, run: Run) -> None:
    """Files whose Gaussians carry a filter of their own say so in the header; other comments end with the file."""
    head, rows = (small_copy / "scene.ply").read_bytes().split(b"element vertex", 1)
    more = b"comment SplatRenderMode: mip\ncomment SplatRenderMode:\tx\ncomment of no use\nelement vertex"
    (small_copy / "scene.ply").write_bytes(head + more + rows)
    assert run(*call("compact", small_copy)).code == 0
    comments = gsmerge.read_ply(small_copy / "small.ply").info.comments
    assert "SplatRenderMode: mip" in comments
    assert "of no use" not in comments


@pytest.mark.slow
@sweep("command", COMMANDS, often=len(COMMANDS) - MODES)
def test_every_command_notes_odd_rows(command: str, small_copy: Path, run: Run) -> None:
    spoil_rows(small_copy / "scene.ply")
    outcome = run(*call(command, small_copy), code=0)
    said = outcome.out if command == "inspect" else outcome.err
    notes = [line for line in said.splitlines() if line.startswith("note")]
    assert len(notes) == 2
    assert names(said, "opacities lie in [0, 1]", "2 rows with NaN, inf or numbers")


@pytest.mark.parametrize(
    ("command", "output"),
    [
        ("compact", "scene.ply"), ("view", "transforms.json"),
        ("render", "images/view_000.png"), ("render", "images"),
        ("render --path orbit", "images"),
    ],
)  # fmt: skip
def test_inputs_are_not_replaced(command: str, output: str, small_copy: Path, run: Run) -> None:
    before = listing(small_copy)
    scene = small_copy / "scene.ply"
    results = [scene] if command == "view" else []
    replacing = [] if command == "view" else ["--overwrite"]
    outcome = run(*command.split(), scene, *results, "-o", small_copy / output, *replacing)
    assert_refused(outcome, 2, small_copy / output, "input")
    assert listing(small_copy) == before


@pytest.mark.parametrize(
    ("names", "stems"),
    [
        (["images/a.png", "b.JPG", "c"], ["a", "b", "c"]),
        (["left/0.png", "right/0.png"], ["left_0", "right_0"]),
        (["left\\0.png", "right\\0.png"], ["left_0", "right_0"]),
        (["a.png", "a.jpg"], ["view_000", "view_001"]),
        (["A.png", "a.png"], ["view_000", "view_001"]),
        (["../x/run.v1.png", "run.v2"], ["run.v1", "run.v2"]),
        ([], []),
    ],
)
def test_names_of_pictures_are_those_of_views_unless_they_collide(names: list[str], stems: list[str]) -> None:
    assert picture_stems(names) == stems
