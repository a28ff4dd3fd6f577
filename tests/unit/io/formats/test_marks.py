"""Marks of the render mode and of the vertical axis are kept through formats and joins."""

from __future__ import annotations

import json
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scenes
from slow_readers import corners
from sweeps import sweep

from gsmerge import EvaluateOptions, Gaussians, Scene, compact, evaluate, read_scene, render
from gsmerge.io import kept_comments, read_gaussians, write_gaussians, write_ply
from gsmerge.jobs.convert import ConvertOptions, convert_files
from gsmerge.method.raster.metrics import psnr
from gsmerge.results.outputs import name_outputs
from gsmerge.settings.files import PlacementOptions


def write_marked(path: Path, *comments: str) -> Path:
    """Write a file as of another program, with comments in its header."""
    write_ply(path, corners())
    return mark(path, *comments)


def mark(path: Path, *comments: str) -> Path:
    """Put comments into the header of a file."""
    head, rows = path.read_bytes().split(b"element vertex", 1)
    more = b"".join(f"comment {comment}\n".encode() for comment in comments)
    path.write_bytes(head + more + b"element vertex" + rows)
    return path


def write(path: Path, gaussians: Gaussians) -> Path:
    write_ply(path, gaussians)
    return path


def read_marks(path: Path) -> list[str]:
    return list(kept_comments(read_gaussians(path).info))


@pytest.mark.parametrize(
    ("comments", "expected"),
    [
        (("antialiased 1",), ["SplatRenderMode: mip"]), (("antialiased 0",), []),
        (("SplatRenderMode: mip", "antialiased 0"), []), (("SplatRenderMode: 2dgs",), ["SplatRenderMode: 2dgs"]),
        (("SplatRenderMode: default",), []), (("Vertical axis: z",), ["Vertical axis: z"]),
        (("Vertical axis: z, or y",), []),
    ],
)  # fmt: skip
def test_marks_of_other_programs_are_kept(comments: tuple[str, ...], expected: list[str], tmp_path: Path) -> None:
    assert read_marks(write_marked(tmp_path / "a.ply", *comments)) == expected


@pytest.mark.parametrize("mode", ["mip", "2dgs"])
def test_a_sog_stores_the_render_mode_as_its_model(mode: str, tmp_path: Path) -> None:
    comments = [f"SplatRenderMode: {mode}"]
    write_gaussians(tmp_path / "a.sog", corners(), comments=comments)
    assert read_marks(tmp_path / "a.sog") == comments
    with zipfile.ZipFile(tmp_path / "a.sog") as archive:
        meta = json.loads(archive.read("meta.json"))
    assert meta["model"] == {"mip": "antialiased", "2dgs": "2dgs"}[mode]
    assert meta["antialias"] is (mode == "mip")


