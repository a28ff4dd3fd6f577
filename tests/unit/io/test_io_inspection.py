from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from tiny_scene import Tiny

from gsmerge.errors import SceneError
from gsmerge.inspect import inspect
from gsmerge.io import write_ply


def test_a_scene_that_fits(tiny_folder: Path, tiny: Tiny) -> None:
    found = inspect(tiny_folder)
    assert found.count == 840
    assert found.bytes == (tiny_folder / "scene.ply").stat().st_size
    assert sum(found.bytes_by_attribute.values()) == 840 * 68
    assert (found.num_views, found.width, found.height) == (3, 20, 14)
    assert found.camera_format == "transforms.json"
    assert found.images == str(tiny_folder / "images")
    assert found.alignment is not None
    assert found.alignment.ok
    assert found.alignment_problem is None
    assert found.notes == ()
    low, high = (torch.quantile(tiny.gaussians.means, q, dim=0).tolist() for q in (0.01, 0.99))
    assert found.box_low == pytest.approx(low, abs=1e-4)
    assert found.box_high == pytest.approx(high, abs=1e-4)


def test_it_is_plain_json(tiny_folder: Path) -> None:
    found = inspect(tiny_folder)
    document = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    assert document == found.to_dict()
    assert document["alignment"]["ok"] is True


def test_a_ply_without_cameras(tmp_path: Path, tiny: Tiny) -> None:
    found = inspect(tiny.save(tmp_path, cameras=False, images=False) / "scene.ply")
    assert (found.num_views, found.cameras, found.camera_format, found.images) == (0, None, None, None)
    assert found.alignment is None
    assert found.alignment_problem is not None
    assert "no cameras found" in found.alignment_problem


def test_cameras_that_do_not_fit_are_reported(tiny_folder: Path, tiny: Tiny) -> None:
    generator = torch.Generator().manual_seed(0)
    some = torch.randperm(840, generator=generator)[:700]
    write_ply(tiny_folder / "scene.ply", tiny.gaussians[some], overwrite=True)
    found = inspect(tiny_folder)
    assert found.num_views == 3
    assert found.alignment is None
    assert "expected one Gaussian per pixel" in str(found.alignment_problem)
    (tiny_folder / "transforms.json").write_text("nonsense")
    found = inspect(tiny_folder)
    assert found.num_views == 0
    assert "expected JSON" in str(found.alignment_problem)


def test_odd_values_are_counted(tiny_folder: Path, tiny: Tiny) -> None:
    opacities, quats, scales = (getattr(tiny.gaussians, f).clone() for f in ("opacities", "quats", "scales"))
    opacities[:4], opacities[4:9] = 1, 0
    scales[3] = 1e14
    odd = replace(tiny.gaussians, opacities=opacities, quats=quats, scales=scales)
    write_ply(tiny_folder / "scene.ply", odd, overwrite=True)
    data = bytearray((tiny_folder / "scene.ply").read_bytes())
    start = data.index(b"end_header\n") + 11
    data[start : start + 4] = b"\x00\x00\xc0\x7f"  # NaN
    data[start + 2 * 68 - 16 : start + 2 * 68] = bytes(16)  # the quaternion of row 1
    scale = start + 5 * 68 + 40
    data[scale : scale + 4] = b"\x00\x00\x20\x42"  # a log scale of 40
    (tiny_folder / "scene.ply").write_bytes(data)
    found = inspect(tiny_folder)
    assert (found.num_nonfinite, found.num_zero_quats, found.num_clipped_scales) == (1, 1, 1)
    assert (found.num_opaque, found.num_transparent) == (3, 5)
    assert len(found.notes) == 3
    assert found.alignment is not None


def test_an_unreadable_ply_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "scene.ply").write_text("hello")
    with pytest.raises(SceneError, match="does not start with the line 'ply'"):
        inspect(tmp_path)
