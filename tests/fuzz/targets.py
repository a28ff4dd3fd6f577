"""The table of readers: what reads a file, and small sound files from which changed ones are made."""

from __future__ import annotations

import io
import json
import re
import tempfile
import warnings
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from former_formats import compressed_bytes, spz4_bytes
from made_gaussians import random_gaussians
from model_files import long_lrm
from program_cameras import FORMATS
from splat_transform_programs import write_set
from tiny_scene import make_tiny, save_json, write_colmap_binary, write_colmap_text, write_npz

import gsmerge
from gsmerge.cli.parameters import parse_pairs
from gsmerge.errors import GsmergeError, SceneError, UsageError
from gsmerge.io import read_cameras, read_gaussians, read_images
from gsmerge.io.cameras.dataparser import read_dataparser
from gsmerge.io.cameras.npz_files import read_depths
from gsmerge.io.cameras.read import read_sharp_camera
from gsmerge.io.crop_file import read_crop
from gsmerge.io.photo_files import decode_alpha, decode_levels
from gsmerge.networks.checkpoint import load_checkpoint, save_checkpoint
from gsmerge.networks.options import NetworkOptions, weight_shapes
from gsmerge.networks.weights import NetworkWeights
from gsmerge.settings.compact import CompactOptions
from gsmerge.settings.setting import flat_settings
from gsmerge.states.compactor import Compactor
from gsmerge.states.state_file import load_state
from gsmerge.types import Gaussians

PHOTO_ENDINGS = (".png", ".jpg", ".bmp", ".webp", ".tiff", ".ppm")
PLAIN = re.compile(r"([\w-]+/)?[\w-]+\.\w+")
UNPACKING = (zipfile.BadZipFile, zlib.error, ValueError, KeyError, EOFError, OSError, NotImplementedError, RuntimeError)
Seeds = Callable[[Path], Iterable[bytes]]  # makes files in an empty folder


@dataclass(frozen=True)
class Target:
    """A reader.

    Args:
        name: Of the file that it reads. With a slash, the input is an archive of a folder; what follows is read in it.
        seeds: Makes sound files.
        read: The reader, with checks of what it returns.
    """

    name: str
    seeds: Seeds
    read: Callable[[Path], Any]

    def attempt(self, data: bytes, folder: Path) -> bool:
        """Read these bytes from a file in an empty folder -> whether they are sound.

        AssertionError if they are refused in another way than by one line that names the file.
        """
        _, slash, name = self.name.rpartition("/")
        if slash:
            if not unpack(data, folder):
                return False
        else:
            (folder / name).write_bytes(data)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            try:
                self.read(folder / name if name else folder)
                return True
            except GsmergeError as error:
                refused = error
        assert not isinstance(refused, SceneError) or str(folder) in str(refused), f"no file named: {refused}"
        assert "\n" not in str(refused), f"several lines: {refused}"
        return False


def pack(folder: Path) -> bytes:
    """Return the files of a folder as an archive."""
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as file:
        for path in sorted(path for path in folder.rglob("*") if path.is_file()):
            file.writestr(str(path.relative_to(folder)), path.read_bytes())
    return packed.getvalue()


