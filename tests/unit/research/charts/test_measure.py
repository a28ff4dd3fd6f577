"""Pictures of results do not depend on the unit of the world."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import scenes

from gsmerge.research.charts.measure import keep_pictures
from gsmerge.research.charts.record import picture_path


@pytest.mark.parametrize("factor", [1e-4, 1e4])
def test_units_change_no_picture(factor: float, tmp_path: Path) -> None:
    scene = scenes.make_scene(scenes.room(), scenes.arc(2))
    moved = scenes.move(scene, np.eye(3), factor, np.zeros(3))
    for owner, one in (("usual", scene), ("moved", moved)):
        assert keep_pictures(tmp_path, owner, "scene", one.gaussians, one, None) == scene.names
    usual, other = (cv2.imread(str(picture_path(tmp_path, owner, 0, "render"))) for owner in ("usual", "moved"))
    assert usual.mean() > 20
    assert np.abs(usual.astype(int) - other).mean() < 1
