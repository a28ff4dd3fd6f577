"""What notebooks show of objects: one short line, and reports and results as tables with a picture."""

from __future__ import annotations

import gc
import html
import pickle
import re
from functools import cache
from pathlib import Path

import pytest
from shared import make_once, write_scene

import gsmerge


def write_tiny(folder: Path) -> None:
    write_scene(folder, num_views=3, width=32, height=24)


@cache
def read_tiny() -> gsmerge.Scene:
    """Return the scene, one object for all tests: a result shows its scene as long as that is there."""
    return gsmerge.read_scene(make_once("notebooks", write_tiny))


@pytest.fixture(scope="module")
def tiny_scene() -> Path:
    return make_once("notebooks", write_tiny)


@pytest.fixture(scope="module")
def scene() -> gsmerge.Scene:
    return read_tiny()


@pytest.fixture(scope="module")
def result() -> gsmerge.CompactResult:
    return gsmerge.compact(read_tiny(), effort="draft", budget=100, levels=2)


@pytest.mark.slow
def test_objects_are_one_short_line(scene: gsmerge.Scene, result: gsmerge.CompactResult, tiny_scene: Path) -> None:
    views, size = len(scene), f"{scene.cameras.width} x {scene.cameras.height}"
    file = gsmerge.read_ply(tiny_scene / "scene.ply")
    cameras = gsmerge.read_cameras(tiny_scene / "transforms.json")
    options = gsmerge.EvaluateOptions(lpips=(), fog=False)
    compactor = gsmerge.Compactor(superpixels="2%", checkpoint="none")
    compactor.extend(scene)
    shown = [
        (scene, (f"{scene.num_gaussians:,} Gaussians", f"{views} views of {size}", "images", "of pixels")),
        (scene.gaussians, (f"{len(scene.gaussians):,}", "degree 0")),
        (scene.cameras, (str(views), size)),
        (gsmerge.Views(scene.cameras, scene.images, scene.names), (str(views), size)),
        (gsmerge.render(scene.gaussians, scene.cameras[[0]], with_depths=True), ("1", size, "depths")),
        (result, ("100", size, "1 coarser")),
        (result.report, (f"{scene.num_gaussians:,} -> 100", "dB")),
        (file, (f"{len(scene.gaussians):,}", str(tiny_scene / "scene.ply"))),
        (cameras, (str(views), cameras.path, cameras.source)),
        (compactor, ("Gaussians", "1 batch")),
        (compactor.state, ("Gaussians", "1 batch")),
        (gsmerge.evaluate(scene, {"small": result.gaussians}, options=options), ("input", "small", "dB", "photos")),
    ]  # fmt: skip
    for value, words in shown:
        text = repr(value)
        assert text.startswith(type(value).__name__ + "(")
        assert len(text) < 300
        assert "\n" not in text
        assert all(word in text for word in words), text
    assert "no views" in repr(gsmerge.Scene(scene.gaussians, scene.cameras[[]], None, None, ()))


def test_a_result_shows_its_scene_beside_it(
    scene: gsmerge.Scene, result: gsmerge.CompactResult, tmp_path: Path
) -> None:
    page = result.show()
    assert re.match(r"Page\(4.3 % of the Gaussians, \d.\d dB closer to its own photos, \d", repr(page))
    shown = re.fullmatch(r'<iframe srcdoc="([^"]*)" style="[^"]*" allowfullscreen></iframe>', page._repr_html_())
    assert html.unescape(shown[1]) == page.text
    assert page.text.count('class="card"') >= len(scene)
    path = page.save(tmp_path / "page.html")
    assert path.read_text(encoding="utf-8") == page.text
    page.save(path)  # as the command, in place of a page
    path.write_text("mine")
    with pytest.raises(gsmerge.SceneError, match="exists already"):
        page.save(path)
    assert page.save(path, overwrite=True).read_text(encoding="utf-8") == page.text
    with pytest.raises(ValueError, match=r"page.txt: expected a name ending in .html"):
        page.save(tmp_path / "page.txt")


@pytest.mark.slow
def test_a_result_does_not_keep_its_scene(tiny_scene: Path, result: gsmerge.CompactResult) -> None:
    copy = pickle.loads(pickle.dumps(result))
    assert repr(copy.show()).startswith("Page(100 Gaussians")  # alone: the other process has no scene
    assert "dB closer" in repr(copy.show(tiny_scene)) or "dB farther" in repr(copy.show(tiny_scene))
    other = gsmerge.compact(tiny_scene, effort="draft", budget=100)
    assert other.scene == tiny_scene
    held = gsmerge.compact(gsmerge.read_scene(tiny_scene), effort="draft", budget=100)
    gc.collect()
    assert not isinstance(held.scene, str | Path)
    assert held.scene is not None
    assert held.scene() is None


@pytest.mark.slow
def test_views_are_of_paths_gaussians_and_results(tiny_scene: Path, scene: gsmerge.Scene, tmp_path: Path) -> None:
    few = scene.gaussians[::5]
    gsmerge.write_ply(tmp_path / "few.ply", few)
    pages = [gsmerge.view(tiny_scene, {"few": one}) for one in (few, tmp_path / "few.ply")]
    assert repr(pages[0]).split(",")[:2] == repr(pages[1]).split(",")[:2]
    assert "few" in pages[0].text
    alone = gsmerge.view(gsmerge.Scene(few, scene.cameras[[]], None, None, ()))
    assert repr(alone).startswith(f"Page({len(few):,} Gaussians")