def unpack(data: bytes, folder: Path) -> bool:
    """Write the files of an archive into a folder, those with plain names; return whether it is an archive."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as file:
            contents = {name: file.read(name) for name in file.namelist() if PLAIN.fullmatch(name)}
    except UNPACKING:
        return False
    for name, content in contents.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(content)
    return bool(contents)


def check_gaussians(path: Path) -> None:
    """Read Gaussians; assert that they are sound."""
    g = read_gaussians(path).gaussians
    assert len(g) > 0
    assert np.isfinite(g.means).all()
    assert (g.scales >= 0).all()
    assert np.isfinite(g.scales).all()
    assert ((g.opacities >= 0) & (g.opacities <= 1)).all()
    assert (np.abs(np.linalg.norm(g.quats.astype(np.float64), axis=1) - 1) < 1e-5).all()


def check_cameras(path: Path) -> None:
    """Read cameras; assert that they are sound."""
    actual = read_cameras(path)
    assert 0 < len(actual) == len(actual.viewmats) == len(actual.Ks) == len(actual.widths) == len(actual.heights)
    assert np.isfinite(actual.viewmats).all()
    assert np.isfinite(actual.Ks).all()
    assert (actual.Ks[:, 0, 0] > 0).all()
    assert (actual.widths >= 0).all()


def check_arrays(path: Path) -> None:
    """Read depths and cameras."""
    read_depths(path)
    check_cameras(path)


def check_photo(path: Path) -> None:
    """Read a photo; assert that its colours are in range."""
    actual = read_images([path], [path.name])
    assert actual.shape[0] == 1
    assert ((actual >= 0) & (actual <= 1)).all()


def check_mask(path: Path) -> None:
    """Read a mask, and the transparency of a photo."""
    decode_levels(path)
    decode_alpha(path)


def check_list(path: Path) -> None:
    """List the scenes of a batch; a list may name no other folder here, so that none is searched."""
    from gsmerge.batch.find import find_scenes

    if b"/" not in path.read_bytes() and b".." not in path.read_bytes():
        list(find_scenes([str(path)], path.parent / "out"))


def check_pairs(path: Path) -> None:
    """Parse values of ``--set``, one a line."""
    for line in path.read_text("utf-8", "replace").splitlines():
        with suppress(UsageError):
            parse_pairs("--set", [line], flat_settings(CompactOptions))


def written(name: str, degree: int = 0) -> Seeds:
    """Make a file of six Gaussians."""

    def make(folder: Path) -> Iterable[bytes]:
        gsmerge.write_gaussians(folder / name, random_gaussians(6, 0, degree=degree))
        yield (folder / name).read_bytes()

    return make


def of_bytes(encode: Callable[[Gaussians], bytes]) -> Seeds:
    """Encode six Gaussians in a format that is only read."""
    return lambda folder: [encode(random_gaussians(6, 0, degree=1))]


def plys(folder: Path) -> Iterable[bytes]:
    """Make a ``.ply`` as binary of both orders, as text, and with a list element."""
    g = random_gaussians(5, 1, degree=1)
    gsmerge.write_ply(folder / "a.ply", g)
    data = (folder / "a.ply").read_bytes()
    head, rows = data.split(b"end_header\n")
    values = np.frombuffer(rows, "<f4")
    yield data
    yield head.replace(b"little", b"big") + b"end_header\n" + values.astype(">f4").tobytes()
    text = "".join(" ".join(f"{v:.3f}" for v in row) + "\n" for row in values.reshape(5, -1)).encode()
    yield head.replace(b"binary_little_endian", b"ascii") + b"end_header\n" + text
    faces = b"element face 2\nproperty list uchar int vertex_indices\n"
    yield head + faces + b"end_header\n" + rows + b"\1\0\0\0\0\2\0\0\0\0\1\0\0\0"
    yield head.replace(b"element vertex", faces + b"element vertex") + b"end_header\n" + bytes(2) + rows


def sharp(folder: Path) -> Iterable[bytes]:
    """Make a ``.ply`` with the camera of SHARP, with two Gaussians."""
    lines = ["ply", "format binary_little_endian 1.0", "element vertex 2", "property float x"]
    for name, count in (("extrinsic", 16), ("intrinsic", 9), ("image_size", 2)):
        lines += [f"element {name} {count}", f"property float {name}"]
    camera = [*np.eye(4).ravel(), 2, 0, 1, 0, 2, 1, 0, 0, 1, 1, 1]
    yield "\n".join([*lines, "end_header\n"]).encode() + np.array([0, 0, *camera], "<f4").tobytes()


def levels(folder: Path) -> Iterable[bytes]:
    """Make two levels of detail."""
    write_set(folder / "lod-meta.json", [random_gaussians(n, n) for n in (6, 3)], leaves=2)
    yield pack(folder)


def json_cameras(folder: Path) -> Iterable[bytes]:
    """Make cameras of every kind of JSON file, and nerfstudio's with lenses and with a field of view."""
    for name in FORMATS:
        path = FORMATS[name].write(folder)
        if path.suffix == ".json":
            yield path.read_bytes()
    frames = json.loads(FORMATS["transforms.json"].write(folder).read_text())["frames"]
    lens = {"fl_x": 20, "fl_y": 20, "cx": 12, "cy": 8, "w": 24, "h": 16, "k1": 0.1, "camera_model": "OPENCV"}
    lenses = [frame | lens for frame in frames]
    for data in (
        {"frames": lenses, "applied_transform": np.eye(4)[:3].tolist()},
        {"camera_angle_x": 0.8, "frames": frames},
    ):
        yield json.dumps(data).encode()


