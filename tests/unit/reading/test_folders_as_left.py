"""Folders of models are read as left: Gaussians one folder down, or in several files, and cameras under own names."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from exports import export_rows, save_export, smooth_scene
from messages import noted, refuses
from model_files import MODELS
from model_rows import check_cameras, check_pixels
from sweeps import sweep
from tiny_scene import Tiny, frames_of, save_json, write_images, write_npz, write_transforms

import gsmerge
from gsmerge.cli import main
from gsmerge.errors import SceneError
from gsmerge.io import read_cameras, to_cameras, write_ply
from gsmerge.jobs.batch.find import find_scenes, main_file
from gsmerge.jobs.content_hash import content_hash, list_files
from gsmerge.jobs.states.state_file import load_state
from gsmerge.reading.read_scene import load_scene, read_scene
from gsmerge.reading.scene_files import find_scene_files
from gsmerge.results.outputs import Outputs
from gsmerge.run import compact_files
from gsmerge.settings.compact import CompactOptions

SMOOTH = replace(smooth_scene(48, 36), names=tuple(f"input_{i:06d}.png" for i in (4, 17, 30)))
ROWS = np.arange(3 * 36 * 48).reshape(3, 36, 48)


@sweep(
    ("ply", "beside"),
    [
        ("gaussians.ply", ("images/0.png", "cameras_path.json")),  # AnySplat's demo
        ("re10k_room_gaussians.ply", ("re10k_room_input_0.png", "re10k_room_angle_000_raw.png")),  # SPFSplat
        ("point_clouds/re10k/room/re10k_room_gaussians.ply", ()),  # SPFSplat, from the folder where it ran
        ("gaussians/room.ply", ("metrics/scores.json",)),  # VolSplat
        ("scene.ply", ("turntable.mp4",)),  # ZipSplat
        ("anya_rgba.ply", ("anya_rgba.mp4",)),  # LGM
        ("reconstructed_scene.ply", ("gs_trajectory.mp4", "done.txt")),  # Lyra 2
        ("ply/point_cloud_29999.ply", ("cfg.yml", "ckpts/ckpt_29999_rank0.pt", "stats/val_step29999.json")),  # gsplat
        ("room/20261120_101500/gaussians.ply", ()),  # WorldMirror 2, from the folder of all its results
        ("exports/splat/splat.ply", ("config.yml",)),  # nerfstudio
    ],
    often=4,
)
def test_gaussians_in_a_program_s_folder_are_found_among_other_files(
    tmp_path: Path, ply: str, beside: tuple[str, ...]
) -> None:
    """Files of other kinds and point clouds are beside it, and hidden folders."""
    path = save_export(tmp_path / Path(ply).parent, SMOOTH, export_rows(SMOOTH), cameras=False, name=Path(ply).name)
    points = np.zeros(7, [*((name, "f4") for name in "xyz"), *((name, "u1") for name in ("red", "green", "blue"))])
    for name in ("mesh.ply", "sparse/points.ply"):
        save_export(tmp_path / Path(name).parent, SMOOTH, points, cameras=False, name=Path(name).name)
    for name in (*beside, ".trash/scene.ply"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    for start in dict.fromkeys((tmp_path, path)):
        assert find_scene_files(start).ply == tmp_path / ply
    assert [main_file(scene) for scene in find_scenes([str(tmp_path)], tmp_path / "out")] == [tmp_path / ply]


def test_points_under_a_usual_name_are_no_scene(tmp_path: Path) -> None:
    """Gaussians beside them are the scene; alone, the reader says what they lack."""
    points = np.zeros(7, [(name, "f4") for name in "xyz"])
    save_export(tmp_path, SMOOTH, points, cameras=False, name="scene.ply")
    with refuses(SceneError, "scene.ply", "opacity", "rot_0"):
        load_scene(tmp_path)
    save_export(tmp_path, SMOOTH, export_rows(SMOOTH), cameras=False, name="room.ply")
    assert find_scene_files(tmp_path).ply == tmp_path / "room.ply"


def test_result_of_the_most_steps_of_gsplat_s_trainer_is_the_scene(tmp_path: Path) -> None:
    for name in ("ply/point_cloud_6999.ply", "ply/point_cloud_29999.ply"):
        save_export(tmp_path / "ply", SMOOTH, export_rows(SMOOTH), cameras=False, name=Path(name).name)
    save_json(tmp_path / "transforms.json", frames_of(SMOOTH))
    write_images(tmp_path / "images", SMOOTH)
    for start in (tmp_path, tmp_path / "ply"):
        files = find_scene_files(start)
        assert (files.ply.name, files.images) == ("point_cloud_29999.ply", tmp_path / "images")
        assert files.cameras == tmp_path / "transforms.json"
    assert list(find_scenes([str(tmp_path)], tmp_path / "out")) == [tmp_path]


def test_several_scenes_further_down_are_named(tmp_path: Path) -> None:
    for name in ("b", "a", "c/d/e/too-deep"):
        save_export(tmp_path / name, SMOOTH, export_rows(SMOOTH), cameras=False, name="gaussians.ply")
    with refuses(SceneError, tmp_path, "2 (a/gaussians.ply, b/gaussians.ply)", "batch"):
        find_scene_files(tmp_path)


def test_a_folder_of_too_many_files_is_not_searched(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    save_export(tmp_path / "a", SMOOTH, export_rows(SMOOTH), cameras=False, name="gaussians.ply")
    monkeypatch.setattr("gsmerge.reading.scene_files._MAX_ENTRIES", 3)
    assert find_scene_files(tmp_path).ply == tmp_path / "a/gaussians.ply"
    for i in range(3):
        (tmp_path / f"{i}.txt").touch()
    with refuses(SceneError, tmp_path, "none"):
        find_scene_files(tmp_path)


def test_files_beside_what_a_link_leads_to_are_found(tmp_path: Path, tiny: Tiny) -> None:
    write_transforms(tmp_path / "transforms.json", tiny)
    write_images(tmp_path / "images", tiny)
    (tmp_path / "a.ply").write_text("ply\n")
    link = tmp_path / "elsewhere" / "link.ply"
    link.parent.mkdir()
    link.symlink_to(tmp_path / "a.ply")
    files = find_scene_files(link)
    assert (files.ply, files.cameras, files.images) == (link, tmp_path / "transforms.json", tmp_path / "images")


@pytest.mark.parametrize("ends", ["recon_sampled", "da3", "da3_pred"])
def test_cameras_of_lyra_2_are_those_of_its_reconstruction(tmp_path: Path, ends: str) -> None:
    """Its scripts name the poses of the reconstruction by what made them, with those of the video beside them."""
    tiny = SMOOTH
    save_export(tmp_path, tiny, export_rows(tiny), cameras=False, name="reconstructed_scene.ply")
    video = {"w2c_render": np.tile(np.eye(4), (9, 1, 1)), "intrinsics_render": np.tile(np.eye(3), (9, 1, 1))}
    Ks = np.tile(np.array([[40.0, 0, 24], [0, 40, 18], [0, 0, 1]]), (3, 1, 1))
    np.savez(tmp_path / "cameras.npz", **video, **{f"w2c_{ends}": tiny.w2c, f"intrinsics_{ends}": Ks})
    np.savez(tmp_path / "vipe_predictions.npz", w2c_da3=tiny.w2c, intrinsics_da3=Ks)
    files = find_scene_files(tmp_path)
    assert files.cameras == tmp_path / "cameras.npz"
    np.testing.assert_allclose(to_cameras(read_cameras(files.cameras)).viewmats, tiny.w2c, atol=1e-6)


@pytest.mark.parametrize("written", ["AnySplat", "VGGT"])
def test_gaussians_among_photos_are_read_with_poses_as_a_model_returns_them(tmp_path: Path, written: str) -> None:
    """AnySplat's script writes among the photos; poses have no names then: photos are taken in order."""
    tiny = replace(SMOOTH, names=("2.png", "10.png", "11.png"))
    some = np.random.default_rng(0).permutation(ROWS.size)[:2999]
    save_export(tmp_path, tiny, export_rows(tiny, some), cameras=False, name="gaussians.ply")
    write_images(tmp_path, tiny)
    K = np.tile(tiny.K / np.array([[48], [36], [1]]), (3, 1, 1))
    arrays = {"extrinsic": tiny.c2w[None], "intrinsic": K[None]}
    if written == "VGGT":
        arrays = {"extrinsic": tiny.w2c[:, :3], "intrinsic": np.tile(tiny.K, (3, 1, 1)), "images": tiny.images}
    nothing = dict.fromkeys(("extrinsics", "intrinsics", "depth", "image"))
    write_npz(tmp_path / "predicted.npz", tiny, **(nothing | arrays))
    loaded = load_scene(tmp_path)
    assert not loaded.scene.has_own_pixels
    np.testing.assert_allclose(loaded.scene.cameras.viewmats, tiny.w2c, atol=1e-6)
    np.testing.assert_allclose(loaded.scene.cameras.Ks, np.tile(tiny.K, (3, 1, 1)), atol=1e-4)
    assert np.array_equal((loaded.scene.images * 255).round(), tiny.images)
    assert not noted(loaded.notes, "poses")
    if written == "AnySplat":
        assert {tmp_path / name for name in tiny.names} <= set(list_files(loaded.files))


