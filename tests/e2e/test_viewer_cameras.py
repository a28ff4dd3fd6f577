"""``compact`` writes the input views beside its result, so that viewers start at one of them."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from bare_files import write_without_grid
from messages import ERROR, says
from tiny_scene import edited_json

import gsmerge
from gsmerge.io.cameras.viewer_cameras import viewer_cameras, viewer_cameras_path

Run = Callable[..., Any]
QUICK = ("--set", "superpixels=40", "--fit", "none", "--set", "checkpoint=none")


def test_compact_writes_the_input_views_beside_its_result(smallest_copy: Path, run: Run) -> None:
    done = run("compact", smallest_copy, "-o", smallest_copy / "small.ply", *QUICK, code=0)
    assert done.out.splitlines()[-1].endswith("small.cameras.json")
    scene = gsmerge.read_scene(smallest_copy)
    entries = json.loads((smallest_copy / "small.cameras.json").read_text())
    assert [entry["img_name"] for entry in entries] == list(scene.names)
    assert list(entries[0]) == ["id", "img_name", "width", "height", "position", "rotation", "fy", "fx"]
    np.testing.assert_allclose([entry["position"] for entry in entries], scene.cameras.centres, atol=1e-9)
    back = gsmerge.read_cameras(smallest_copy / "small.cameras.json")
    np.testing.assert_allclose(back.viewmats, scene.cameras.viewmats, atol=1e-9)


def test_viewer_cameras_keep_a_principal_point_off_the_middle(smallest_copy: Path) -> None:
    cameras = gsmerge.read_scene(smallest_copy).cameras
    Ks = cameras.Ks.copy()
    Ks[1, :2, 2] += (3.25, -2.5)
    (smallest_copy / "a.json").write_text(viewer_cameras(replace(cameras, Ks=Ks), ["a", "b", "c"]))
    entries = json.loads((smallest_copy / "a.json").read_text())
    assert ["cx" in entry for entry in entries] == [False, True, False]
    np.testing.assert_allclose(gsmerge.read_cameras(smallest_copy / "a.json").Ks, Ks, atol=1e-6)


def test_viewer_cameras_are_in_the_frame_of_the_gaussians(smallest_copy: Path, run: Run) -> None:
    path = smallest_copy / "transforms.json"
    with edited_json(path) as content:
        for frame in content["frames"]:
            for row in frame["transform_matrix"][:3]:
                row[3] *= 3
    assert run("compact", smallest_copy, "-o", smallest_copy / "small.ply", *QUICK, "-q").code == 0
    back = gsmerge.read_cameras(smallest_copy / "small.cameras.json")
    np.testing.assert_allclose(back.viewmats, gsmerge.read_scene(smallest_copy).cameras.viewmats, atol=1e-9)
    assert np.abs(back.viewmats[:, :3, 3]).max() < 0.5 * np.abs(gsmerge.read_cameras(path).viewmats[:, :3, 3]).max()


def test_no_viewer_cameras_are_written_where_unwanted_or_unknown(smallest_copy: Path, run: Run, tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    done = run("compact", smallest_copy, "-o", out / "a.ply", "--set", "viewer_cameras=false", *QUICK, "--json", code=0)
    assert json.loads(done.out)["viewer_cameras"] is None
    bare = write_without_grid(smallest_copy / "scene.ply", out / "scene.ply")
    done = run("compact", bare, "-o", out / "b.ply", *QUICK, code=0)
    assert "viewers" not in done.out
    assert sorted(path.name for path in out.iterdir()) == ["a.ply", "b.ply", "scene.ply"]


def test_result_in_a_second_format_shares_the_cameras(smallest_copy: Path, run: Run, tmp_path: Path) -> None:
    """They are there, with the same content; those of other views are no result's own."""
    out = tmp_path / "out"
    out.mkdir()
    run("compact", smallest_copy, "-o", out / "a.ply", *QUICK, "-q", code=0)
    before = (out / "a.cameras.json").read_bytes()
    done = run("compact", smallest_copy, "-o", out / "a.spz", *QUICK, code=0)
    assert done.out.splitlines()[-1].endswith("a.cameras.json")
    assert (out / "a.cameras.json").read_bytes() == before
    run("compact", smallest_copy, "-o", out / "a.cameras.json", *QUICK, code=2)
    entries = json.loads(before)
    for change in ({"img_name": "other"}, {"fx": 1.0 + entries[0]["fx"]}, {"width": 1}):
        (out / "a.cameras.json").write_text(json.dumps([entries[0] | change, *entries[1:]]))
        with pytest.MonkeyPatch.context() as patch:  # before anything is compacted
            patch.setattr("gsmerge.run.compact_scene", Mock(side_effect=AssertionError))
            done = run("compact", smallest_copy, "-o", out / "a.sog", *QUICK, code=2)
        assert says(done.err.removeprefix(ERROR), "a.cameras.json", "cameras", "--overwrite")
    assert sorted(path.name for path in out.iterdir()) == ["a.cameras.json", "a.ply", "a.spz"]
    run("compact", smallest_copy, "-o", out / "a.sog", "--overwrite", *QUICK, "-q", code=0)
    assert (out / "a.cameras.json").read_bytes() == before


