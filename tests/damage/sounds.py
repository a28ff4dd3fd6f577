"""A table has, for each kind of file, a maker, what reads it, and the command that tells whether it is sound."""

from __future__ import annotations

import io
import re
import tempfile
import warnings
import zipfile
import zlib
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import scenes
from former_formats import compressed_bytes, spz4_bytes
from made_gaussians import random_gaussians
from model_files import long_lrm as export_long_lrm
from network_fixtures import noisy, written
from program_cameras import FORMATS
from splat_transform_programs import write_set
from tiny_scene import (
    make_tiny,
    save_json,
    write_colmap_binary,
    write_colmap_text,
    write_inria,
    write_npz,
    write_transforms,
)

import gsmerge
from gsmerge.cli.parameters import read_settings
from gsmerge.errors import GsmergeError, SceneError, UsageError
from gsmerge.io import atomic_outputs, read_cameras, read_gaussians, read_images
from gsmerge.io.cameras.dataparser import read_dataparser
from gsmerge.io.cameras.read_cameras import read_sharp_camera
from gsmerge.io.formats import tileset
from gsmerge.io.formats.table import Contents
from gsmerge.io.photo_files import decode_alpha, decode_levels
from gsmerge.jobs.states.compactor import Compactor
from gsmerge.jobs.states.state_file import load_state
from gsmerge.method.kernels.matrices import invert
from gsmerge.reading.checkpoint import load_checkpoint
from gsmerge.reading.read_scene import load_scene
from gsmerge.settings.compact import CompactOptions
from gsmerge.types import Gaussians

from .changes import pack_members

NAMES = ("view_000.png", "view_001.png", "view_002.png")
VIEW_NAMES = [Path(name).stem for name in NAMES]
TINY = replace(make_tiny(6, 4), names=NAMES)
SOME = random_gaussians(6, 0, degree=1)
PHOTO_ENDINGS = ("png", "jpg", "bmp", "webp", "ppm")
COMPACT = ("compact", "--dry-run", "--budget=50%")  # a number, so that no run has to find one
PLAIN = re.compile(r"([\w-]+/){0,2}[\w-]+\.\w+")
UNPACKING = (zipfile.BadZipFile, zlib.error, ValueError, KeyError, EOFError, OSError, NotImplementedError, RuntimeError)
Make = Callable[[Path], object]


@dataclass(frozen=True)
class Sound:
    """Sound files of a kind.

    Args:
        name: Of the file that is read, in its folder; empty for the folder itself.
        make: Writes it, and the files that belong to it, into a folder.
        read: The reader, with checks of what it returns.
        words: The command that reads the file, before its path; empty if ``read`` alone reads it.
        scene: Writes the other files of a scene first. The command then reads the folder.
        named: What messages name beside the file.
        packed: What is changed at random is an archive of all files in the folder.
        rare: A kind that differs from another in a few bytes. What fits every kind is tried in the sweep alone.
        fuzzed: ``tools/fuzz.py`` changes it at random.
    """

    name: str
    make: Make
    read: Callable[[Path], Any]
    words: tuple[str, ...] = COMPACT
    scene: Make | None = None
    named: str = ""
    packed: bool = False
    rare: bool = False
    fuzzed: bool = True

    @cached_property
    def files(self) -> dict[str, bytes]:
        """Return the file and those that belong to it, by their paths in the folder."""
        return files_of(self.make)

    def put(self, folder: Path) -> Path:
        """Write everything into a new folder; return the path of the file."""
        folder.mkdir()
        others = files_of(self.scene) if self.scene else {}
        for name, data in (others | self.files).items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(data)
        return folder / self.name

    def content(self) -> bytes:
        """Return the file, or an archive of the folder, of which changed ones are made."""
        return pack_members(self.files) if self.packed else self.files[self.name]

    def attempt(self, data: bytes, folder: Path) -> bool:
        """Read such content in an empty folder -> whether it is sound.

        AssertionError if it is refused in another way than by one line that names the file.
        """
        if self.packed:
            if not unpack(data, folder):
                return False
        else:
            (folder / self.name).write_bytes(data)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            try:
                self.read(folder / self.name)
                return True
            except GsmergeError as error:
                refused = error
        assert not isinstance(refused, SceneError) or str(folder) in str(refused), f"no file named: {refused}"
        assert "\n" not in str(refused), f"several lines: {refused}"
        return False


