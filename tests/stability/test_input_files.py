"""Damaged, missing and misplaced files: one line each, and nothing half-written."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData, PlyElement

from gsmerge.errors import SceneError
from gsmerge.io import read_images, read_ply, read_scene, write_ply


def refused(path: Path) -> str:
    with pytest.raises(SceneError) as error:
        read_ply(path)
    assert "\n" not in str(error.value)
    assert str(path) in str(error.value)
    return error.value.problem


def test_a_missing_file(tmp_path: Path) -> None:
    assert refused(tmp_path / "none.ply") == "no such file"
    assert refused(tmp_path) == "expected a file, found a folder"


@pytest.mark.parametrize("share", [0.001, 0.3, 0.9999])
def test_a_truncated_file(scene_copy: Path, share: float) -> None:
    path = scene_copy / "scene.ply"
    data = path.read_bytes()
    start = data.index(b"end_header\n") + 11
    rows = int((len(data) - start) * share) // 68
    path.write_bytes(data[: start + int((len(data) - start) * share)])
    assert f"found {rows} whole ones" in refused(path)


def test_a_file_cut_in_its_header(scene_copy: Path) -> None:
    path = scene_copy / "scene.ply"
    path.write_bytes(path.read_bytes()[:100])
    assert refused(path) == "expected a PLY header, found early end of file"


def test_a_truncated_text_file(tmp_path: Path, scene_copy: Path) -> None:
    data = PlyData.read(str(scene_copy / "scene.ply"))
    PlyData([PlyElement.describe(np.asarray(data["vertex"].data[:20]), "vertex")], text=True).write(
        str(tmp_path / "text.ply")
    )
    lines = (tmp_path / "text.ply").read_text().splitlines()
    (tmp_path / "text.ply").write_text("\n".join(lines[:-3]))
    assert "found 17 whole ones" in refused(tmp_path / "text.ply")


def test_text_and_pictures_named_ply(tmp_path: Path) -> None:
    path = tmp_path / "scene.ply"
    for content in (b"", b"p", b"hello, this is not a scene\n" * 100, b"\x89PNG\r\n\x1a\n", b"plywood\n"):
        path.write_bytes(content)
        assert "does not start with the line 'ply'" in refused(path)


def test_no_vertex_element(tmp_path: Path) -> None:
    faces = PlyElement.describe(np.zeros(3, [("a", "<f4")]), "face")
    PlyData([faces], byte_order="<").write(str(tmp_path / "a.ply"))
    assert refused(tmp_path / "a.ply") == "expected an element 'vertex', found 'face'"


@pytest.mark.parametrize("text", [False, True])
def test_no_gaussians(tmp_path: Path, scene_copy: Path, text: bool) -> None:
    rows = np.asarray(PlyData.read(str(scene_copy / "scene.ply"))["vertex"].data[:0])
    PlyData([PlyElement.describe(rows, "vertex")], text=text, byte_order="<").write(str(tmp_path / "a.ply"))
    assert refused(tmp_path / "a.ply") == "expected at least one Gaussian, found 0 vertices"


def test_a_point_cloud_names_what_it_lacks(tmp_path: Path) -> None:
    rows = np.zeros(3, [(name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")])
    PlyData([PlyElement.describe(rows, "vertex")], byte_order="<").write(str(tmp_path / "a.ply"))
    problem = refused(tmp_path / "a.ply")
    for name in ("f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_3"):
        assert name in problem


def test_any_damage_is_an_error_or_a_sound_scene(tmp_path: Path, scene_copy: Path) -> None:
    rows = np.asarray(PlyData.read(str(scene_copy / "scene.ply"))["vertex"].data[:30])
    rng = np.random.default_rng(0)
    path = tmp_path / "damaged.ply"
    num_refused = 0
    for text in (False, True):
        PlyData([PlyElement.describe(rows, "vertex")], text=text, byte_order="<").write(str(path))
        intact = path.read_bytes()
        header = intact.index(b"end_header") + 11
        for i in range(300):
            data = bytearray(intact)
            at = int(rng.integers(0, header if i % 2 else len(data)))
            if i % 3 == 0:
                data[at] = int(rng.integers(0, 256))
            elif i % 3 == 1:
                del data[at : at + int(rng.integers(1, 20))]
            else:
                data[at:at] = bytes(rng.integers(32, 127, 4).astype(np.uint8))
            path.write_bytes(data)
            try:
                gaussians = read_ply(path).gaussians
            except SceneError:
                num_refused += 1
                continue
            for name in ("means", "quats", "scales", "opacities", "sh0"):
                assert np.isfinite(getattr(gaussians, name)).all()
    assert 200 < num_refused < 600


def test_unreadable_and_missing_images(scene_copy: Path) -> None:
    first = sorted((scene_copy / "images").iterdir())[0]
    intact = first.read_bytes()
    first.write_bytes(b"not a picture")
    with pytest.raises(SceneError, match=f"{first.name}: expected an image"):
        read_scene(scene_copy)
    first.unlink()
    with pytest.raises(SceneError, match="expected 5 images, one per camera, found 4"):
        read_scene(scene_copy)
    first.write_bytes(intact)
    assert read_images(scene_copy / "images", [first.name]).shape == (1, 64, 96, 3)


def test_an_interrupted_write_leaves_the_old_file(scene_copy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = scene_copy / "scene.ply"
    before, files = path.read_bytes(), sorted(scene_copy.iterdir())
    gaussians = read_ply(path).gaussians
    calls = []

    def fail_at_the_third(rows: np.ndarray) -> np.ndarray:
        calls.append(len(rows))
        if len(calls) == 3:
            raise KeyboardInterrupt
        return np.ones(rows.shape, bool)

    monkeypatch.setattr("gsmerge.io.formats.writing.np.isfinite", fail_at_the_third)
    with pytest.raises(KeyboardInterrupt):
        write_ply(path, gaussians, overwrite=True)
    monkeypatch.undo()
    assert len(calls) == 3
    assert path.read_bytes() == before
    assert sorted(scene_copy.iterdir()) == files


def test_unwritable_outputs(scene_copy: Path) -> None:
    gaussians = read_ply(scene_copy / "scene.ply").gaussians[:3]
    for path, message in (
        (scene_copy / "none" / "out.ply", "does not exist; make it first"),
        (scene_copy, "expected a file to write, found a folder"),
        (scene_copy / "scene.ply", "exists already"),
    ):
        with pytest.raises(SceneError, match=message):
            write_ply(path, gaussians)
    assert read_ply(scene_copy / "scene.ply").info.count == 5 * 96 * 64
