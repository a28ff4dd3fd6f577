"""Results of gsmerge say so in their headers, and are not taken for the scene of a folder, whatever they are called."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from damage import SOUNDS
from exports import export_rows, save_export
from messages import noted, refuses
from plyfile import PlyData
from tiny_scene import Tiny, make_tiny, write_inria

from gsmerge import Compactor, read_scene
from gsmerge.cli import main
from gsmerge.drawing.preview import save_picture
from gsmerge.errors import SceneError
from gsmerge.io import read_gaussians, read_ply, write_gaussians, write_ply
from gsmerge.io.cameras.read_cameras import read_cameras
from gsmerge.io.formats.ply import header_content
from gsmerge.io.formats.rows import RESULT_COMMENT
from gsmerge.io.image_names import is_drawn
from gsmerge.jobs.batch.find import find_scenes
from gsmerge.jobs.file_checks import check_content
from gsmerge.reading.input import read_input
from gsmerge.reading.photos.scene_photos import find_photos
from gsmerge.reading.scene_files import find_scene_files
from gsmerge.results.outputs import Outputs
from gsmerge.run import compact_files
from gsmerge.settings.compact import CompactOptions

PLAIN = CompactOptions().with_settings({"superpixels": "20%", "fit": "none", "threads": 1, "levels": 2})


def save_result(path: Path, tiny: Tiny) -> Path:
    """Write every fifth Gaussian as a command writes its result."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_gaussians(path, tiny.gaussians[::5], comments=[RESULT_COMMENT])
    return path


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return the tiny scene as another program writes it, called ``room.ply``."""
    tiny = make_tiny()
    return save_export(tmp_path / "scene", tiny, export_rows(tiny), name="room.ply")


def test_results_of_commands_say_in_their_headers_what_they_are(folder: Path, tmp_path: Path) -> None:
    compact_files(find_scene_files(folder), PLAIN, Outputs(folder / "x.ply"))
    assert main(["extend", str(tmp_path / "x.gsm"), str(folder), "--set", "superpixels=20%", "-q"]) == 0
    assert main(["compact", str(tmp_path / "x.gsm"), "--fit", "none", "-o", str(folder / "y.ply"), "-q"]) == 0
    results = [folder / "x.ply", folder / "x.level1.ply", folder / "y.ply"]
    assert sorted(folder.glob("*.ply")) == sorted([folder / "room.ply", *results])
    for path in results:
        assert header_content(path) == "result"
        assert RESULT_COMMENT in PlyData.read(path).comments
        assert read_ply(path).info.opacity_encoding == "logit"
    assert find_scene_files(folder).ply == folder / "room.ply"


@pytest.mark.parametrize("place", ["gs_ply/0000.ply", "point_cloud/iteration_7/point_cloud.ply"])
def test_a_result_of_a_scene_deeper_in_a_folder_is_named_after_the_folder(
    folder: Path, place: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    ply = folder / place
    ply.parent.mkdir(parents=True)
    assert find_scene_files(folder).base == folder / "room.ply"  # beside the file
    shutil.move(folder / "room.ply", ply)
    assert find_scene_files(folder).base == folder / "scene.ply"  # the folder is called scene
    assert find_scene_files(ply).base == ply
    compact_files(find_scene_files(folder), PLAIN, Outputs(folder / "scene.compact.ply"))
    assert find_scene_files(folder).ply == ply  # a result at the top does not hide the scene
    monkeypatch.chdir(folder)
    assert find_scene_files(".").base == Path("scene.ply")


@pytest.mark.parametrize("name", ["x.ply", "scene.ply", "gaussians.ply", "gs_ply/0000.ply", "room2.ply"])
def test_a_result_beside_the_scene_is_not_taken(folder: Path, tiny: Tiny, name: str) -> None:
    save_result(folder / name, tiny)
    assert find_scene_files(folder).ply == folder / "room.ply"
    assert list(find_scenes([str(folder)], Path("out"))) == [folder / "room.ply"]
    assert check_content(folder).count == len(tiny.gaussians)
    assert find_scene_files(folder / name).ply == folder / name  # where it is named


def test_result_is_not_taken_for_a_part_or_a_step_of_training(tmp_path: Path, tiny: Tiny) -> None:
    for i in range(2):
        write_ply(tmp_path / f"view_{i}.ply", tiny.gaussians[i * 280 : (i + 1) * 280])
    save_result(tmp_path / "view_2.ply", tiny)
    assert [path.name for path in find_scene_files(tmp_path).plys] == ["view_0.ply", "view_1.ply"]
    assert check_content(tmp_path).count == 560
    steps = tmp_path / "run/ply"
    save_export(steps, tiny, export_rows(tiny), cameras=False, name="point_cloud_6999.ply")
    save_result(steps / "point_cloud_29999.ply", tiny)
    assert find_scene_files(tmp_path / "run").ply == steps / "point_cloud_6999.ply"


def test_files_written_by_the_library_may_be_scenes(tmp_path: Path, tiny: Tiny) -> None:
    """Generated scenes, too, are written without the comment of results."""
    tiny.save(tmp_path)
    assert header_content(tmp_path / "scene.ply") == "Gaussians"
    size = ["--scenes", "1", "--views", "2", "--size", "32x24"]
    assert main(["lab", "generate", "-o", str(tmp_path / "made"), *size, "--quiet"]) == 0
    assert header_content(tmp_path / "made/scene_0000/scene.ply") == "Gaussians"


def test_single_result_of_a_folder_is_taken_and_several_are_refused(folder: Path, tiny: Tiny, tmp_path: Path) -> None:
    """The only one is taken with a note; several are named, and batch takes none."""
    (folder / "room.ply").unlink()
    path = save_result(folder / "x.ply", tiny)
    files = find_scene_files(folder)
    assert (files.ply, files.cameras) == (path, folder / "transforms.json")
    assert noted(read_input(files).notes, "gsmerge", f"{len(tiny.gaussians[::5])} Gaussians")
    with refuses(SceneError, folder, "none", str(path)):
        list(find_scenes([str(folder)], tmp_path / "out"))
    save_result(folder / "y.ply", tiny)
    with refuses(SceneError, folder, "2 (x.ply, y.ply)"):
        find_scene_files(folder)


def test_cameras_of_a_result_with_the_name_of_the_scene_stay_the_results(folder: Path, tiny: Tiny) -> None:
    """The scene keeps its own cameras, and without them gets none; results have theirs."""
    write_inria(cameras := folder / "room.cameras.json", tiny)
    assert find_scene_files(folder / "room.ply").cameras == folder / "transforms.json"  # the result may be elsewhere
    write_gaussians(result := folder / "room.sog", tiny.gaussians[::5])
    assert [find_scene_files(path).cameras for path in (folder, result)] == [folder / "transforms.json", cameras]
    (folder / "transforms.json").unlink()
    assert find_scene_files(folder / "room.ply").cameras is None
    result.unlink()
    assert find_scene_files(folder / "room.ply").cameras == cameras
    (folder / "room.ply").unlink()
    assert find_scene_files(save_result(folder / "room.ply", tiny)).cameras == cameras


@pytest.mark.parametrize("name", ["x.spz", "x.sog", "x.splat", "x.glb"])
def test_a_result_in_another_format_is_noted(folder: Path, tiny: Tiny, name: str) -> None:
    """Its cameras beside it are those that gsmerge writes; a scene with other cameras is no result."""
    shutil.rmtree(folder / "images")
    write_gaussians(path := folder / name, tiny.gaussians[::5])
    files = find_scene_files(path)
    assert not noted(read_input(files).notes, "gsmerge")
    write_inria(folder / "x.cameras.json", tiny)
    assert noted(read_input(find_scene_files(path)).notes, "gsmerge", f"{len(tiny.gaussians[::5])} Gaussians")


def test_headers_of_many_files_are_read_up_to_a_bound(
    folder: Path, tiny: Tiny, monkeypatch: pytest.MonkeyPatch
) -> None:
    save_result(folder / "a.ply", tiny)
    shutil.copy(folder / "a.ply", folder / "z.ply")
    monkeypatch.setattr("gsmerge.reading.scene_files._MAX_HEADERS", 1)
    with refuses(SceneError, folder, "2 (room.ply, z.ply)"):
        find_scene_files(folder)


@pytest.mark.parametrize("ending", [".png", ".jpg", ".webp"])
def test_what_gsmerge_drew_is_no_photo(folder: Path, tiny: Tiny, ending: str) -> None:
    """Drawings with the names of the photos lie in the photos' place, or beside another capture; photos count."""
    photos = folder / "images"
    for name, photo in zip(tiny.names, tiny.images, strict=True):
        foreign = folder / "a" / "photos" / Path(name).name
        foreign.parent.mkdir(parents=True, exist_ok=True)
        assert cv2.imwrite(str(foreign), np.random.default_rng(0).integers(0, 255, (60, 90, 3), np.uint8))
        for place in (photos / name, folder / "a" / "drawn" / name):
            place.parent.mkdir(parents=True, exist_ok=True)
            place.unlink(missing_ok=True)
            save_picture(place.with_suffix(ending), photo.astype(np.uint8))
            assert is_drawn(place.with_suffix(ending))
    cameras = read_cameras(folder / "transforms.json")
    used = find_photos(find_scene_files(folder), cameras)
    assert {path.parent for path in used.pool} == {folder / "a" / "photos"}
    for name, photo in zip(tiny.names, tiny.images, strict=True):
        (folder / "b" / name).parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(folder / "b" / Path(name).with_suffix(".png")), photo.astype(np.uint8)[..., ::-1])
    assert {path.relative_to(folder).parts[0] for path in find_photos(find_scene_files(folder), cameras).paths} == {"b"}
    named = read_input(find_scene_files(folder, images=photos))
    assert noted(named.notes, "gsmerge drew")
    assert named.scene.images is not None


def test_feature_gaussians_are_no_scene(tmp_path: Path) -> None:
    results, features = (SOUNDS[kind].put(tmp_path / kind) for kind in ("gsm", "gsm of features"))
    assert read_scene(results).num_gaussians == len(Compactor.load(results))
    with pytest.raises(SceneError, match="Feature Gaussians"):
        read_scene(features)


def test_a_page_is_refused_with_what_to_name_instead(tmp_path: Path) -> None:
    page = tmp_path / "room.html"
    page.write_text("<!DOCTYPE html>\n<title>room</title>")
    with refuses(SceneError, page, "name the .ply"):
        read_gaussians(page)
    assert "name the .ply" in str(check_content(page))