@pytest.mark.parametrize("frames", [True, False])
def test_folders_of_long_lrm_are_read_in_their_mean_pose(tmp_path: Path, frames: bool) -> None:
    """The origin is the mean pose of the inputs, which lie within +-1.

    tttLRM does not say which frames they are; of its rows the faint ones are missing.
    """
    export, options = MODELS["Long-LRM"](tmp_path / "out"), {}
    if not frames:
        (export.path / "input_frame_idx.txt").unlink()
    if frames:  # and the data set beside the Gaussians
        shutil.copytree(tmp_path / "data", export.path, dirs_exist_ok=True)
    else:
        options, kept = export.options, np.random.default_rng(0).random(len(export.rows)) < 0.7
        arrays = {name: getattr(export, name)[kept] for name in ("rows", "pixels", "opacities", "quats")}
        export = replace(export, **arrays)
        save_export(export.path, export.scene, export.rows, cameras=False, name="gaussians_001.ply")
    loaded = load_scene(export.path, **options)
    if frames:
        check_pixels(loaded.scene, export)
    check_cameras(loaded.scene, export)
    assert loaded.alignment.worst_px < 0.5
    assert noted(loaded.notes, "moved into their mean pose") is not frames
    assert not noted(loaded.notes, "positions scaled")
    assert {*export.path.glob("input_frame_idx.txt")} <= set(list_files(loaded.files))


