"""Damaged ``.splat`` files are refused; whole ones are read in ``test_ply.py``."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gsmerge.errors import SceneError
from gsmerge.io import read_gaussians


@pytest.mark.parametrize(
    ("content", "message"),
    [(b"", "found 0 bytes"), (bytes(33), "found 33 bytes"), (np.full(8, np.nan, "<f4").tobytes(), "NaN or inf")],
)
def test_damage_is_refused(content: bytes, message: str, tmp_path: Path) -> None:
    (tmp_path / "a.splat").write_bytes(content)
    with pytest.raises(SceneError, match=message):
        read_gaussians(tmp_path / "a.splat")