def colmap(write: Callable[..., None]) -> Seeds:
    """Make a COLMAP model."""

    def make(folder: Path) -> Iterable[bytes]:
        write(folder, make_tiny(4, 4))
        yield pack(folder)

    return make


def pose_list(folder: Path) -> Iterable[bytes]:
    """Make a list of poses, with intrinsics beside it."""
    (folder / "camera_poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 1 0 1 0 0 0 0 1 0\n")
    (folder / "intrinsic.txt").write_text("20 20 12 8\n")
    yield pack(folder)


def pose_lists(folder: Path) -> Iterable[bytes]:
    """Make lists of poses as TUM, RealEstate10K and Open3D have them."""
    pose = "1 0 0 0 0 1 0 0 0 0 1 0"
    yield b"# time x y z q\n1.5 0 0 1 0 0 0 1\n1.6 0 0 2 0 0 0 1\n"
    yield f"https://a.b/c\n100 .9 .9 .5 .5 0 0 {pose}\n200 .9 .9 .5 .5 0 0 {pose}\n".encode()
    yield b"0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n1 1 2\n1 0 0 1\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"


def pose_folder(folder: Path) -> Iterable[bytes]:
    """Make poses of a file each, with intrinsics in a matrix or as SRN and NSVF have them."""
    (folder / "pose").mkdir()
    for view in range(2):
        (folder / f"pose/{view}.txt").write_text(f"1 0 0 {view}\n0 1 0 0\n0 0 1 0\n0 0 0 1\n")
    yield pack(folder)


def polycam(folder: Path) -> Iterable[bytes]:
    """Make the keyframes of Polycam, a file for each camera."""
    yield pack(FORMATS["Polycam"].write(folder))


def metashape(folder: Path) -> Iterable[bytes]:
    """Make a file of Metashape, with and without its world."""
    path = FORMATS["Metashape"].write(folder, "<f>42", "<k1>0.1</k1><f>42")
    yield path.read_bytes()
    move = (
        b"<transform><rotation>1 0 0 0 1 0 0 0 1</rotation><translation>2 4 6</translation><scale>2</scale></transform>"
    )
    yield path.read_bytes().replace(b"<chunk>", b"<chunk>" + move)


def check_metashape(path: Path) -> None:
    """Read cameras, and their world."""
    read_dataparser(path, path)
    check_cameras(path)


def moved(folder: Path) -> Iterable[bytes]:
    """Make Long-LRM's cameras, with the files that say how they were moved."""
    export = long_lrm(folder / "export")
    for name in ("input_frame_idx.txt", "pos_avg_inv.txt", "scene_scale.txt"):
        (folder / name).write_bytes((folder / "export" / name).read_bytes())
    path = export.options["cameras"]
    flat = folder / "flat"
    flat.mkdir()
    for file in (path, *folder.glob("*.txt")):
        (flat / file.name).write_bytes(file.read_bytes())
    yield pack(flat)


def dataparser(folder: Path) -> Iterable[bytes]:
    """Make the file in which nerfstudio says how it moved the cameras."""
    save_json(folder / "dataparser_transforms.json", {"transform": np.eye(4)[:3].tolist(), "scale": 0.5})
    save_json(folder / "transforms.json", {"applied_transform": np.eye(4)[:3].tolist(), "applied_scale": 2.0})
    yield pack(folder)


def arrays(folder: Path) -> Iterable[bytes]:
    """Make ``.npz`` files of every kind."""
    tiny = make_tiny(4, 4)
    write_npz(folder / "a.npz", tiny)
    Ks = np.tile(tiny.K, (3, 1, 1))
    np.savez_compressed(folder / "b.npz", c2w=tiny.c2w, K=Ks, images=tiny.images, order="view-major")
    np.savez(folder / "c.npz", extrinsic=tiny.w2c[None, :, :3], intrinsic=Ks[None])
    for name in "abc":
        yield (folder / f"{name}.npz").read_bytes()


