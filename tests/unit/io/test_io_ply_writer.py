from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData
from tiny_scene import Tiny

from gsmerge.errors import SceneError
from gsmerge.io import read_ply, write_ply
from gsmerge.types import Gaussians


def with_harmonics(gaussians: Gaussians, degree: int) -> Gaussians:
    shN = np.random.default_rng(0).normal(size=(len(gaussians), (degree + 1) ** 2 - 1, 3))
    return replace(gaussians, shN=shN.astype(np.float32))


def test_the_layout_is_inrias(tmp_path: Path, tiny: Tiny) -> None:
    gaussians = with_harmonics(tiny.gaussians, 1)
    write_ply(tmp_path / "a.ply", gaussians)
    data = PlyData.read(str(tmp_path / "a.ply"))
    vertex = data["vertex"]
    assert (data.text, data.byte_order) == (False, "<")
    assert [p.name for p in vertex.properties] == [
        *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"),
        *(f"f_rest_{i}" for i in range(9)),
        *("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
    ]
    assert {p.val_dtype for p in vertex.properties} == {"f4"}
    assert vertex["f_rest_4"].tolist() == gaussians.shN[:, 1, 1].tolist()
    assert np.allclose(vertex["scale_2"], np.log(gaussians.scales[:, 2]), atol=1e-6)
    opacities = gaussians.opacities.astype(np.float64)
    assert np.allclose(vertex["opacity"], np.log(opacities / (1 - opacities)), atol=1e-6)
    assert not vertex["nx"].any()


def test_tensors_are_written_alike(tmp_path: Path, tiny: Tiny) -> None:
    write_ply(tmp_path / "a.ply", tiny.gaussians)
    tensors = tiny.gaussians.to("cpu")
    write_ply(tmp_path / "b.ply", replace(tensors, means=tensors.means.clone().requires_grad_()))
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()


def test_harmonics_are_dropped_on_demand(tmp_path: Path, tiny: Tiny) -> None:
    gaussians = with_harmonics(tiny.gaussians, 3)
    write_ply(tmp_path / "a.ply", gaussians, sh_degree=1)
    assert np.array_equal(read_ply(tmp_path / "a.ply").gaussians.shN, gaussians.shN[:, :3])
    write_ply(tmp_path / "b.ply", gaussians, sh_degree=0)
    assert read_ply(tmp_path / "b.ply").info.layout == "17-column export"
    with pytest.raises(ValueError, match="expected 0 to 3, got 4"):
        write_ply(tmp_path / "c.ply", gaussians, sh_degree=4)


def test_extremes_are_written_as_finite_numbers(tmp_path: Path, tiny: Tiny) -> None:
    few = tiny.gaussians[:3]
    extreme = replace(
        few,
        opacities=np.array([0.0, 1.0, 0.5], np.float32),
        scales=np.array([[0.1, 0.1, 0.0], [1e-38, 1e30, 1.0], [1.0, 1.0, 1.0]], np.float32),
        quats=np.array([[0.0, 0, 0, 0], [2, 0, 0, 0], [0, 0, -3, 4]], np.float32),
    )
    write_ply(tmp_path / "a.ply", extreme)
    rows = PlyData.read(str(tmp_path / "a.ply"))["vertex"].data
    assert all(np.isfinite(rows[name]).all() for name in rows.dtype.names)
    back = read_ply(tmp_path / "a.ply").gaussians
    assert back.opacities.tolist() == pytest.approx([0, 1, 0.5], abs=2e-7)
    assert ((back.opacities > 0) & (back.opacities < 1)).all()
    assert (back.scales > 0).all()
    assert back.quats[0].tolist() == [1, 0, 0, 0]
    assert back.quats[2].tolist() == pytest.approx([0, 0, -0.6, 0.8], abs=1e-6)


@pytest.mark.parametrize("field", ["means", "scales", "opacities", "sh0", "quats"])
def test_nan_is_never_written(tmp_path: Path, tiny: Tiny, field: str) -> None:
    values = getattr(tiny.gaussians, field).copy()
    values[5] = np.nan
    with pytest.raises(ValueError, match="expected finite Gaussians"):
        write_ply(tmp_path / "a.ply", replace(tiny.gaussians, **{field: values}))
    assert list(tmp_path.iterdir()) == []


def test_impossible_opacities_and_scales_are_refused(tmp_path: Path, tiny: Tiny) -> None:
    for field, value in {"opacities": 1.5, "scales": -1.0}.items():
        values = np.full_like(getattr(tiny.gaussians, field), value)
        with pytest.raises(ValueError, match="expected finite Gaussians"):
            write_ply(tmp_path / "a.ply", replace(tiny.gaussians, **{field: values}))


def test_an_existing_file_is_refused_and_stays(tmp_path: Path, tiny: Tiny) -> None:
    path = tmp_path / "a.ply"
    path.write_text("precious")
    with pytest.raises(SceneError, match="exists already"):
        write_ply(path, tiny.gaussians)
    assert path.read_text() == "precious"
    write_ply(path, tiny.gaussians, overwrite=True)
    assert read_ply(path).info.count == len(tiny.gaussians)


def test_no_gaussians_make_a_file_that_says_so(tmp_path: Path, tiny: Tiny) -> None:
    write_ply(tmp_path / "a.ply", tiny.gaussians[:0])
    assert PlyData.read(str(tmp_path / "a.ply"))["vertex"].count == 0
    with pytest.raises(SceneError, match="found 0 vertices"):
        read_ply(tmp_path / "a.ply")