def test_cameras_of_any_name_are_taken_only_where_one_file_has_them(tmp_path: Path) -> None:
    tiny = SMOOTH
    save_export(tmp_path, tiny, export_rows(tiny), cameras=False)
    document = json.dumps(frames_of(tiny))
    for name in ("scene.compact.cameras.json", ".hidden.json"):  # the cameras for viewers beside a result
        (tmp_path / name).write_text(document)
    assert find_scene_files(tmp_path).cameras is None
    (tmp_path / "train.json").write_text(document)
    (tmp_path / "broken.json").write_text(document[:50])
    assert find_scene_files(tmp_path).cameras == tmp_path / "train.json"
    assert len(read_cameras(tmp_path)) == 3
    (tmp_path / "test.json").write_text(document)
    assert find_scene_files(tmp_path).cameras is None
    (tmp_path / "transforms.json").write_text(document)
    assert find_scene_files(tmp_path).cameras == tmp_path / "transforms.json"


def split(folder: Path, tiny: Tiny, names: list[str], cuts: list[int]) -> Path:
    """Save the tiny scene with its rows in files of their own, cut at ``cuts``."""
    tiny.save(folder)
    (folder / "scene.ply").unlink()
    for name, rows in zip(names, np.split(np.arange(len(tiny.gaussians)), cuts), strict=True):
        write_ply(folder / name, tiny.gaussians[rows])
    return folder


@pytest.mark.parametrize(
    ("names", "cuts"),
    [
        (["view_8.ply", "view_9.ply", "view_10.ply"], [280, 560]),
        (["scene.chunk000.ply", "scene.chunk001.ply"], [123]),
        (["0012.ply", "0040.ply", "0077.ply"], [280, 560]),  # as many as cameras
    ],
)
def test_parts_are_one_scene(tmp_path: Path, tiny: Tiny, names: list[str], cuts: list[int]) -> None:
    whole = read_scene(tiny.save(tmp_path / "whole"))
    folder = split(tmp_path / "parts", tiny, names, cuts)
    files = find_scene_files(folder)
    assert [path.name for path in files.plys] == names
    assert set(files.plys) <= set(list_files(files))
    load = load_scene(folder)
    assert load.notes[0] == f"{len(names)} files are read as one scene: {names[0]} to {names[-1]}"
    assert load.info.count == len(tiny.gaussians)
    assert load.info.file_bytes == sum(path.stat().st_size for path in files.plys)
    for name, column in vars(whole.gaussians).items():
        np.testing.assert_array_equal(getattr(load.scene.gaussians, name), column)


def test_missing_part_is_named(tmp_path: Path, tiny: Tiny) -> None:
    folder = split(tmp_path / "near", tiny, ["part_0.ply", "part_1.ply", "part_3.ply"], [280, 560])
    with refuses(SceneError, folder, "part_0.ply", "part_3.ply", "number 2"):
        find_scene_files(folder)
    folder = split(tmp_path / "far", tiny, ["view_1.ply", "view_20241122101500.ply"], [280])
    with refuses(SceneError, folder, "number 2"):
        find_scene_files(folder)


