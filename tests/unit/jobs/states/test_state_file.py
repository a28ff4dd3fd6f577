"""The file of a state is read as a scene only if it has results; ``tests/damage/tensors.py`` has every damage."""

from __future__ import annotations

from pathlib import Path

import pytest
from damage import SOUNDS

from gsmerge import Compactor, read_scene
from gsmerge.errors import SceneError


def test_feature_gaussians_are_no_scene(tmp_path: Path) -> None:
    results, features = (SOUNDS[kind].put(tmp_path / kind) for kind in ("gsm", "gsm of features"))
    assert read_scene(results).num_gaussians == len(Compactor.load(results))
    with pytest.raises(SceneError, match="Feature Gaussians"):
        read_scene(features)
