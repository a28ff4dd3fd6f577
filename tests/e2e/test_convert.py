"""``gsmerge convert`` gives the same Gaussians another format, frame and extent, with their cameras."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from messages import noted, refuses
from plyfile import PlyData, PlyElement
from shared import make_once, write_small
from splat_transform_programs import put_stand_in, run_here
from sweeps import sweep

import gsmerge
from gsmerge.errors import SceneError, UsageError
from gsmerge.io.atomic import AddOutput
from gsmerge.io.cameras.viewer_cameras import viewer_cameras, viewer_cameras_path
from gsmerge.io.formats import table as formats
from gsmerge.io.formats.streamed import read_index, read_level
from gsmerge.io.formats.table import Contents, Format
from gsmerge.jobs.convert import ConvertOptions, convert_files, find_placement, rotation_between
from gsmerge.method.geometry.transforms import covariances
from gsmerge.results.outputs import join_gaussians, name_outputs
from gsmerge.settings.files import AXES, PlacementOptions
from gsmerge.settings.stages import CleanOptions
from gsmerge.types import Gaussians

from .conftest import Run, assert_refused

FORMATS = ("out.sog", "lod-meta.json", "tileset.json", "out.ply", "out.spz", "out.splat", "out.glb")


def make_result(folder: Path) -> None:
    """Write a result with harmonics, its cameras inside and beside it."""
    scene = gsmerge.read_scene(make_once("small", write_small))
    folder.mkdir()
    gaussians = gsmerge.compact(scene, effort="draft", budget=400, fit="none").gaussians
    random = np.random.default_rng(0)
    gaussians = replace(gaussians, shN=random.normal(0, 0.1, (400, 15, 3)).astype(np.float32))
    gsmerge.write_ply(folder / "in.ply", gaussians, comments=["gsmerge result"])
    (folder / "in.cameras.json").write_text(viewer_cameras(scene.cameras, scene.names))


@pytest.fixture
def result(tmp_path: Path) -> Path:
    """Return the result of :func:`make_result`, in a folder of its own."""
    return Path(shutil.copytree(make_once("result", make_result), tmp_path, dirs_exist_ok=True)) / "in.ply"


def read(path: Path) -> Gaussians:
    return gsmerge.read_gaussians(path).gaussians


@sweep("name", FORMATS, often=3)
def test_every_format_is_written_with_the_cameras(
    result: Path, tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    run_here(monkeypatch, put_stand_in(tmp_path / "program", monkeypatch))
    document = convert_files(ConvertOptions([result], name_outputs(tmp_path / "new" / name)))
    written = read(tmp_path / "new" / name)
    assert document["output"]["num_gaussians"] == len(written) == 400
    files = [path for path in (tmp_path / "new").rglob("*") if path.is_file()]
    beside = [path for path in files if path.name.endswith(".cameras.json")]
    assert document["output"]["bytes"] == sum(
        path.stat().st_size for path in files if path not in beside and path.name[-13:] != "settings.json"
    )
    assert [str(path) for path in beside] == [document["viewer_cameras"]]
    assert gsmerge.read_cameras(beside[0]).names == gsmerge.read_cameras(tmp_path / "in.cameras.json").names
    again = convert_files(ConvertOptions([tmp_path / "new" / name], name_outputs(tmp_path / "again.ply")))
    assert again["output"]["num_gaussians"] == 400


def test_streamed_levels_have_a_quarter_of_the_gaussians_each(
    result: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run_here(monkeypatch, put_stand_in(tmp_path / "program", monkeypatch))
    out = tmp_path / "new" / "lod-meta.json"
    convert_files(ConvertOptions([result], name_outputs(out)))
    assert read_index(out).counts == [400, 100, 25]
    whole, coarse = read(out), read_level(out, 1).gaussians
    assert (np.ptp(coarse.means, axis=0) > 0.7 * np.ptp(whole.means, axis=0)).all()


@sweep(
    "options",
    [
        PlacementOptions(up="y"), PlacementOptions(up="-z"), PlacementOptions(scale=3.0),
        PlacementOptions(rotate="20,-50,110"), PlacementOptions(translate="1,2,-3"),
        PlacementOptions(up="z", scale=0.5, rotate="0,0,90", translate="5,0,0"),
    ],
    ids=["up=y", "up=-z", "scale=3", "rotate=20,-50,110", "translate=1,2,-3", "all of them"], often=2)  # fmt: skip
def test_a_moved_scene_looks_the_same_from_its_moved_cameras(
    result: Path, tmp_path: Path, options: PlacementOptions
) -> None:
    """The harmonics turn with the Gaussians."""
    convert_files(ConvertOptions([result], name_outputs(tmp_path / "out.ply"), placement=options))
    cameras = [gsmerge.to_cameras(gsmerge.read_cameras(tmp_path / f"{name}.cameras.json")) for name in ("in", "out")]
    before, after = (
        gsmerge.render(read(tmp_path / name), cams).images
        for name, cams in zip(("in.ply", "out.ply"), cameras, strict=True)
    )
    assert np.abs(before - after).max() < 2e-3
    still = gsmerge.render(read(tmp_path / "out.ply"), cameras[0]).images
    assert np.abs(before - still).max() > 0.1


def test_up_is_where_the_cameras_look_up_or_minus_y(result: Path) -> None:
    cameras = gsmerge.to_cameras(gsmerge.read_cameras(result.with_name("in.cameras.json")))
    for axis in AXES:
        expected = np.zeros(3)
        expected["xyz".index(axis[-1])] = -1 if axis[0] == "-" else 1
        frame = find_placement(PlacementOptions(up=axis), None)
        np.testing.assert_allclose(frame.rotation @ [0, -1, 0], expected, atol=1e-12)
        moved = find_placement(PlacementOptions(up=axis), cameras).move_cameras(cameras)
        upward = -moved.viewmats[:, 1, :3].sum(0)
        np.testing.assert_allclose(upward / np.linalg.norm(upward), expected, atol=1e-9)
    np.testing.assert_array_equal(find_placement(PlacementOptions(up="y"), None).rotation, np.diag([1, -1, -1]))


def test_rotation_between_directions_turns_by_the_smallest_angle(tmp_path: Path) -> None:
    for seed in range(20):
        start, end = np.random.default_rng(seed).normal(size=(2, 3))
        start, end = start / np.linalg.norm(start), end / np.linalg.norm(end)
        turn = rotation_between(start, end)
        np.testing.assert_allclose(turn @ start, end, atol=1e-9)
        np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-9)
        np.testing.assert_allclose((np.trace(turn) - 1) / 2, start @ end, atol=1e-9)
        np.testing.assert_allclose(rotation_between(start, -start) @ start, -start, atol=1e-9)


def test_several_files_are_joined(result: Path, tmp_path: Path) -> None:
    flat = replace(read(result), shN=np.zeros((400, 0, 3), np.float32))
    gsmerge.write_ply(tmp_path / "flat.ply", flat)
    document = convert_files(ConvertOptions([result, tmp_path / "flat.ply"], name_outputs(tmp_path / "both.ply")))
    both = read(tmp_path / "both.ply")
    assert [entry["num_gaussians"] for entry in document["inputs"]] == [400, 400]
    assert (len(both), both.sh_degree) == (800, 3)
    np.testing.assert_allclose(both.means[400:], flat.means, atol=1e-6)
    assert not both.shN[400:].any()
    assert len(join_gaussians([flat])) == 400


def test_columns_of_the_users_own_stay_with_their_rows(result: Path, tmp_path: Path) -> None:
    """Of any type, through cuts and joins; what a file cannot hold, or not all files have, is named."""
    own = PlyData.read(str(result))["vertex"].data
    rows = np.zeros(len(own), [*own.dtype.descr, ("label", "<i4"), ("confidence", "<f8"), ("vx", "<f4")])
    for name in own.dtype.names:
        rows[name] = own[name]
    rows["label"], rows["confidence"], rows["vx"] = np.arange(len(own)), np.arange(len(own)) / 7, 1
    rows["x"][3] = np.nan
    PlyData([PlyElement.describe(rows, "vertex")]).write(str(tmp_path / "own.ply"))
    crop = "sphere:" + ",".join(f"{np.nanmedian(rows[name]):.6f}" for name in "xyz") + ",2"
    cut = ConvertOptions([tmp_path / "own.ply"], name_outputs(tmp_path / "cut.ply"), clean=CleanOptions(crop=crop))
    document = convert_files(replace(cut, placement=PlacementOptions(scale=2.0)))
    written = PlyData.read(str(tmp_path / "cut.ply"))["vertex"].data
    assert 0 < len(written) < len(rows) - 1
    source = rows[written["label"]]
    np.testing.assert_array_equal(written["confidence"], source["confidence"])
    np.testing.assert_allclose(written["x"], 2 * source["x"], rtol=1e-5)
    assert noted(document["notes"], "copied unchanged", "label, confidence, vx")
    assert noted(document["notes"], "not moved: vx")

    both = convert_files(
        ConvertOptions([tmp_path / "own.ply", tmp_path / "cut.ply"], name_outputs(tmp_path / "both.ply"))
    )
    joined = PlyData.read(str(tmp_path / "both.ply"))["vertex"].data
    np.testing.assert_array_equal(joined["label"][len(rows) - 1 :], written["label"])
    assert not noted(both["notes"], "left out")
    for inputs, out in (([tmp_path / "own.ply", result], "less.ply"), ([tmp_path / "own.ply"], "own.spz")):
        lost = convert_files(ConvertOptions(inputs, name_outputs(tmp_path / out)))
        assert noted(lost["notes"], "left out", "label, confidence, vx")


def test_crop_and_its_inverse_keep_or_leave_out_a_part(result: Path, tmp_path: Path) -> None:
    whole = read(result)
    low, high = np.percentile(whole.means, (25, 75), axis=0)
    box = "box:" + ",".join(f"{value:.6f}" for value in (*low, *high))
    inside = ((whole.means >= low) & (whole.means <= high)).all(1).sum()
    document = convert_files(ConvertOptions([result], name_outputs(tmp_path / "a.ply"), clean=CleanOptions(crop=box)))
    assert document["dropped"] == {"cropped": 400 - len(read(tmp_path / "a.ply"))}
    assert abs(len(read(tmp_path / "a.ply")) - inside) <= 2
    turned = convert_files(
        ConvertOptions([result], name_outputs(tmp_path / "b.ply"), clean=CleanOptions(crop=f"{box},0,0,180"))
    )
    assert turned["output"]["num_gaussians"] == document["output"]["num_gaussians"]
    faint = replace(whole, opacities=np.where(np.arange(400) < 30, np.float32(0.002), whole.opacities))
    gsmerge.write_ply(tmp_path / "faint.ply", faint)
    clean = CleanOptions(drop="transparent,floaters")
    document = convert_files(ConvertOptions([tmp_path / "faint.ply"], name_outputs(tmp_path / "c.ply"), clean=clean))
    assert document["dropped"]["transparent"] >= 30
    assert sum(document["dropped"].values()) == 400 - len(read(tmp_path / "c.ply"))
    with refuses(SceneError, "in.ply", "400", "inspect"):
        convert_files(
            ConvertOptions([result], name_outputs(tmp_path / "d.ply"), clean=CleanOptions(crop="sphere:99,99,99,0.1"))
        )
    with refuses(UsageError, "--drop sky", "--images"):
        convert_files(ConvertOptions([result], name_outputs(tmp_path / "d.ply"), clean=CleanOptions(drop="sky")))
    assert not (tmp_path / "d.ply").exists()


def test_convert_leaves_out_gaussians_that_no_view_shows(result: Path, tmp_path: Path) -> None:
    """By the cameras beside a result, without them by placed ones, which a note says."""
    whole, clean = read(result), CleanOptions(drop="unseen")
    behind = replace(whole, means=whole.means - 500 * np.array([0, 0, 1], np.float32))
    gsmerge.write_ply(tmp_path / "both.ply", gsmerge.Gaussians.concat([whole, behind]))
    cameras = viewer_cameras_path(result)
    document = convert_files(
        ConvertOptions([tmp_path / "both.ply"], name_outputs(tmp_path / "a.ply"), cameras=cameras, clean=clean)
    )
    assert document["dropped"]["unseen"] >= 400
    assert noted(document["notes"], "in.cameras.json", "those of this scene")  # more than half
    bare = convert_files(ConvertOptions([result], name_outputs(tmp_path / "b.ply"), cameras="none", clean=clean))
    assert bare["output"]["num_gaussians"] == 400 - bare["dropped"]["unseen"] > 200
    assert any("placed" in note for note in bare["notes"])
    again = convert_files(ConvertOptions([result], name_outputs(tmp_path / "a.ply", overwrite=True), cameras="none"))
    assert noted(again["notes"], "a.cameras.json", "of an earlier file")


def test_scaled_and_turned_gaussians_have_exact_positions_and_shapes(result: Path, tmp_path: Path) -> None:
    convert_files(
        ConvertOptions(
            [result], name_outputs(tmp_path / "out.ply"), placement=PlacementOptions(scale=2, rotate="0,0,90")
        )
    )
    before, after = read(result), read(tmp_path / "out.ply")
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    np.testing.assert_allclose(after.means, 2 * before.means @ turn.T, atol=1e-5)
    expected = 4 * turn @ covariances(before.quats, before.scales) @ turn.T
    np.testing.assert_allclose(covariances(after.quats, after.scales), expected, atol=1e-5)


def test_convert_takes_files_and_folders_and_never_replaces_its_input(
    small_scene: Path, tmp_path: Path, result: Path, run: Run
) -> None:
    done = run("convert", result, tmp_path / "b.spz", "--up", "y", code=0)
    assert done.out.startswith(f"{tmp_path / 'b.spz'}: 400 Gaussians")
    assert "b.cameras.json" in done.out
    document = json.loads(run("convert", result, tmp_path / "c.ply", "--json", code=0).out)
    assert (document["output"]["num_gaussians"], document["output"]["format"]) == (400, ".ply")
    assert run("convert", result).code == 2
    assert run("convert", result, result, "--overwrite").code == 2
    for name, count in (("in", 400), ("too", 800)):  # folders of a scene
        (tmp_path / name).mkdir()
        shutil.copy(result, tmp_path / name)
        folders = (tmp_path / name, tmp_path / "in")[: count // 400]
        document = json.loads(run("convert", *folders, tmp_path / f"{name}.splat", "--json", code=0).out)
        assert document["output"]["num_gaussians"] == count
    assert run("convert", tmp_path / "none.ply", tmp_path / "d.ply").code == 3


def test_output_by_its_option_is_the_output_as_the_last_path(result: Path, tmp_path: Path, run: Run) -> None:
    by_path, by_option = tmp_path / "a.spz", tmp_path / "b.spz"
    run("convert", result, by_path, code=0)
    run("convert", result, "-o", by_option, code=0)
    assert by_option.read_bytes() == by_path.read_bytes()
    assert run("convert", "-o", by_option).code == 2


def test_full_columns_are_the_62_of_a_ply(small_scene: Path, tmp_path: Path, run: Run) -> None:
    """Unity's importer wants 62."""
    quick = ("--effort", "draft", "--fit", "none", "--budget", "200", "-q", "--set", "columns=full")
    run("compact", small_scene, "-o", tmp_path / "a.ply", *quick, code=0)
    run("convert", tmp_path / "a.ply", tmp_path / "b.ply", "--sh-degree", 0, "--set", "columns=full", code=0)
    for name in ("a.ply", "b.ply"):
        header = (tmp_path / name).read_bytes().split(b"end_header")[0]
        assert header.count(b"property float") == 62
        assert not read(tmp_path / name).shN.any()
    assert run("convert", tmp_path / "a.ply", tmp_path / "b.spz", "--set", "columns=full").code == 2


