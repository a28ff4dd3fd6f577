"""USD is read back by usd-core, with its own schema."""

from __future__ import annotations

import sys
from pathlib import Path
from zipfile import ZipFile

import numpy as np
import pytest
from made_gaussians import random_gaussians
from messages import refuses

from gsmerge import Gaussians
from gsmerge.errors import SceneError, UsageError
from gsmerge.geometry import covariances
from gsmerge.io import read_gaussians, write_gaussians
from gsmerge.io.formats.arrays import to_columns, turn_half

pytest.importorskip("pxr", reason="usd-core is not installed: pip install 'usd-core>=26.3,<27'")
from pxr import Sdf, Usd, UsdGeom, UsdVol

ENDINGS = (".usdc", ".usdz")


def read_usd(path: Path) -> Gaussians:
    """Read the default prim, in its own frame."""
    stage = Usd.Stage.Open(str(path))  # whose prims end with it
    splats = UsdVol.ParticleField3DGaussianSplat(stage.GetDefaultPrim())
    degree = splats.GetRadianceSphericalHarmonicsDegreeAttr().Get()
    means, scales, opacities, coefficients = (
        np.array(attribute.Get())
        for attribute in (
            splats.GetPositionsAttr(), splats.GetScalesAttr(), splats.GetOpacitiesAttr(),
            splats.GetRadianceSphericalHarmonicsCoefficientsAttr(),
        )
    )  # fmt: skip
    quats = [(q.GetReal(), *q.GetImaginary()) for q in splats.GetOrientationsAttr().Get()]
    harmonics = coefficients.reshape(len(means), (degree + 1) ** 2, 3)
    return Gaussians(means, np.array(quats, np.float32), scales, opacities, harmonics[:, :1], harmonics[:, 1:])


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize("degree", [0, 3])
def test_usd_core_reads_the_same_upright(ending: str, degree: int, tmp_path: Path) -> None:
    gaussians = random_gaussians(50, 1, degree=degree)
    write_gaussians(tmp_path / f"a{ending}", gaussians)
    actual = read_usd(tmp_path / f"a{ending}")
    turn = np.diag([-1.0, -1.0, 1.0])
    np.testing.assert_allclose(actual.means, gaussians.means @ turn, rtol=1e-6)
    expected = turn @ covariances(gaussians.quats, gaussians.scales) @ turn
    np.testing.assert_allclose(covariances(actual.quats, actual.scales), expected, atol=1e-5)
    np.testing.assert_allclose(actual.opacities, gaussians.opacities, atol=1e-7)
    np.testing.assert_allclose(actual.sh0, gaussians.sh0, atol=1e-6)
    np.testing.assert_allclose(actual.shN, turn_half(to_columns(gaussians, 3)).harmonics, atol=1e-6)


def test_the_stage_says_what_viewers_ask_for(tmp_path: Path) -> None:
    gaussians = random_gaussians(50, 1)
    write_gaussians(tmp_path / "a.usdc", gaussians)
    stage = Usd.Stage.Open(str(tmp_path / "a.usdc"))
    prim = stage.GetDefaultPrim()
    assert (str(prim.GetPath()), prim.GetTypeName()) == ("/Gaussians", "ParticleField3DGaussianSplat")
    assert (UsdGeom.GetStageUpAxis(stage), UsdGeom.GetStageMetersPerUnit(stage)) == ("Y", 1.0)
    splats = UsdVol.ParticleField3DGaussianSplat(prim)
    assert splats.GetSortingModeHintAttr().Get() == "zDepth"
    low, high = np.array(splats.GetExtentAttr().Get())
    means = np.array(splats.GetPositionsAttr().Get())
    assert (low < means.min(0)).all()
    assert (high > means.max(0)).all()


def test_an_archive_holds_no_time_of_day_and_is_aligned(tmp_path: Path) -> None:
    """By the rules of USDZ: not compressed, and contents at multiples of 64 bytes."""
    write_gaussians(tmp_path / "a.usdz", random_gaussians(50, 1))
    package = Sdf.ZipFile.Open(str(tmp_path / "a.usdz"))
    info = package.GetFileInfo(*package.GetFileNames())
    assert (info.compressionMethod, info.dataOffset % 64, info.encrypted) == (0, 0, False)
    with ZipFile(tmp_path / "a.usdz") as archive:
        assert archive.testzip() is None
        assert [one.date_time for one in archive.infolist()] == [(1980, 1, 1, 0, 0, 0)]


@pytest.mark.parametrize("ending", ENDINGS)
def test_it_is_not_read(ending: str, tmp_path: Path) -> None:
    write_gaussians(tmp_path / f"a{ending}", random_gaussians(3, 1))
    with refuses(SceneError, f"a{ending}", ".ply", ending):
        read_gaussians(tmp_path / f"a{ending}")


def test_without_usd_core(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patched:
        patched.delattr(UsdVol, "ParticleField3DGaussianSplat")
        with refuses(UsageError, "USD", "26.3"):
            write_gaussians(tmp_path / "a.usdc", random_gaussians(3, 1))
    monkeypatch.setitem(sys.modules, "pxr", None)
    with refuses(UsageError, "USD", "pip", "usd-core>=26.3,<27"):
        write_gaussians(tmp_path / "a.usdc", random_gaussians(3, 1))
    assert list(tmp_path.iterdir()) == []