@cache
def files_of(make: Make) -> dict[str, bytes]:
    """Return what a function writes into a folder, by path; each writes once in a run, as disks take their time."""
    with tempfile.TemporaryDirectory() as place:
        make(Path(place))
        paths = sorted(path for path in Path(place).rglob("*") if path.is_file())
        return {path.relative_to(place).as_posix(): path.read_bytes() for path in paths}


def unpack(data: bytes, folder: Path) -> bool:
    """Write the files of an archive into a folder, those with plain names; return whether it is an archive."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as file:
            contents = {name: file.read(name) for name in file.namelist() if PLAIN.fullmatch(name)}
    except UNPACKING:
        return False
    for name, content in contents.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    return bool(contents)


# Readers, with checks of what they return


def check_gaussians(path: Path) -> None:
    g = read_gaussians(path).gaussians
    assert len(g) > 0
    assert np.isfinite(g.means).all()
    assert (g.scales >= 0).all()
    assert np.isfinite(g.scales).all()
    assert ((g.opacities >= 0) & (g.opacities <= 1)).all()
    assert (np.abs(np.linalg.norm(g.quats.astype(np.float64), axis=1) - 1) < 1e-5).all()


def check_cameras(path: Path) -> None:
    actual = read_cameras(path)
    assert 0 < len(actual) == len(actual.viewmats) == len(actual.Ks) == len(actual.widths) == len(actual.heights)
    assert np.isfinite(actual.viewmats).all()
    assert np.isfinite(actual.Ks).all()
    assert (actual.Ks[:, 0, 0] > 0).all()
    assert (actual.widths >= 0).all()


def check_colmap(path: Path) -> None:
    check_cameras(path.parent)


def check_arrays(path: Path) -> None:
    check_cameras(path)


def check_metashape(path: Path) -> None:
    read_dataparser(path, path)
    check_cameras(path)


def check_photo(path: Path) -> None:
    actual = read_images([path], [path.name])
    assert actual.shape[0] == 1
    assert ((actual >= 0) & (actual <= 1)).all()


def check_mask(path: Path) -> None:
    decode_levels(path)
    decode_alpha(path)


def check_list(path: Path) -> None:
    """List the scenes of a batch; a list may name no other folder here, so that none is searched."""
    from gsmerge.jobs.batch.find import find_scenes

    if b"/" not in path.read_bytes() and b".." not in path.read_bytes():
        list(find_scenes([str(path)], path.parent / "out"))


def check_pairs(path: Path) -> None:
    """Parse values of ``--set``, one a line."""
    for line in path.read_text("utf-8", "replace").splitlines():
        with suppress(UsageError):
            read_settings((CompactOptions,), [line])


# Makers of Gaussians


def written_by(encode: Callable[[Gaussians], bytes], name: str) -> Make:
    """Encode six Gaussians in a format that is only read."""
    return lambda folder: (folder / name).write_bytes(encode(SOME))


def write_some(name: str) -> Make:
    return lambda folder: gsmerge.write_gaussians(folder / name, SOME)


FACES = b"element face 2\nproperty list uchar int vertex_indices\n"


def write_ply_as(kind: str) -> Make:
    """Write the scene's rows in the other byte order, as text, or with a list element behind or before them."""

    def write(folder: Path) -> None:
        path = folder / "a.ply"
        gsmerge.write_ply(path, SOME)
        head, rows = path.read_bytes().split(b"end_header\n")
        values = np.frombuffer(rows, "<f4")
        text = "".join(" ".join(f"{v:.3f}" for v in row) + "\n" for row in values.reshape(len(SOME), -1)).encode()
        forms = {
            "in big-endian order": head.replace(b"little", b"big") + b"end_header\n" + values.astype(">f4").tobytes(),
            "as text": head.replace(b"binary_little_endian", b"ascii") + b"end_header\n" + text,
            "with faces": head + FACES + b"end_header\n" + rows + b"\1\0\0\0\0\2\0\0\0\0\1\0\0\0",
            "with faces first": head.replace(b"element vertex", FACES + b"element vertex") + b"end_header\n\0\0" + rows,
        }
        path.write_bytes(forms[kind])

    return write


