"""Write USD with the schema ``ParticleField3DGaussianSplat`` of OpenUSD 26.3 and later (UsdVol), by ``usd-core``.

The axis y points up in USD, and down in a ``.ply``. Therefore Gaussians are rotated by half a turn about z, as in a
``.glb``. USD is not read, since its parser has no limits of memory and time, and opens any file that a layer names.
"""

from __future__ import annotations

import struct
import tempfile
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from zipfile import ZIP_STORED, ZipFile

import numpy as np

from gsmerge.errors import UsageError
from gsmerge.io.archives import new_member
from gsmerge.io.formats.arrays import Columns, to_columns, turn_half
from gsmerge.kernels.elementary import exp
from gsmerge.types import Gaussians

MAX_DEGREE = 3  # the highest that renderers draw
PRIM, LAYER = "Gaussians", "scene.usdc"
# The version is that of the extra; the second command also works for a wheel and in a checkout
INSTALL = 'install gsmerge[usd], or pip install "usd-core>=26.3,<27"'
# The content of a member of a USDZ begins at a multiple of 64 bytes. An extra field of this kind pads its header, which
# has 30 bytes besides the name.
_ALIGNMENT, _PADDING, _ZIP_HEADER, _EXTRA = 64, 0x1986, 30, struct.Struct("<HH")
_REACH = 3.0  # standard deviations around a centre that the extent includes


def usdc_bytes(gaussians: Gaussians, _: Sequence[str] = ()) -> bytes:
    """Encode a ``.usdc``, which is binary, without comments; ValueError if there is NaN or inf."""
    usd, columns = require_usd(), turn_half(to_columns(gaussians, MAX_DEGREE))
    stage = usd.Usd.Stage.CreateInMemory(LAYER)
    usd.UsdGeom.SetStageUpAxis(stage, usd.UsdGeom.Tokens.y)
    usd.UsdGeom.SetStageMetersPerUnit(stage, 1.0)  # approximately, for most scenes of feed-forward models
    splats = usd.UsdVol.ParticleField3DGaussianSplat.Define(stage, f"/{PRIM}")
    stage.SetDefaultPrim(splats.GetPrim())
    _fill(splats, columns, usd.Vt)
    with tempfile.TemporaryDirectory(prefix="gsmerge-") as folder:
        path = Path(folder) / LAYER
        stage.GetRootLayer().Export(str(path))
        return path.read_bytes()


def usdz_bytes(gaussians: Gaussians, _: Sequence[str] = ()) -> bytes:
    """Encode a ``.usdz``, an archive of one ``.usdc``; ValueError if there is NaN or inf.

    USD's own writer is not used, since it puts the time of day into the archive.
    """
    package, layer = BytesIO(), new_member(LAYER)
    padding = -(_ZIP_HEADER + len(layer.filename) + _EXTRA.size) % _ALIGNMENT
    layer.extra = _EXTRA.pack(_PADDING, padding) + bytes(padding)
    with ZipFile(package, "w", ZIP_STORED) as archive:
        archive.writestr(layer, usdc_bytes(gaussians))
    return package.getvalue()


def require_usd() -> SimpleNamespace:
    """Import the modules of the package ``usd-core``; UsageError if it is missing, or older than the schema."""
    try:
        from pxr import Sdf, Usd, UsdGeom, UsdVol, Vt
    except ImportError as error:
        raise UsageError(f"USD: expected the package usd-core, found none; {INSTALL}") from error
    if not hasattr(UsdVol, "ParticleField3DGaussianSplat"):
        version = ".".join(map(str, Usd.GetVersion()[1:]))
        raise UsageError(f"USD: expected usd-core 26.3 or later, which knows Gaussians, found {version}; {INSTALL}")
    return SimpleNamespace(Sdf=Sdf, Usd=Usd, UsdGeom=UsdGeom, UsdVol=UsdVol, Vt=Vt)


def _fill(splats: Any, columns: Columns, vt: Any) -> None:
    """Set the attributes of the prim: linear scales, opacities from 0 to 1, and all harmonics of each Gaussian."""

    def vectors(values: np.ndarray) -> Any:
        return vt.Vec3fArray.FromNumpy(np.ascontiguousarray(values, np.float32))

    scales = exp(columns.log_scales)
    quats = np.roll(columns.quats, -1, axis=1)  # xyzw in memory
    harmonics = np.concatenate([columns.sh0[:, None], columns.harmonics], 1)
    reach = _REACH * scales.max(1, keepdims=True)
    splats.CreateExtentAttr(vectors(np.stack([(columns.means - reach).min(0), (columns.means + reach).max(0)])))
    splats.CreatePositionsAttr(vectors(columns.means))
    splats.CreateOrientationsAttr(vt.QuatfArray.FromNumpy(np.ascontiguousarray(quats, np.float32)))
    splats.CreateScalesAttr(vectors(scales))
    splats.CreateOpacitiesAttr(vt.FloatArray.FromNumpy(columns.opacities.astype(np.float32)))
    splats.CreateRadianceSphericalHarmonicsDegreeAttr(round(harmonics.shape[1] ** 0.5) - 1)
    splats.CreateRadianceSphericalHarmonicsCoefficientsAttr(vectors(harmonics.reshape(-1, 3)))
    splats.CreateProjectionModeHintAttr("perspective")
    splats.CreateSortingModeHintAttr("zDepth")