def test_conversions_beside_a_result_share_its_cameras(smallest_copy: Path, run: Run, tmp_path: Path) -> None:
    """Reading and writing them again may change their last digits, and is no reason to refuse."""
    names = ("b.spz", "b.glb", "b.splat", "b.ply", "a.ply", "a.sog")
    run("compact", smallest_copy, "-o", tmp_path / names[0], *QUICK, "-q", code=0)
    first, last = tmp_path / "b.cameras.json", tmp_path / "a.cameras.json"
    before = first.read_text()
    for source, output in pairwise(names):
        run("convert", tmp_path / source, tmp_path / output, "-q", code=0)
    assert first.read_text() == before
    one, other = (gsmerge.read_cameras(path) for path in (first, last))
    assert one.names == other.names
    np.testing.assert_allclose(one.viewmats, other.viewmats, atol=1e-9)
    done = run("convert", tmp_path / names[0], tmp_path / "a.spz", "--scale", 2)
    assert says(done.err.removeprefix(ERROR), "a.cameras.json", "other cameras", "--overwrite")


@pytest.mark.parametrize(
    ("output", "expected"), [("small.compressed", "small"), ("a/x.compact", "a/x.compact"), ("a" * 251, "a" * 242)]
)
def test_file_of_viewer_cameras_is_named_after_the_result(output: str, expected: str) -> None:
    assert viewer_cameras_path(Path(f"{output}.ply")) == Path(f"{expected}.cameras.json")


def test_a_folder_with_a_result_and_its_cameras_needs_no_options(smallest_copy: Path, run: Run, tmp_path: Path) -> None:
    """The output's folders are made; the cameras beside a result go before others in the folder."""
    out = tmp_path / "new" / "out"
    run("compact", smallest_copy, "-o", out / "small.ply", *QUICK, "-q", code=0)
    assert sorted(path.name for path in out.iterdir()) == ["small.cameras.json", "small.ply"]
    count = len(gsmerge.read_scene(smallest_copy))
    for place in (out, out / "small.ply"):
        facts = json.loads(run("inspect", place, "--json", code=0).out)
        assert (facts["cameras"], facts["num_views"]) == (str(out / "small.cameras.json"), count)
    run("render", out, "-o", tmp_path / "pictures", code=0)
    assert len(list((tmp_path / "pictures").iterdir())) == count
    document = json.loads(run("evaluate", out, "--lpips", "none", "--json", code=0).out)
    assert document["num_views"]["context"] == count
    assert not says(run("view", out, "-o", tmp_path / "view.html", code=0).err, "placed")
    (out / "transforms.json").write_bytes((smallest_copy / "transforms.json").read_bytes())
    facts = json.loads(run("inspect", out / "small.ply", "--json", code=0).out)
    assert facts["cameras"] == str(out / "small.cameras.json")