def write_sharp(folder: Path) -> None:
    """Write a ``.ply`` with the camera of SHARP, with two Gaussians."""
    lines = ["ply", "format binary_little_endian 1.0", "element vertex 2", "property float x"]
    for name, count in (("extrinsic", 16), ("intrinsic", 9), ("image_size", 2)):
        lines += [f"element {name} {count}", f"property float {name}"]
    camera = [*np.eye(4).ravel(), 2, 0, 1, 0, 2, 1, 0, 0, 1, 1, 1]
    (folder / "a.ply").write_bytes(
        "\n".join([*lines, "end_header\n"]).encode() + np.array([0, 0, *camera], "<f4").tobytes()
    )


def write_tile(folder: Path) -> None:
    """Write a tileset, whose ``tileset.glb`` holds a ``.spz``."""
    with atomic_outputs() as add:
        index = folder / "tileset.json"
        tileset.write_output(add, index, add(index), Contents([SOME]))


def write_levels(folder: Path, leaves: int = 1) -> None:
    write_set(folder / "lod-meta.json", [random_gaussians(n, n) for n in (6, 3)], leaves=leaves)


# Makers of cameras


def world_mirror(c2w: np.ndarray, K: np.ndarray) -> dict[str, Any]:
    """Return the document of WorldMirror's ``camera_params.json``."""
    poses = [{"camera_id": name, "matrix": pose.tolist()} for name, pose in zip(VIEW_NAMES, c2w, strict=True)]
    return {"extrinsics": poses, "intrinsics": [{**pose, "matrix": K.tolist()} for pose in poses]}


def long_lrm(c2w: np.ndarray, K: np.ndarray, size: tuple[int, int]) -> dict[str, Any]:
    """Return the document of Long-LRM's cameras."""
    common = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "w": size[0], "h": size[1]}
    poses = zip(VIEW_NAMES, invert(c2w), strict=True)
    return {"frames": [{"file_path": name, "w2c": pose.tolist(), **common} for name, pose in poses]}


def frames() -> list[dict[str, Any]]:
    lens = {"fl_x": 20, "fl_y": 20, "cx": 12, "cy": 8, "w": 24, "h": 16, "k1": 0.1, "camera_model": "OPENCV"}
    return [{"file_path": f"{i}.png", "transform_matrix": m.tolist(), **lens} for i, m in enumerate(TINY.c2w)]


def write_frames(folder: Path) -> None:
    """Write frames with a lens each."""
    save_json(folder / "transforms.json", {"frames": frames(), "applied_transform": np.eye(4)[:3].tolist()})


def write_blender(folder: Path) -> None:
    """Write an angle of view, and poses alone."""
    bare = [{key: frame[key] for key in ("file_path", "transform_matrix")} for frame in frames()]
    save_json(folder / "transforms.json", {"camera_angle_x": 0.8, "w": 24, "h": 16, "frames": bare})


def write_pose_list(folder: Path) -> None:
    """Write a pose a line, with intrinsics beside it."""
    K = TINY.K
    lines = (" ".join(map(repr, pose[:3].reshape(-1).tolist())) for pose in TINY.c2w)
    (folder / "camera_poses.txt").write_text("".join(f"{line}\n" for line in lines))
    (folder / "intrinsic.txt").write_text(f"{K[0, 0]} {K[1, 1]} {K[0, 2]} {K[1, 2]}\n")


def write_moved(folder: Path) -> None:
    """Write Long-LRM's cameras, with the files that say how they were moved."""
    with tempfile.TemporaryDirectory() as place:
        export = Path(place) / "export"
        path = export_long_lrm(export).options["cameras"]
        for file in (path, *export.glob("*.txt")):
            (folder / file.name).write_bytes(file.read_bytes())


def write_dataparser(folder: Path) -> None:
    """Write the file in which nerfstudio says how it moved the cameras."""
    save_json(folder / "dataparser_transforms.json", {"transform": np.eye(4)[:3].tolist(), "scale": 0.5})
    save_json(folder / "transforms.json", {"applied_transform": np.eye(4)[:3].tolist(), "applied_scale": 2.0})


def write_metashape(folder: Path) -> Path:
    """Write a file of Metashape with a lens."""
    return FORMATS["Metashape"].write(folder, "<cy>-2</cy>", "<cy>-2</cy><k1>0.1</k1>")


def write_metashape_moved(folder: Path) -> None:
    """Write a file of Metashape with its world."""
    path = write_metashape(folder)
    move = "<rotation>1 0 0 0 1 0 0 0 1</rotation><translation>2 4 6</translation><scale>2</scale>"
    path.write_text(path.read_text().replace("<chunk>", f"<chunk><transform>{move}</transform>"))