def test_gaussians_of_two_scales_are_marked_as_flat(tmp_path: Path) -> None:
    path = write_marked(tmp_path / "a.ply")
    head, rows = path.read_bytes().split(b"end_header\n", 1)
    names = [line.split()[-1] for line in head.decode().splitlines() if line.startswith("property")]
    place, count = names.index("scale_2"), len(names)
    kept = b"".join(rows[4 * i : 4 * i + 4] for i in range(len(rows) // 4) if i % count != place)
    path.write_bytes(head.replace(b"property float scale_2\n", b"") + b"end_header\n" + kept)
    assert read_marks(path) == ["SplatRenderMode: 2dgs"]


def test_marks_that_not_all_files_have_are_left_out_of_a_join(tmp_path: Path) -> None:
    inputs = [write_marked(tmp_path / "a.ply", "antialiased 1", "Vertical axis: z"), write_marked(tmp_path / "b.ply")]
    document = convert_files(ConvertOptions(inputs, name_outputs(tmp_path / "both.ply")))
    assert [note for note in document["notes"] if note.startswith("not all files have the mark")] == [
        "not all files have the mark 'SplatRenderMode: mip', so the joined file has not",
        "not all files have the mark 'Vertical axis: z', so the joined file has not",
    ]
    assert read_marks(tmp_path / "both.ply") == []
    convert_files(ConvertOptions([inputs[0], inputs[0]], name_outputs(tmp_path / "same.ply")))
    assert read_marks(tmp_path / "same.ply") == ["SplatRenderMode: mip", "Vertical axis: z"]


@pytest.mark.parametrize(
    ("ending", "lost"),
    [
        (".glb", ["SplatRenderMode: mip", "Vertical axis: z"]), (".spz", ["Vertical axis: z"]),
        (".splat", ["SplatRenderMode: mip", "Vertical axis: z"]), (".sog", ["Vertical axis: z"]), (".ply", []),
    ],
)  # fmt: skip
def test_marks_that_a_format_cannot_store_are_noted(ending: str, lost: list[str], tmp_path: Path) -> None:
    path = write_marked(tmp_path / "a.ply", "antialiased 1", "Vertical axis: z")
    notes = convert_files(ConvertOptions([path], name_outputs(tmp_path / f"b{ending}")))["notes"]
    assert [note for note in notes if "mark" in note] == [f"{ending} cannot store the mark {mark!r}" for mark in lost]


def test_the_marked_vertical_axis_of_a_file_is_turned_upward(tmp_path: Path) -> None:
    path = write_marked(tmp_path / "a.ply", "Vertical axis: z")
    convert_files(ConvertOptions([path], name_outputs(tmp_path / "y.ply"), placement=PlacementOptions(up="y")))
    before, after = (read_gaussians(file).gaussians.means for file in (path, tmp_path / "y.ply"))
    assert abs(after[:, 1] - before[:, 2]).max() < 1e-5
    convert_files(ConvertOptions([path], name_outputs(tmp_path / "z.ply"), placement=PlacementOptions(up="z")))
    assert abs(read_gaussians(tmp_path / "z.ply").gaussians.means - before).max() < 1e-5


def test_a_turned_file_has_no_axis_of_the_former_frame(tmp_path: Path) -> None:
    path = write_marked(tmp_path / "a.ply", "Vertical axis: z")
    convert_files(
        ConvertOptions([path], name_outputs(tmp_path / "turned.ply"), placement=PlacementOptions(rotate="90,0,0"))
    )
    assert read_marks(tmp_path / "turned.ply") == []


@pytest.fixture(scope="module")
def wall() -> Scene:
    """Small Gaussians, which viewers that draw antialiased show fainter."""
    scene = scenes.make_scene(scenes.wall(), scenes.arc(2))
    return replace(scene, gaussians=replace(scene.gaussians, scales=0.3 * scene.gaussians.scales))


@sweep(("comment", "expected"), [("SplatRenderMode: mip", True), ("antialiased 0", False)])
def test_a_scene_is_drawn_as_its_file_says(wall: Scene, comment: str, expected: bool, tmp_path: Path) -> None:
    scene = read_scene(mark(write(tmp_path / "a.ply", wall.gaussians), comment))
    assert scene.cameras.antialiased is expected
    result = compact(scene, effort="draft", budget="50%")
    assert result.cameras.antialiased is expected
    drawn = {mode: render(wall.gaussians, wall.cameras, antialiased=mode).images for mode in (True, False)}
    assert np.abs(drawn[True] - drawn[False]).max() > 0.1
    cameras = replace(wall.cameras, antialiased=expected)
    np.testing.assert_array_equal(render(wall.gaussians, cameras).images, drawn[expected])


def test_files_of_different_marks_are_each_drawn_their_own_way(wall: Scene) -> None:
    scene = replace(wall, images=render(wall.gaussians, wall.cameras).images.clip(0, 1))
    marked = {"marked": replace(scene.cameras, antialiased=True)}
    options = EvaluateOptions(lpips=(), fog=False)
    results = {"plain": scene.gaussians, "marked": scene.gaussians}
    scores = evaluate(scene, results, None, options, cameras=marked).results
    assert [one.antialiased for one in scores] == [False, False, True]
    original, plain, other = (one.mean("context")[0].psnr for one in scores)
    assert original == plain
    assert other < 60
    both = evaluate(scene, results, None, replace(options, antialiased=True), cameras=marked).results
    assert len({one.mean("context")[0].psnr for one in both}) == 1


def test_a_result_looks_as_its_marked_input_where_viewers_heed_the_mark(wall: Scene) -> None:
    """Small Gaussians beside cameras without photos."""
    cameras = replace(wall.cameras, antialiased=True)
    marked = Scene(wall.gaussians[::-1], cameras, None, None, wall.names)
    result = compact(marked, budget="10%").gaussians
    before, after = (render(each, cameras).images for each in (wall.gaussians, result))
    assert psnr(before[0], after[0]) > 36.5
