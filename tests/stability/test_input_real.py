"""One real scene is read right, where the measuring data is at hand."""

from __future__ import annotations

import os
from pathlib import Path
from types import ModuleType

import pytest
from scripts import load_script

from gsmerge.reading.read_scene import load_scene

pytestmark = pytest.mark.slow


def capture(root: Path) -> Path:
    place = Path(os.environ.get("GSMERGE_DATA", root.parent / "shared")) / "scenes" / "eval" / "lightfield"
    if not place.is_dir():
        pytest.skip("no captures (GSMERGE_DATA)")
    return place


@pytest.fixture(scope="module")
def exports(root: Path) -> ModuleType:
    return load_script(root / "benchmarks" / "captures.py")


def test_plain_export_lines_up_with_its_pixels(exports: ModuleType, root: Path, tmp_path: Path) -> None:
    ply = exports.write_export(capture(root), tmp_path, "plain", max_views=2)
    loaded = load_scene(ply)
    assert len(loaded.scene) == 2
    assert loaded.alignment.ok
    assert loaded.alignment.worst_px < 0.25  # the exporter moves means by up to a quarter of a pixel
    assert loaded.alignment.share_within_1px > 0.999
    assert loaded.scene.images is not None
    assert loaded.notes == ()


def test_rows_of_a_pruned_export_find_their_pixels(exports: ModuleType, root: Path, tmp_path: Path) -> None:
    ply = exports.write_export(capture(root), tmp_path, "da3", max_views=2, nested=1.7)
    loaded = load_scene(ply)
    assert loaded.alignment.share_within_1px > 0.999
    assert loaded.recovery.frame.scale == pytest.approx(1 / 1.7, rel=2e-3)
    assert loaded.scene.num_gaussians == loaded.info.count