def write_views(folder: Path) -> None:
    Ks = np.tile(TINY.K, (3, 1, 1))
    np.savez_compressed(folder / "views.npz", c2w=TINY.c2w, K=Ks, images=TINY.images, order="view-major")


def write_vggt(folder: Path) -> None:
    Ks = np.tile(TINY.K, (3, 1, 1))
    np.savez(folder / "predictions.npz", extrinsic=TINY.w2c[None, :, :3], intrinsic=Ks[None])


# Makers of other files


def write_photo(ending: str, kind: str = "") -> Make:
    picture = np.arange(5 * 7 * 3, dtype=np.uint8).reshape(5, 7, 3)
    kinds = {"": picture, "in grey": picture[..., 0], "of 16 bits": picture.astype(np.uint16) * 257}
    kinds["with alpha"] = np.dstack([picture, picture[..., 0]])
    return lambda folder: (folder / "a.png").write_bytes(cv2.imencode(f".{ending}", kinds[kind])[1].tobytes())


@cache
def state_bytes(recipe: str, batches: int) -> bytes:
    """Return a state of two views of a made room for each batch."""
    scene = scenes.make_scene(scenes.room(), scenes.arc(2, 24, 18), degree=1)
    compactor = Compactor(superpixels="10%", **({"recipe": recipe} if recipe else {"checkpoint": "none"}))
    for _ in range(batches):
        compactor.extend(scene)
    with tempfile.TemporaryDirectory() as place:
        compactor.save(Path(place) / "a.gsm")
        return (Path(place) / "a.gsm").read_bytes()


def write_state(recipe: str = "", batches: int = 1) -> Make:
    return lambda folder: (folder / "a.gsm").write_bytes(state_bytes(recipe, batches))


def write_text(name: str, text: str) -> Make:
    return lambda folder: (folder / name).write_text(text)


