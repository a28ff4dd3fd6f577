"""The command line and Python make the same results of the same scenes and settings."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from shared import write_smallest

import gsmerge
from gsmerge.geometry.views import subset

from .conftest import Run


@pytest.fixture(scope="module")
def one_photo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a scene of one view, whose number of Gaussians goes by other rules. Read only."""
    folder = write_smallest(tmp_path_factory.mktemp("one") / "scene")
    alone = subset(gsmerge.read_scene(folder), [0]).gaussians
    gsmerge.write_ply(folder / "scene.ply", alone, overwrite=True)
    cameras = json.loads((folder / "transforms.json").read_text())
    (folder / "transforms.json").write_text(json.dumps(cameras | {"frames": cameras["frames"][:1]}))
    return folder


@pytest.mark.parametrize("scene", ["smallest_scene", "one_photo"])
@pytest.mark.parametrize("settings", [{}, {"budget": "auto"}, {"budget": "mobile"}, {"levels": 2}, {"k": 2}])
def test_a_file_holds_what_python_returns(
    scene: str, settings: dict[str, str], tmp_path: Path, run: Run, request: pytest.FixtureRequest
) -> None:
    folder = request.getfixturevalue(scene)
    words = [word for name, value in settings.items() for word in (f"--{name}", str(value))]
    run("compact", folder, "--effort", "draft", "-o", tmp_path / "a.ply", *words, code=0)
    result = gsmerge.compact(folder, effort="draft", **settings)
    written = gsmerge.read_ply(tmp_path / "a.ply").gaussians
    assert np.array_equal(written.means, result.gaussians.means.astype(np.float32))
    if scene == "one_photo":  # a draft of one photo has four for each superpixel, unless their number is asked for
        assert result.report.options["k"] == settings.get("k", 4 if "budget" not in settings else 1)