def _write_parts(add: AddOutput, path: Path, first: Path, contents: Contents) -> dict[Path, list[Path]]:
    files = [first, *(add(path.with_suffix(ending)) for ending in (".views", ".rows"))]
    for file, part in zip(files, (contents.title, len(contents.cameras), len(contents.levels[0])), strict=True):
        file.write_text(str(part))
    return {path: files}


PARTS = Format(
    ".parts", "a format of three files", None, None, 0, write=_write_parts, levels="",
    has_cameras=True, harmonics_note="no harmonics in {ending}",
)  # fmt: skip


def test_a_new_format_of_several_files_with_cameras_is_one_row(
    result: Path, tmp_path: Path, run: Run, small_scene: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gsmerge.io.formats.table.FORMATS", (PARTS, *formats.FORMATS))
    out, small = tmp_path / "out.parts", tmp_path / "small.parts"
    document = json.loads(run("convert", result, out, "--json", code=0).out)
    assert (document["output"]["format"], document["viewer_cameras"]) == (".parts", None)
    assert noted(document["notes"], "no harmonics in .parts")
    assert document["output"]["bytes"] == sum(path.stat().st_size for path in tmp_path.glob("out.*"))
    assert (tmp_path / "out.rows").read_text() == "400"
    assert_refused(run("convert", result, out), 2, "out.parts", "--overwrite")
    quick = ("--effort", "draft", "--budget", "50", "-o", small)
    assert_refused(run("compact", small_scene, *quick, "--levels", "2"), 2, "small.parts", "--levels")
    run("compact", small_scene, *quick, code=0)
    assert (tmp_path / "small.views").read_text() == str(len(gsmerge.read_scene(small_scene)))


def test_hint_reads_linear_scales(small_scene: Path, tmp_path: Path, run: Run) -> None:
    """The commands that read files take the hint, and results have logarithms."""
    scene = gsmerge.read_ply(small_scene / "scene.ply").gaussians
    data = PlyData.read(str(small_scene / "scene.ply"))
    for axis in range(3):
        data["vertex"][f"scale_{axis}"] = scene.scales[:, axis]
    data.write(str(tmp_path / "linear.ply"))
    run("convert", tmp_path / "linear.ply", tmp_path / "out.ply", "--hint", "scales=linear", code=0)
    np.testing.assert_allclose(read(tmp_path / "out.ply").scales, scene.scales, rtol=1e-5)
    loaded = gsmerge.read_scene(tmp_path / "linear.ply", cameras="none", images="none", scales="linear")
    np.testing.assert_allclose(loaded.gaussians.scales, scene.scales, rtol=1e-5)
    assert_refused(
        run("compact", small_scene, "-o", tmp_path / "x.ply", "--hint", "scales=linear"),
        3,
        "scene.ply",
        "scales=linear",
    )


def test_convert_warns_where_the_memory_is_too_small(
    made_scene: Path, tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gsmerge.runtime.memory.machine_memory", lambda: 10**5)
    said = run("convert", made_scene / "scene.ply", tmp_path / "a.spz", code=0)
    assert "this machine has 0.0 GB" in said.err
    assert "a .ply takes least" in said.err
