"""Crops from files: the forms in which they are written, and what is none."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from messages import refuses

from gsmerge.cli.parameters import Args
from gsmerge.errors import SceneError
from gsmerge.facts.crop import inside_crop
from gsmerge.geometry import euler_to_rotmat, rotmat_to_euler
from gsmerge.io.crop_file import read_crop
from gsmerge.settings.stages import CleanOptions, parse_crop

TURN = euler_to_rotmat(np.array([20.0, -50.0, 110.0]))


def crop(folder: Path, **table: Any) -> str:
    path = folder / "crop.json"
    path.write_text(json.dumps(table))
    return read_crop(path)


def matrix_of(rotation: np.ndarray, scales: tuple[float, ...], middle: tuple[float, ...]) -> list[list[float]]:
    rows = np.eye(4)
    rows[:3, :3], rows[:3, 3] = rotation * scales, middle
    return rows.tolist()  # type: ignore[no-any-return]


def test_every_form_of_a_box_is_the_same_box(tmp_path: Path) -> None:
    plain = parse_crop("box:0,-2,1,2,2,7")
    assert parse_crop(crop(tmp_path, shape="box", min=[0, -2, 1], max=[2, 2, 7])) == ("box", (*plain[1], 0, 0, 0))
    turned = parse_crop(crop(tmp_path, shape="box", center=[1, 0, 4], size=[2, 4, 6], rotate=[20, -50, 110]))
    assert turned == ("box", (*plain[1], 20, -50, 110))
    for scales in ((1.0, 2.0, 3.0), (-1.0, 2.0, 3.0)):  # the latter mirrored
        matrix = matrix_of(TURN, scales, (1.0, 0.0, 4.0))
        points = np.random.default_rng(0).uniform(-4, 8, (2000, 3))
        inside = inside_crop(points, crop(tmp_path, shape="box", matrix=matrix))
        local = (points - [1, 0, 4]) @ TURN / [1, 2, 3]
        np.testing.assert_array_equal(inside, (np.abs(local) <= 1).all(1))
        assert 20 < inside.sum() < 200


def test_both_forms_of_a_sphere(tmp_path: Path) -> None:
    assert crop(tmp_path, shape="sphere", center=[0, 0.5, 2], radius=1.5) == "sphere:0.0,0.5,2.0,1.5"
    shape, numbers = parse_crop(crop(tmp_path, shape="sphere", matrix=matrix_of(TURN, (1.5,) * 3, (0, 0.5, 2))))
    assert shape == "sphere"
    np.testing.assert_allclose(numbers, (0, 0.5, 2, 1.5), atol=1e-12)


@pytest.mark.parametrize("degrees", [(0, 0, 0), (20, -50, 110), (-170, 89, 3), (30, 90, 40), (0, -90, 0), (180, 0, 0)])
def test_angles_are_those_of_the_turn(degrees: tuple[float, ...]) -> None:
    rotation = euler_to_rotmat(np.array(degrees, float))
    np.testing.assert_allclose(euler_to_rotmat(rotmat_to_euler(rotation)), rotation, atol=1e-8)


def test_the_command_line_reads_crops_from_files(tmp_path: Path) -> None:
    crop(tmp_path, shape="sphere", center=[0, 0, 2], radius=1)
    for args in (Args(crop=str(tmp_path / "crop.json")), Args(set=[f"crop={tmp_path / 'crop.json'}"])):
        assert args.make(CleanOptions)[0].crop == "sphere:0.0,0.0,2.0,1.0"
    with refuses(SceneError, "none.json", "no such file"):
        Args(crop=str(tmp_path / "none.json")).make(CleanOptions)


@pytest.mark.skipif(sys.version_info < (3, 11), reason="the standard library reads TOML from 3.11 on")
def test_toml(tmp_path: Path, root: Path) -> None:
    page = (root / "docs" / "guide" / "convert.md").read_text()
    (tmp_path / "guide.toml").write_text(page.partition("```toml\n")[2].partition("```")[0])
    assert read_crop(tmp_path / "guide.toml") == "box:-1.0,-1.0,0.0,1.0,1.0,4.0,0.0,30.0,0.0"
    (tmp_path / "crop.TOML").write_text('shape = "box"\nmin = [0, 0, 0]\nmax = [1, 1, 2.5]')
    assert read_crop(tmp_path / "crop.TOML") == "box:0.0,0.0,0.0,1.0,1.0,2.5,0.0,0.0,0.0"