PAIRS = 'k=2\nfit=none\nmin_opacity=0.01\nbudget=300\nquality=high\nphotos=null\nk="auto"\nlevels=1e3\n'
PLAIN_SCENE, OF_CAMERAS = TINY.save, partial(TINY.save, cameras=False)
INSPECT = ("inspect",)
SOUNDS: dict[str, Sound] = {
    # A scene: a folder of rows, cameras and photos
    "scene": Sound("", PLAIN_SCENE, load_scene, fuzzed=False),
    "photos": Sound(f"images/{NAMES[0]}", lambda folder: None, check_photo, scene=PLAIN_SCENE, fuzzed=False),
    # Gaussians
    "scene.ply": Sound("scene.ply",
                       lambda folder: gsmerge.write_ply(folder / "scene.ply", TINY.gaussians, overwrite=True),
                       check_gaussians, scene=PLAIN_SCENE),
    "ply": Sound("a.ply", write_some("a.ply"), check_gaussians),
    **{f"ply {kind}": Sound("a.ply", write_ply_as(kind), check_gaussians, rare=True)
       for kind in ("in big-endian order", "as text", "with faces", "with faces first")},
    "compressed ply": Sound("a.compressed.ply", written_by(compressed_bytes, "a.compressed.ply"), check_gaussians),
    "spz": Sound("a.spz", write_some("a.spz"), check_gaussians),
    "spz of version 4": Sound("a.spz", written_by(spz4_bytes, "a.spz"), check_gaussians),
    "sog": Sound("a.sog", write_some("a.sog"), check_gaussians),
    "splat": Sound("a.splat", write_some("a.splat"), check_gaussians),
    "glb": Sound("a.glb", write_some("a.glb"), check_gaussians),
    "tile": Sound("tileset.glb", write_tile, check_gaussians),
    "tileset": Sound("tileset.json", write_tile, check_gaussians, packed=True),
    "Streamed SOG": Sound("lod-meta.json", write_levels, check_gaussians, packed=True),
    "Streamed SOG of a tree": Sound("lod-meta.json", partial(write_levels, leaves=2), check_gaussians, rare=True,
                              packed=True),
    # Cameras beside the rows and photos of their scene
    "transforms.json": Sound("transforms.json", lambda folder: write_transforms(folder / "transforms.json", TINY),
                        check_cameras, scene=OF_CAMERAS),
    "INRIA": Sound("cameras.json", lambda folder: write_inria(folder / "cameras.json", TINY), check_cameras,
                   scene=OF_CAMERAS),
    "Long-LRM": Sound(
        "cameras.json",
        lambda folder: save_json(folder / "cameras.json", long_lrm(TINY.c2w, TINY.K, (TINY.width, TINY.height))),
        check_cameras, scene=OF_CAMERAS),
    "WorldMirror": Sound("camera_params.json",
                         lambda folder: save_json(folder / "camera_params.json", world_mirror(TINY.c2w, TINY.K)),
                         check_cameras, scene=OF_CAMERAS),
    "COLMAP text": Sound("sparse/images.txt", lambda folder: write_colmap_text(folder / "sparse", TINY),
                         check_colmap, scene=OF_CAMERAS, named="sparse", packed=True),
    "COLMAP binary": Sound("sparse/images.bin", lambda folder: write_colmap_binary(folder / "sparse", TINY),
                           check_colmap, scene=OF_CAMERAS, named="sparse", packed=True),
    "pose list": Sound("camera_poses.txt", write_pose_list, check_cameras, scene=OF_CAMERAS, packed=True),
    "views.npz": Sound("views.npz", write_views, check_arrays, scene=OF_CAMERAS),
    "results.npz": Sound("results.npz", lambda folder: write_npz(folder / "results.npz", TINY), check_arrays,
                         scene=OF_CAMERAS),
    # Cameras alone
    "frames with a lens each": Sound("transforms.json", write_frames, check_cameras, INSPECT, rare=True),
    "a list of frames": Sound("transforms.json", lambda folder: save_json(folder / "transforms.json", frames()),
                              check_cameras, INSPECT, rare=True),
    "Blender": Sound("transforms.json", write_blender, check_cameras, INSPECT, rare=True),
    "GlobalSplat": Sound("cameras.json", FORMATS["GlobalSplat cameras.json"].write, check_cameras, INSPECT),
    "OpenSfM": Sound("reconstruction.json", FORMATS["OpenSfM"].write, check_cameras, INSPECT),
    "Metashape": Sound("cameras.xml", write_metashape, check_metashape, INSPECT),
    "Metashape moved": Sound("cameras.xml", write_metashape_moved, check_metashape, INSPECT, rare=True),
    "Polycam": Sound("keyframes/corrected_cameras", FORMATS["Polycam"].write, check_cameras, (), packed=True),
    "Isaac Sim": Sound("camera_params", FORMATS["Isaac Sim"].write, check_cameras, (), packed=True),
    "predictions.npz": Sound("predictions.npz", write_vggt, check_arrays, INSPECT),
    "Long-LRM moved": Sound("opencv_cameras.json", write_moved, check_cameras, INSPECT, packed=True, rare=True),
    "dataparser": Sound("transforms.json", write_dataparser, lambda path: read_dataparser(path, path), (), packed=True),
    "SHARP": Sound("a.ply", write_sharp, read_sharp_camera, ()),
    # States and networks
    "gsm": Sound("a.gsm", write_state(), load_state, INSPECT),
    "gsm of two batches": Sound("a.gsm", write_state(batches=2), load_state, INSPECT, rare=True),
    "gsm to extend": Sound("a.gsm", write_state(), load_state, (), rare=True, fuzzed=False),
    "gsm of features": Sound("a.gsm", write_state("paper"), load_state, INSPECT),
    "checkpoint": Sound("a.safetensors", lambda folder: written(folder / "a.safetensors", noisy()), load_checkpoint,
                        INSPECT),
    # Photos and lists, which only their readers read
    **{f"photo.{ending}": Sound("a.png", write_photo(ending), check_photo, ()) for ending in PHOTO_ENDINGS},
    **{f"photo {kind}": Sound("a.png", write_photo("png", kind), check_photo, (), rare=True)
       for kind in ("in grey", "with alpha", "of 16 bits")},
    **{f"mask.{ending}": Sound("a.png", write_photo(ending), check_mask, (), rare=True) for ending in PHOTO_ENDINGS},
    "mask in alpha": Sound("a.png", write_photo("png", "with alpha"), check_mask, (), rare=True),
    "list of scenes": Sound("list.txt", write_text("list.txt", "a.ply\n# b\nscene c\n\nd.spz\n"), check_list, ()),
    "values of --set": Sound("pairs.txt", write_text("pairs.txt", PAIRS), check_pairs, ()),
}  # fmt: skip