def photos(folder: Path, endings: Sequence[str] = PHOTO_ENDINGS) -> Iterator[bytes]:
    """Make a small photo in every format, and PNG files with transparency, a palette and 16 bits."""
    picture = np.arange(5 * 7 * 3, dtype=np.uint8).reshape(5, 7, 3)
    for ending in endings:
        yield cv2.imencode(ending, picture)[1].tobytes()
    if ".png" in endings:
        for image in (picture[..., 0], np.dstack([picture, picture[..., 0]]), picture.astype(np.uint16) * 257):
            yield cv2.imencode(".png", image)[1].tobytes()


def states(folder: Path) -> Iterable[bytes]:
    """Make the states of one batch and of two."""
    scene = gsmerge.read_scene(make_tiny(6, 4).save(folder / "scene"))
    compactor = Compactor(checkpoint="none")
    for name in "ab":
        compactor.extend(scene)
        compactor.save(folder / f"{name}.gsm")
        yield (folder / f"{name}.gsm").read_bytes()


def checkpoint(folder: Path) -> Iterable[bytes]:
    """Make small networks of zeros."""
    options = NetworkOptions(width=16, heads=2, latent=8, members=8, neighbors=4)
    arrays = {name: np.zeros(shape, np.float32) for name, shape in weight_shapes(options).items()}
    save_checkpoint(folder / "a", NetworkWeights(options, arrays), {"steps": 0})
    yield (folder / "a").read_bytes()


def texts(*contents: bytes) -> Seeds:
    """Make text files of this content."""
    return lambda folder: contents


PAIRS = b'k=2\nfit=none\nmin_opacity=0.01\nbudget=300\nquality=high\nphotos=null\nk="auto"\nlevels=1e3\n'
TARGETS: dict[str, Target] = {
    "ply": Target("a.ply", plys, check_gaussians),
    "ply-compressed": Target("a.compressed.ply", of_bytes(compressed_bytes), check_gaussians),
    "spz": Target("a.spz", written("a.spz", 1), check_gaussians),
    "spz-4": Target("a.spz", of_bytes(spz4_bytes), check_gaussians),
    "sog": Target("a.sog", written("a.sog", 1), check_gaussians),
    "splat": Target("a.splat", written("a.splat"), check_gaussians),
    "glb": Target("a.glb", written("a.glb", 1), check_gaussians),
    "levels": Target("levels/lod-meta.json", levels, check_gaussians),
    "cameras-json": Target("cameras.json", json_cameras, check_cameras),
    "colmap-text": Target("colmap/", colmap(write_colmap_text), check_cameras),
    "colmap-binary": Target("colmap/", colmap(write_colmap_binary), check_cameras),
    "pose-list": Target("poses/camera_poses.txt", pose_list, check_cameras),
    "pose-lists": Target("a.txt", pose_lists, check_cameras),
    "pose-folder": Target("pose/", pose_folder, check_cameras),
    "polycam": Target("keyframes/", polycam, check_cameras),
    "metashape": Target("a.xml", metashape, check_metashape),
    "long-lrm": Target("moved/opencv_cameras.json", moved, check_cameras),
    "dataparser": Target("moved/transforms.json", dataparser, lambda path: read_dataparser(path, path)),
    "npz": Target("results.npz", arrays, check_arrays),
    "sharp": Target("a.ply", sharp, read_sharp_camera),
    "gsm": Target("a.gsm", states, load_state),
    "checkpoint": Target("a.safetensors", checkpoint, load_checkpoint),
    "crop": Target(
        "a.json", texts(b'{"shape": "box", "center": [0, 1, 2], "size": [1, 2, 3], "rotate": [0, 30, 0]}'), read_crop
    ),
    "photo": Target("a.png", photos, check_photo),
    "mask": Target("a.png", photos, check_mask),
    "list": Target("list.txt", texts(b"a.ply\n# b\nscene c\n\nd.spz\n"), check_list),
    "set": Target("pairs.txt", texts(PAIRS), check_pairs),
}


def seeds_of(target: Target) -> list[bytes]:
    """Make the sound files of a target."""
    with tempfile.TemporaryDirectory() as folder:
        return list(target.seeds(Path(folder)))