def test_parts_of_different_kinds_are_refused(tmp_path: Path, tiny: Tiny) -> None:
    folder = split(tmp_path, tiny, ["view_0.ply", "view_1.ply"], [280])
    degree = replace(tiny.gaussians[:280], shN=np.zeros((280, 3, 3), np.float32))
    write_ply(folder / "view_1.ply", degree, overwrite=True)
    with refuses(SceneError, "view_1.ply", "view_0.ply"):
        read_scene(folder)


@pytest.mark.parametrize(
    ("names", "cuts", "found"),
    [
        (["0.ply", "1.ply", "2.ply"], [100, 560], 3),
        (["step_7000.ply", "step_30000.ply", "step_3.ply"], [100, 560], 3),
        (["0.ply", "1.ply"], [420], "2 (0.ply, 1.ply)"),
    ],
)
def test_numbered_files_of_different_sizes_or_another_count_than_cameras_are_several_scenes(
    names: list[str], cuts: list[int], found: object, tmp_path: Path, tiny: Tiny
) -> None:
    folder = split(tmp_path, tiny, names, cuts)
    with refuses(SceneError, folder, found):
        find_scene_files(folder)


@pytest.mark.parametrize("named", [True, False])
def test_files_of_the_same_bytes_are_one_scene(tmp_path: Path, tiny: Tiny, named: bool) -> None:
    """As Flash3D writes one for each view that it renders, of which there may be as many as cameras."""
    whole = read_scene(tiny.save(tmp_path / "whole"))
    folder = split(tmp_path / "copies", tiny, ["0.ply"], [])
    for i in (1, 2):
        shutil.copy(folder / "0.ply", folder / f"{i}.ply")
    load = load_scene(folder, cameras=folder / "transforms.json" if named else None)
    assert load.notes[0] == "3 files have the same bytes; 0.ply is read"
    np.testing.assert_array_equal(load.scene.gaussians.means, whole.gaussians.means)
    write_ply(folder / "2.ply", tiny.gaussians[::-1], overwrite=True)
    assert len(find_scene_files(folder).plys) == 3


@pytest.mark.parametrize("cuts", [[280, 560], [100, 300]])
def test_moments_are_refused_with_calls_that_compact_or_join_them(tmp_path: Path, tiny: Tiny, cuts: list[int]) -> None:
    folder = split(tmp_path, tiny, ["0000.ply", "0001.ply", "0002.ply"], cuts)
    (folder / "transforms.json").unlink()
    calls = f"gsmerge batch {folder}", f"gsmerge convert {folder}/*.ply one.ply"
    with refuses(SceneError, folder, "3 (0000.ply", "moments", "280 Gaussians" if cuts[0] == 280 else "parts", *calls):
        find_scene_files(folder)
    out = tmp_path / "one.ply"
    assert main(["convert", *map(str, sorted(folder.glob("*.ply"))), str(out), "-q"]) == 0
    assert gsmerge.read_ply(out).info.count == len(tiny.gaussians)


def test_state_of_a_scene_in_parts_has_all_of_them(tmp_path: Path, tiny: Tiny) -> None:
    folder = split(tmp_path, tiny, ["view_0.ply", "view_1.ply", "view_2.ply"], [280, 560])
    assert main(["extend", str(folder / "scene.gsm"), str(folder), "--set", "superpixels=20%", "-q"]) == 0
    (batch,) = load_state(folder / "scene.gsm").about["batches"]
    assert batch["content"] == content_hash(list_files(find_scene_files(folder)))
    assert batch["num_input"] == len(tiny.gaussians)


def test_the_report_has_all_parts(tmp_path: Path, tiny: Tiny) -> None:
    folder = split(tmp_path, tiny, ["view_0.ply", "view_1.ply", "view_2.ply"], [280, 560])
    settings = CompactOptions().with_settings({"superpixels": "20%", "fit": "none", "threads": 1})
    files = find_scene_files(folder)
    document = compact_files(files, settings, Outputs(tmp_path / "out.ply"), hashed=True)
    assert document["input"]["parts"] == [str(path) for path in files.plys]
    assert document["input"]["bytes"] == sum(path.stat().st_size for path in files.plys)
    assert gsmerge.read_ply(tmp_path / "out.ply").info.count == document["output"]["num_gaussians"]
