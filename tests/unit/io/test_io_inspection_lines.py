"""What ``inspect`` says of files as exporters write them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from exports import depth_map_mask, export_rows, save_export, smooth_scene
from plyfile import PlyData, PlyElement
from tiny_scene import write_npz

from gsmerge.io import read_ply, write_ply
from gsmerge.measure.inspect import inspect, inspection_lines

SMOOTH = smooth_scene(48, 36)
PIXELS = np.arange(3 * 36 * 48).reshape(3, 36 * 48)


def said(path: Path) -> dict[str, str]:
    """The lines by their first word; notes and all lines of one word joined."""
    actual: dict[str, str] = {}
    for line in inspection_lines(inspect(path)):
        word, rest = line[:11].strip(), line[11:]
        actual[word] = f"{actual[word]}; {rest}" if word in actual else rest
    return actual


def test_a_plain_export(tmp_path: Path) -> None:
    lines = said(save_export(tmp_path, SMOOTH, export_rows(SMOOTH)))
    assert lines["rows"].startswith("every pixel, view-major: median 0.")
    assert lines["alignment"].startswith("one Gaussian per pixel, 3 x 36 x 48 (views x height x width); median")
    assert lines["coverage"].startswith("100 % of the pixels in every view; ")
    assert "note" not in lines


def test_several_gaussians_per_pixel(tmp_path: Path) -> None:
    rows = export_rows(SMOOTH, np.repeat(PIXELS[:, :, None], 3, 2).reshape(-1))
    lines = said(save_export(tmp_path, SMOOTH, rows))
    assert lines["cameras"].endswith("transforms.json: 3 (transforms.json)")
    assert lines["alignment"].startswith("3 Gaussians per pixel, 3 x 36 x 48 ")


def test_dropped_pixels(tmp_path: Path) -> None:
    kept = np.concatenate([np.flatnonzero(depth_map_mask(d)) + i * d.size for i, d in enumerate(SMOOTH.depths)])
    save_export(tmp_path / "gs_ply", SMOOTH, export_rows(SMOOTH, kept), cameras=False, name="0000.ply")
    write_npz(tmp_path / "exports/npz/results.npz", SMOOTH, depth=SMOOTH.depths.astype(np.float32))
    lines = said(tmp_path)
    missing = PIXELS.size - len(kept)
    assert f"none for {missing:,} of them; " in lines["alignment"]
    assert lines["note"] == f"{missing:,} pixels that the exporter dropped are put back from the depth maps"
    assert not lines["coverage"].startswith("100 %")
    actual = inspect(tmp_path)
    assert (actual["num_missing"], actual["per_pixel"]) == (missing, 1)


def test_the_camera_inside_the_file(tmp_path: Path) -> None:
    square = smooth_scene(36, 36)
    one = export_rows(square, np.tile(np.arange(36 * 36), 2))
    parts = {
        "extrinsic": square.w2c[0].reshape(-1),
        "intrinsic": square.K.reshape(-1),
        "image_size": np.array([36, 36]),
    }
    elements = [PlyElement.describe(one, "vertex")]
    elements += [PlyElement.describe(np.array([(v,) for v in values], [(name, "f4")]), name)
                 for name, values in (parts | {"version": np.array([1, 5, 0])}).items()]  # fmt: skip
    PlyData(elements, byte_order="<").write(str(tmp_path / "photo.ply"))
    lines = said(tmp_path)
    assert lines["cameras"] == "inside the .ply: 1 (SHARP)"
    assert lines["ignored"] == "element version"
    assert lines["alignment"].startswith("2 Gaussians per pixel, 1 x 36 x 36 ")


def test_rows_in_no_order(tmp_path: Path) -> None:
    some = np.random.default_rng(0).permutation(PIXELS.size)[:3000]
    lines = said(save_export(tmp_path, SMOOTH, export_rows(SMOOTH, some)))
    assert lines["alignment"] == ("not one Gaussian per pixel: 3 x 36 x 48 = 5184 (views x height x width), found 3000")
    assert "note" not in lines
    assert "rows" not in lines


@pytest.mark.parametrize("cameras", [False, True])
def test_what_compact_would_refuse(tmp_path: Path, cameras: bool) -> None:
    save_export(tmp_path, SMOOTH, export_rows(SMOOTH), cameras=cameras)
    if cameras:
        (tmp_path / "transforms.json").write_text("nonsense")
    lines = said(tmp_path)
    assert lines["alignment"].startswith("not measured: ")
    assert lines["compact"] == "would refuse the scene as it is"
    assert lines["exporter"] == "not known before the cameras fit"


def test_our_own_files(tmp_path: Path) -> None:
    save_export(tmp_path, SMOOTH, export_rows(SMOOTH))
    write_ply(tmp_path / "own.ply", read_ply(tmp_path / "scene.ply").gaussians[::7])
    assert said(tmp_path / "own.ply")["exporter"] == "gsmerge"
