"""Camera files that are not read are recognised by names and first bytes; messages name the export that is read."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from messages import refuses
from tiny_scene import Tiny, write_colmap_text, write_transforms

from gsmerge.errors import SceneError
from gsmerge.io import read_cameras, write_gaussians
from gsmerge.io.cameras.foreign import PROGRAMS, find_unread
from gsmerge.io.cameras.read_cameras import find_cameras, find_other_cameras
from gsmerge.reading.scene_files import find_scene_files

# file, its start, the program, and what is read of it
FILES = [
    ("rc.csv", "#name,x,y,alt,heading,pitch,roll,f,px,py", "RealityScan", "COLMAP"),
    ("rc.csv", "#cameras 5\n#name,x,y,z", "RealityCapture", "realitycapture"),
    ("images/a.xmp", '<rdf:Description xcr:Version="3"', "RealityScan", "COLMAP"),
    ("a.rcproj", "<RealityCaptureProject", "RealityScan", "COLMAP"),
    ("a.psx", '<document version="1.2.0"', "Metashape", "Export Cameras"),
    ("at.xml", '<?xml version="1.0"?>\n<BlocksExchange version="2.1">', "ContextCapture", "InterfaceMetashape"),
    ("1_initial/params/a_calibrated_camera_parameters.txt", "fileName imageWidth", "Pix4D", "opf2colmap"),
    ("a.p4d", "<pix4d/>", "Pix4D", "OPF"),
    ("bundle/bundle.out", "# Bundle file v0.3\n5 9\n", "Bundler", "kapture_import_bundler.py"),
    ("a.nvm", "NVM_V3\n\n5\n", "VisualSFM", "kapture_import_nvm.py"),
    ("synth_0.out", "drews 1.0\n5 9\n", "MVE", "transforms.json"),
    ("reconstruction/sfm_data.json", '{\n "sfm_data_version": "0.3"', "OpenMVG", "openMVG_main_openMVG2Colmap"),
    ("sfm_data.bin", "\1", "OpenMVG", "openMVG_main_openMVG2Colmap"),
    ("MeshroomCache/StructureFromMotion/cameras.sfm", '{"version": [', "Meshroom", "ExportColmap"),
    ("scene.mvs", "MVSI", "OpenMVS", "InterfaceCOLMAP"),
    ("reconstruction-0", "\1", "Theia", "export_colmap_files"),
    ("cameras.json", '{"v2 a": {"projection_type": "brown"', "ODM", "opensfm/reconstruction.json"),
    ("database.db", "SQLite format 3\0", "COLMAP's database", "colmap mapper"),
    ("poses_bounds.npy", "\x93NUMPY", "LLFF", "sparse/0"),
    ("cams/00000000_cam.txt", "extrinsic\n1 0 0 0\n", "MVSNet", "COLMAP model"),
    ("cameras_sphere.npz", "PK\3\4 world_mat_0.npy", "NeuS", "views.npz"),
    ("cameras.npz", "PK\3\4 scale_mat_0.npy", "DTU", "views.npz"),
    ("dino_par.txt", "16\ndino0001.png 3310 0 316", "Middlebury", "transforms.json"),
    ("camera/0001.json", '{"orientation": [[1, 0, 0]', "Nerfies", "transforms.json"),
    ("scene0000_00.sens", "\4\0\0\0", "ScanNet", "transforms.json"),
    ("pose/0.txt", "1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n", "NSVF", "transforms.json"),
    ("poses/0.txt", "1 0 0 -.5 0 1 0 0 0 0 1 0 0 0 0 1", "SRN", "transforms.json"),
    ("pred_traj.txt", "# time tx\n0.0 0 0 1e-3 0 0 0 1\n1.0 0 0 2 0 0 0 1\n", "MonST3R", "evo_traj tum"),
    ("000000.torch", "PK\3\4", "RealEstate10K", "views.npz"),
    ("Barn.log", "0 0 0\n1 0 0 0\n", "Tanks and Temples", "transforms.json"),
    ("seq-01/frame-000000.pose.txt", "1 0 0 0\n", "7-Scenes", "kapture_import_7scenes.py"),
    ("sensors/sensors.txt", "# kapture format: 1.1", "kapture", "kapture_export_colmap.py"),
    ("metadata.json", '{"w": 1, "h": 2, "K": [1], "poses": [[', "Record3D", "ns-process-data record3d"),
    ("a.r3d", "PK\3\4", "Record3D", "ns-process-data record3d"),
    ("mps/slam/closed_loop_trajectory.csv", "graph_uid,tracking", "Project Aria", "ns-process-data aria"),
    ("frame_00000.json", '{"cameraPoseARFrame": [1, 0', "3D Scanner App", "transforms.json"),
    ("lowres_wide.traj", "1.0 0 0 0 0 0 0\n", "ARKitScenes", "transforms.json"),
    ("frame_annotations.jgz", "\x1f\x8b", "CO3D", "transforms.json"),
    ("odometry.csv", "timestamp, frame, x, y, z, qx, qy, qz, qw", "Stray Scanner", "transforms.json"),
    ("mav0/state/data.csv", "#timestamp, p_RS_R_x [m]", "EuRoC", "transforms.json"),
    ("disps.npy", "\x93NUMPY", "DROID-SLAM", "views.npz"),
    ("camera/000000.npz", "PK\3\4 pose.npy", "CUT3R", "views.npz"),
    ("trajectory.json", '{\n\t"class_name" : "PinholeCameraTrajectory"', "Open3D", "transforms.json"),
    ("a.psht", "\0", "Postshot", "loaded into it"),
    ("a.blend", "BLENDER", "3D programs", "BlenderNeRF"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "start", "program", "remedy"), FILES)
def test_files_of_a_foreign_program_are_refused_with_the_export_to_use(
    tmp_path: Path, name: str, start: str, program: str, remedy: str, tiny: Tiny
) -> None:
    path = tmp_path / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(start.encode("latin-1"))
    assert find_unread(tmp_path) == path
    for place in {path, tmp_path, path.parent}:
        with refuses(SceneError, name.split("/")[-1], program, remedy):
            read_cameras(place)
    with refuses(SceneError, name.split("/")[-1], program):
        find_scene_files(tmp_path / "a.ply", cameras=path)
    other = tmp_path / "other"
    other.mkdir()
    write_transforms(other / "transforms.json", tiny)
    write_colmap_text(other / "sparse" / "0", tiny)
    for export in ("transforms.json", "sparse/0"):
        np.testing.assert_allclose(read_cameras(other / export).viewmats, tiny.w2c, atol=1e-5)


def test_every_foreign_program_has_a_case() -> None:
    programs = {foreign.program for foreign in PROGRAMS}
    assert all(any(name in program for _, _, name, _ in FILES) for program in programs)


@pytest.mark.parametrize(
    ("name", "start"),
    [
        ("a.csv", "name,price\n"), ("a.json", '{"transform": [[1'), ("a.xml", "<a/>"), ("a.out", "x"),
        ("metadata.json", "{}"), ("notes.txt", "1 2 3"), ("a.db", "x"), ("cameras.npz", "PK\3\4 extrinsics.npy"),
        ("a.xmp", "<x:xmpmeta>"),
    ],
)  # fmt: skip
def test_other_files_are_not_taken_for_foreign_cameras(tmp_path: Path, name: str, start: str) -> None:
    (tmp_path / name).write_text(start)
    assert find_unread(tmp_path) is None


def test_foreign_cameras_beside_a_scene_belong_to_it_alone(tmp_path: Path, tiny: Tiny) -> None:
    below = tmp_path / "other/rc.csv"
    below.parent.mkdir()
    below.write_text("#name,x")
    write_gaussians(tmp_path / "a.ply", tiny.gaussians)
    assert find_scene_files(tmp_path / "a.ply").cameras == below
    write_gaussians(below.with_name("b.ply"), tiny.gaussians)
    assert find_scene_files(tmp_path / "a.ply").cameras is None
    assert find_scene_files(below.with_name("b.ply")).cameras == below


def test_cameras_that_are_read_come_before_foreign_ones(tmp_path: Path, tiny: Tiny) -> None:
    (tmp_path / "a.nvm").write_text("NVM_V3")
    (tmp_path / "a.ply").write_text("ply\n")
    assert find_scene_files(tmp_path / "a.ply").cameras == tmp_path / "a.nvm"
    write_transforms(tmp_path / "transforms.json", tiny)
    assert find_cameras(tmp_path) == find_scene_files(tmp_path / "a.ply").cameras == tmp_path / "transforms.json"
    (tmp_path / "transforms.json").rename(tmp_path / "b.json")
    assert find_other_cameras(tmp_path) == tmp_path / "b.json"
    (tmp_path / "c.json").write_text((tmp_path / "b.json").read_text())
    assert find_other_cameras(tmp_path) is None
