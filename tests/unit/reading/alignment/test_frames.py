"""The words on a similarity leave out what it does not change."""

from __future__ import annotations

import numpy as np
import pytest
from tiny_scene import make_tiny, rotation

from gsmerge import Cameras
from gsmerge.method.geometry.transforms import Similarity
from gsmerge.reading.alignment.frames import fit_frame

TINY = make_tiny()
SOME = np.array([0.5, -2.0, 1.0])


@pytest.mark.parametrize(
    ("degrees", "scale", "shift", "words"),
    [
        (5.0, 0.5883, SOME, "rotated by 5.0 degrees, positions scaled by 0.5883 and shifted by 0.5, -2, 1"),
        (5.0, 1.0, 0 * SOME, "rotated by 5.0 degrees"),
        (0.01, 0.5883, 0 * SOME, "moved, positions scaled by 0.5883"),
        (0.0, 1.00001, SOME, "moved, positions shifted by 0.5, -2, 1"),
        (0.0, 1.0, 1e-6 * SOME, "moved"),
    ],
)
def test_a_frame_names_only_what_it_changes(degrees: float, scale: float, shift: np.ndarray, words: str) -> None:
    cameras = Cameras(TINY.w2c, np.tile(TINY.K, (3, 1, 1)), TINY.width, TINY.height)
    frame = Similarity(rotation(0.0, np.radians(degrees), 0.0), scale, shift)
    assert fit_frame(cameras, frame.move_viewmats(TINY.w2c), None).description == words
