"""List the places of camera files, and the programs whose cameras are not read, with the export to use instead."""

from __future__ import annotations

import re
from itertools import islice
from pathlib import Path
from typing import NamedTuple

from gsmerge.errors import SceneError
from gsmerge.io.first_bytes import read_start
from gsmerge.io.formats.ply import header_content
from gsmerge.io.image_names import IMAGE_SUFFIXES


class Foreign(NamedTuple):
    """Files of a program whose cameras are not read."""

    files: str  # patterns of their names, separated by spaces
    program: str
    remedy: str  # the export of the program that is read
    start: str = ""  # regular expression that the first bytes of its files contain; ^ and $ are ends of lines


# Files of intrinsics beside a list of poses: of DA3-Streaming, KITTI and Replica
INTRINSICS = "intrinsic.txt"
CALIBRATION = "calib.txt"
REPLICA_CAMERA = "cam_params.json"
BESIDE_POSES = (INTRINSICS, CALIBRATION, REPLICA_CAMERA)
ISAAC_FILES = "camera_params_*.json"  # cameras of Isaac Sim, one in each
# most levels of folders, and most paths, that are searched for files of PROGRAMS
_DEPTH = 3
_MAX_PATHS = 10_000
_WRITE_POSES = (
    "write its poses into a transforms.json as nerfstudio has it, or into views.npz (docs/reference/formats.md)"
)
_MODEL = f"name the COLMAP model that it was made from, or {_WRITE_POSES}"
_NUMBER = r"[-+.\deE]+"
_NERFSTUDIO = "`ns-process-data {}` of nerfstudio makes a transforms.json of it"
_KAPTURE = "kapture_import_{}.py and kapture_export_colmap.py of kapture make a COLMAP model of it"
_OPF = "export OPF from PIX4Dmatic, of which `opf2colmap` of pyopf makes a COLMAP model"
_REALITY = "RealityScan or RealityCapture", "export its registration as COLMAP, or use `ns-process-data realitycapture`"
_OPENMVS = "{}InterfaceCOLMAP of OpenMVS make a COLMAP model of it"
_ODM = "ODM", "name its opensfm/reconstruction.json"
_OPENMVG = "OpenMVG", "openMVG_main_openMVG2Colmap makes a COLMAP model of it"
# Patterns of the paths of cameras in a folder, the most preferred first. Of several COLMAP models that match one
# pattern, the model with the most images is preferred. A COLMAP model in the folder itself comes last, because Depth
# Anything 3 writes there a model for photos of full size
CAMERA_PLACES = (
    "views.npz", "transforms.json", "transforms_train.json", "transforms_test.json", "transforms_val.json",
    "cameras.json", "camera_params.json", "sparse/*", "sparse", "colmap/sparse/*", "colmap",
    "distorted/sparse/*", "exports/npz/results.npz", "exports/mini_npz/results.npz", "results.npz", "cameras.npz",
    "camera_poses.txt", "extri.yml", "traj.txt", "poses.txt", "camera_params",
    "keyframes/corrected_cameras", "keyframes/cameras", "reconstruction.json",
    "opensfm/reconstruction.json", "cameras.xml", "[0-9]*", ".",
)  # fmt: skip
# If several entries of this table match a file, the first of these entries names the file's program
PROGRAMS = (
    Foreign("*.csv *.xmp", *_REALITY, r"#(name|cameras)|xcr:"), Foreign("*.rcproj *.rsproj", *_REALITY),
    Foreign("*.psx *.psz", "Metashape", "File > Export > Export Cameras writes the .xml that is read"),
    Foreign("*.xml", "ContextCapture or DJI Terra", _OPENMVS.format("InterfaceMetashape and "), "<BlocksExchange"),
    Foreign("*calibrated_*camera_parameters*.txt *.p4d *.p4m *.opf", "Pix4D", _OPF),
    Foreign("*.out", "Bundler", _KAPTURE.format("bundler"), "# Bundle file"),
    Foreign("*.nvm", "VisualSFM", _KAPTURE.format("nvm")),
    Foreign("*.pose.txt", "7-Scenes", _KAPTURE.format("7scenes")),
    Foreign("sensors/*.txt", "kapture", "kapture_export_colmap.py makes a COLMAP model of it", "kapture"),
    Foreign("*.json", *_OPENMVG, '"sfm_data_version"'), Foreign("sfm_data.bin", *_OPENMVG),
    Foreign("*.sfm *.mg", "Meshroom", "its node ExportColmap, or aliceVision_exportColmap, makes a COLMAP model of it"),
    Foreign("*.mvs", "OpenMVS", _OPENMVS.format("")),
    Foreign("*.theia reconstruction-[0-9]", "Theia", "export_colmap_files of Theia makes a COLMAP model of it"),
    Foreign("cameras.json", *_ODM, '"projection_type"'), Foreign("odm_report/shots.geojson", *_ODM),
    Foreign("*.db project.ini", "COLMAP's database", "name the sparse/0 of `colmap mapper`", "SQLite|database_path"),
    Foreign("poses_bounds.npy", "LLFF", "name the COLMAP model sparse/0 from which imgs2poses.py made it"),
    Foreign("*_cam.txt", "MVSNet", _MODEL, "extrinsic"),
    Foreign("cameras*.npz", "IDR, NeuS or DTU", _MODEL, "(world|scale|camera)_mat"),
    Foreign("metadata.json *.r3d", "Record3D", _NERFSTUDIO.format("record3d"), '^PK|"(poses|perFrameIntrinsicCoeffs)"'),
    Foreign("*.vrs *_loop_trajectory.csv", "Project Aria", _NERFSTUDIO.format("aria")),
    Foreign("*.sens", "ScanNet", _WRITE_POSES),
    Foreign("pose/*.txt poses/*.txt", "ScanNet, NSVF or SRN", _WRITE_POSES, rf"\A({_NUMBER}\s+){{3,15}}{_NUMBER}\s*$"),
    Foreign("*.txt", "TUM, ORB-SLAM or MonST3R", "its timestamps may be those of no photo: keep the pose nearest in"
            " time to each photo, with associate.py of TUM, and turn these with `evo_traj tum` of evo and its option"
            " save_as_kitti into lines of 12 numbers, which are read with one photo for each",
            rf"\A(#.*\n)*({_NUMBER}[ \t]+){{7}}{_NUMBER}\s*$"),
    Foreign("*.torch", "a chunk of RealEstate10K", "write the cameras and photos of its scene into views.npz"
            " (docs/reference/formats.md)"),
    Foreign("*.log", "Open3D or Tanks and Temples", _WRITE_POSES, r"\A\d+[ \t]+\d+[ \t]+\d+\s*$"),
    Foreign("*.traj", "ARKitScenes", _WRITE_POSES), Foreign("*.jgz", "CO3D", _WRITE_POSES),
    Foreign("*.json", "Open3D", _WRITE_POSES, '"PinholeCamera'),
    Foreign("*.json", "3D Scanner App", _WRITE_POSES, '"cameraPoseARFrame"'),
    Foreign("camera/*.json", "Nerfies", _WRITE_POSES, '"(orientation|principal_point)"'),
    Foreign("*_par.txt *.conf", "Middlebury or Matterport", _WRITE_POSES, r"^\s*\d+\s|^dataset"),
    Foreign("*.out *.mve/meta.ini", "MVE", _WRITE_POSES, "drews|MVE view"),
    Foreign("*.csv", "EuRoC's body", _WRITE_POSES, "#(timestamp|time)"),
    Foreign("odometry.csv", "Stray Scanner", _WRITE_POSES, "timestamp"),
    Foreign("camera/*.npz poses.npz", "CUT3R or Spann3R", _WRITE_POSES, "pose"),
    Foreign("disps.npy tstamps.npy reconstruction.pth", "DROID-SLAM", _WRITE_POSES),
    Foreign("*.psht", "Postshot", "name the cameras that were loaded into it"),
    Foreign("*.abc *.fbx *.chan *.blend *.ma", "3D programs", "BlenderNeRF, in Blender, writes transforms_train.json"),
)  # fmt: skip


def check_program(place: Path) -> None:
    """Raise SceneError, with the export to use instead, for a file of :data:`PROGRAMS` or a folder with one."""
    if (path := find_unread(place)) is not None:
        foreign = next(foreign for foreign in PROGRAMS if _is_file_of(path, foreign))
        problem = f"expected cameras of a supported format, found those of {foreign.program}"
        raise SceneError(path, problem, foreign.remedy)


def find_unread(place: Path) -> Path | None:
    """Find a file of :data:`PROGRAMS`: the path itself, or a file below it, but none in the folder of another scene."""
    paths = (path for depth in range(_DEPTH) for path in place.glob("*/" * depth + "[!.]*"))
    files = sorted(islice(paths, _MAX_PATHS)) if place.is_dir() else [place]
    scenes = {p.parent for p in files if p.suffix == ".ply" and p.parent != place and header_content(p) == "Gaussians"}
    files = [path for path in files if path.suffix.lower() not in IMAGE_SUFFIXES and scenes.isdisjoint(path.parents)]
    return next((path for foreign in PROGRAMS for path in files if _is_file_of(path, foreign)), None)


def _is_file_of(path: Path, foreign: Foreign) -> bool:
    """Return whether a path is a file of a program, by its name and its first bytes."""
    has_name = any(map(path.match, foreign.files.split())) and path.is_file()
    return has_name and re.search(foreign.start, read_start(path).decode("latin-1"), re.MULTILINE) is not None
