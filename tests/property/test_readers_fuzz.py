"""The readers of Gaussians and cameras on files that hypothesis makes: an answer or a SceneError, nothing else.

``GSMERGE_FUZZ_EXAMPLES`` sets how many files each test tries.
"""

from __future__ import annotations

import io
import json
import os
import struct
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from gsmerge.errors import SceneError
from gsmerge.io import read_cameras, read_gaussians, read_images
from gsmerge.io.cameras.camera_file import CameraFile
from gsmerge.io.cameras.npz_files import read_depths
from gsmerge.io.cameras.read import read_sharp_camera
from gsmerge.io.formats.arrays import REQUIRED
from gsmerge.io.formats.glb import glb_bytes
from gsmerge.types import Gaussians

EXAMPLES = int(os.environ.get("GSMERGE_FUZZ_EXAMPLES", "40"))
ROWS = 3

fuzzed = settings(max_examples=EXAMPLES, deadline=None, suppress_health_check=list(HealthCheck), database=None)


def attempt(name: str, data: bytes, read: Callable[[Path], Any], **beside: bytes) -> Any:
    """What the reader says about a file of these bytes; None where it refuses it in one line with its name."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / name
        for other, content in beside.items():
            (path.parent / other.replace("__", ".")).write_bytes(content)
        path.write_bytes(data)
        refused = None
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            try:
                return read(path)
            except SceneError as error:
                refused = error
    assert folder in str(refused)
    return None


@st.composite
def mutated(draw: st.DrawFn, seed: bytes) -> bytes:
    """Some bytes with pieces overwritten, removed, put in, or taken from elsewhere."""
    data = bytearray(seed)
    for _ in range(draw(st.integers(0, 4))):
        start = draw(st.integers(0, len(data)))
        length = draw(st.integers(0, 24))
        piece = draw(
            st.one_of(
                st.binary(max_size=16),
                st.sampled_from(
                    [b"\0" * 8, b"\xff" * 8, b"-1", b"99999999999", b"nan", b"1e999", b"\n", b"list uchar"]
                ),
                st.integers(0, max(len(seed) - 1, 0)).map(lambda at: seed[at : at + 24]),
            )
        )
        data[start : start + length] = piece
    return bytes(data[: draw(st.integers(0, len(data)))] if draw(st.booleans()) and draw(st.booleans()) else data)


def ply_seed(form: str) -> bytes:
    lines = ["ply", f"format {form} 1.0", f"element vertex {ROWS}", *(f"property float {name}" for name in REQUIRED)]
    values = np.linspace(-1, 1, ROWS * len(REQUIRED)).reshape(ROWS, -1)
    if form == "ascii":
        rows = "".join(" ".join(f"{v:.3f}" for v in row) + "\n" for row in values).encode()
    else:
        rows = values.astype("<f4" if "little" in form else ">f4").tobytes()
    return "\n".join([*lines, "end_header\n"]).encode() + rows


def packed_seed() -> bytes:
    names = [f"{end}_{what}{axis}" for what in ("", "scale_") for end in ("min", "max") for axis in "xyz"]
    lines = ["ply", "format binary_little_endian 1.0", "element chunk 1", *(f"property float {n}" for n in names)]
    lines += [f"element vertex {ROWS}", *(f"property uint packed_{n}" for n in ("position", "rotation", "scale"))]
    body = np.arange(12, dtype="<f4").tobytes() + np.arange(4 * ROWS, dtype="<u4").tobytes()
    return "\n".join([*lines, "property uint packed_color", "end_header\n"]).encode() + body


def sharp_seed() -> bytes:
    lines = ["ply", "format binary_little_endian 1.0", "element vertex 2", "property float x"]
    for name, count in (("extrinsic", 16), ("intrinsic", 9), ("image_size", 2)):
        lines += [f"element {name} {count}", f"property float {name}"]
    camera = [*np.eye(4).ravel(), 2, 0, 1, 0, 2, 1, 0, 0, 1, 1, 1]
    return "\n".join([*lines, "end_header\n"]).encode() + np.array([0, 0, *camera], "<f4").tobytes()


def glb_seed() -> bytes:
    values = np.linspace(0.1, 0.9, 4 * ROWS, dtype=np.float32).reshape(ROWS, 4)
    means, sh0 = values[:, :3], values[:, None, :3]
    return glb_bytes(Gaussians(means, values, means, values[:, 3], sh0, np.repeat(sh0, 3, axis=1)))


PLY_SEEDS = [*(ply_seed(form) for form in ("binary_little_endian", "binary_big_endian", "ascii")), packed_seed()]


def check_gaussians(path: Path) -> None:
    actual = read_gaussians(path)
    gaussians, count = actual.gaussians, len(actual.gaussians)
    assert 0 < count <= path.stat().st_size
    assert np.isfinite(gaussians.means).all()
    assert (gaussians.scales >= 0).all()
    assert np.isfinite(gaussians.scales).all()
    assert ((gaussians.opacities >= 0) & (gaussians.opacities <= 1)).all()
    assert (np.abs(np.linalg.norm(gaussians.quats.astype(np.float64), axis=1) - 1) < 1e-5).all()


@given(st.sampled_from(PLY_SEEDS).flatmap(mutated))
@fuzzed
def test_mutated_ply_files(data: bytes) -> None:
    attempt("a.ply", data, check_gaussians)


@given(mutated(glb_seed()))
@fuzzed
def test_mutated_glb_files(data: bytes) -> None:
    attempt("a.glb", data, check_gaussians)


words = st.sampled_from(["vertex", "chunk", "sh", "list", "float", "uchar", "int", "double", "x", "y", "0", "1", "-1",
                         "7", "4294967296", "property", "element", "packed_position", *REQUIRED])  # fmt: skip
lines = st.lists(st.lists(words, max_size=5).map(" ".join), max_size=30).map("\n".join)


@given(st.sampled_from(["ascii", "binary_little_endian"]), lines, st.binary(max_size=200))
@fuzzed
def test_made_up_ply_headers(form: str, header: str, rows: bytes) -> None:
    attempt("a.ply", f"ply\nformat {form} 1.0\n{header}\nend_header\n".encode() + rows, check_gaussians)


@given(mutated(sharp_seed()))
@fuzzed
def test_mutated_cameras_inside_a_ply(data: bytes) -> None:
    attempt("a.ply", data, read_sharp_camera)


def check_cameras(path: Path) -> None:
    actual: CameraFile = read_cameras(path)
    assert 0 < len(actual) == len(actual.viewmats) == len(actual.Ks) == len(actual.widths) == len(actual.heights)
    assert np.isfinite(actual.viewmats).all()
    assert np.isfinite(actual.Ks).all()
    assert (actual.Ks[:, 0, 0] > 0).all()
    assert (actual.widths >= 0).all()


POSE = np.eye(4).tolist()
numbers = st.one_of(st.floats(), st.integers(), st.sampled_from([0, 1, -1, 24, 2**63, 1e300, 10**400]))
plain = st.one_of(st.none(), st.booleans(), numbers, st.text(max_size=6))
anything = st.recursive(plain, lambda inner: st.lists(inner, max_size=4), max_leaves=10)
matrices = st.one_of(
    st.just(POSE),
    st.just(np.eye(3).tolist()),
    st.lists(st.lists(numbers, min_size=4, max_size=4), max_size=4),
    anything,
)
KEYS = {
    "fl_x": numbers, "fl_y": numbers, "cx": numbers, "cy": numbers, "w": numbers, "h": numbers, "k1": anything,
    "camera_angle_x": anything, "camera_model": anything, "distortion_params": anything, "file_path": anything,
    "transform_matrix": matrices, "w2c": matrices, "fx": numbers, "fy": numbers, "width": numbers, "height": numbers,
    "position": anything, "rotation": matrices, "img_name": anything, "camera_id": anything, "matrix": matrices,
}  # fmt: skip
SOUND: dict[str, Any] = {
    "fl_x": 20, "fl_y": 20, "cx": 12, "cy": 8, "w": 24, "h": 16, "transform_matrix": POSE, "w2c": POSE, "fx": 20,
    "fy": 20, "width": 24, "height": 16, "position": [0, 0, 0], "rotation": np.eye(3).tolist(), "camera_id": "a",
    "matrix": POSE, "file_path": "a.png",
}  # fmt: skip


@st.composite
def entries(draw: st.DrawFn) -> Any:
    """A camera with some keys missing and some spoiled."""
    lost = draw(st.sets(st.sampled_from(list(SOUND)), max_size=2))
    spoiled = draw(st.sets(st.sampled_from(list(KEYS)), max_size=2))
    entry = {key: value for key, value in SOUND.items() if key not in lost}
    return entry | {key: draw(KEYS[key]) for key in sorted(spoiled)}


cameras = st.lists(st.integers(0, 9).flatmap(lambda i: entries() if i else anything), min_size=1, max_size=3)
files = st.one_of(
    cameras, st.builds(lambda common, frames: {**common, "frames": frames}, entries(), cameras),
    st.builds(lambda a, b: {"extrinsics": a, "intrinsics": b}, cameras, cameras), anything,
)  # fmt: skip


@given(files)
@fuzzed
def test_made_up_camera_json(data: Any) -> None:
    attempt("cameras.json", json.dumps(data).encode(), check_cameras)


SOUND_JSON = json.dumps({"frames": [SOUND, SOUND]}).encode()


@given(mutated(SOUND_JSON))
@fuzzed
def test_mutated_camera_json(data: bytes) -> None:
    attempt("transforms.json", data, check_cameras)


def colmap_seeds() -> tuple[bytes, bytes]:
    images = struct.pack("<Q", 2)
    for i in range(2):
        images += struct.pack("<i7di", i, 1, 0, 0, 0, 0, 0, i, 1) + b"a.png\0" + struct.pack("<Q", i) + bytes(24 * i)
    return struct.pack("<QiiQQ4d", 1, 1, 1, 24, 16, 20, 20, 12, 8), images


TEXT_SEEDS = b"1 PINHOLE 24 16 20 20 12 8\n", b"1 1 0 0 0 0 0 0 1 a.png\n\n2 1 0 0 0 0 0 1 1 b c.png\n1 2 -1\n"


@given(st.data(), st.booleans())
@fuzzed
def test_mutated_colmap_models(data: st.DataObject, text: bool) -> None:
    cameras, images = (data.draw(mutated(seed)) for seed in (TEXT_SEEDS if text else colmap_seeds()))
    suffix = "txt" if text else "bin"
    attempt(f"images.{suffix}", images, lambda path: check_cameras(path.parent), **{f"cameras__{suffix}": cameras})


def npz_seed(**arrays: np.ndarray) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        np.savez(Path(folder) / "a.npz", **arrays)
        return (Path(folder) / "a.npz").read_bytes()


K = np.array([[[20.0, 0, 12], [0, 20, 8], [0, 0, 1]]])
EYE = np.eye(4)[None]
NPZ_SEEDS = [
    npz_seed(c2w=EYE, K=K, images=np.zeros((1, 2, 3, 3), np.uint8)),
    npz_seed(extrinsics=EYE[:, :3], intrinsics=K, depth=np.ones((1, 16, 24), np.float16)),
]
dtypes = st.sampled_from(["f4", "f8", "f2", "u1", "i8", "U3", "c8", "?", "M8[s]", "i2"])
shapes = st.sampled_from([(1, 4, 4), (1, 3, 4), (1, 3, 3), (2, 3, 3), (0, 3, 3), (1, 2, 3, 3), (1, 3, 2, 5), (), (3,)])


@st.composite
def arrays(draw: st.DrawFn) -> np.ndarray:
    shape, dtype = draw(shapes), draw(dtypes)
    raw = draw(st.binary(max_size=64)) or b"\0"
    size = int(np.prod(shape)) * np.dtype(dtype).itemsize
    if draw(st.booleans()) and dtype[0] in "fui":
        return (np.eye(*shape[-2:]) if len(shape) > 1 else np.ones(1)).astype(dtype) * np.ones(shape, dtype)
    fill_template = (raw * (size // len(raw) + 1))[:size]
    if dtype == "U3":
        return np.full(shape, "1a")
    return np.frombuffer(bytes(b & 1 for b in fill_template) if dtype == "?" else fill_template, dtype).reshape(shape)


def check_npz(path: Path) -> None:
    read_depths(path)
    check_cameras(path)


@given(st.sampled_from(NPZ_SEEDS).flatmap(mutated))
@fuzzed
def test_mutated_npz(data: bytes) -> None:
    attempt("results.npz", data, check_npz)


@given(st.dictionaries(
    st.sampled_from(["c2w", "K", "images", "order", "extrinsics", "intrinsics", "image", "depth"]), arrays(), max_size=5
))  # fmt: skip
@fuzzed
def test_made_up_npz(actual: dict[str, np.ndarray]) -> None:
    sound = {"c2w": EYE, "K": K, "images": np.zeros((1, 2, 3, 3), np.uint8), "extrinsics": EYE, "intrinsics": K}
    attempt("views.npz", npz_seed(**{**sound, **actual}), check_npz)


@given(mutated(b"1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 1 0 1 0 0 0 0 1 0\n"), mutated(b"20 20 12 8\n"))
@fuzzed
def test_mutated_pose_lists(poses: bytes, intrinsics: bytes) -> None:
    attempt("camera_poses.txt", poses, check_cameras, intrinsic__txt=intrinsics)


def image_seed(suffix: str) -> bytes:
    import cv2

    picture = np.arange(5 * 7 * 3, dtype=np.uint8).reshape(5, 7, 3)
    return cv2.imencode(suffix, picture)[1].tobytes()


IMAGE_SEEDS = [image_seed(suffix) for suffix in (".png", ".jpg", ".bmp", ".webp", ".tiff", ".ppm")]


def chunk_seed() -> bytes:
    rows = torch.cat([torch.tensor([[0.9, 0.9, 0.5, 0.5, 0, 0]]), torch.eye(4)[:3].reshape(1, 12)], 1)
    stream = io.BytesIO()
    picture = np.frombuffer(image_seed(".jpg"), np.uint8).copy()
    torch.save([{"key": "a", "cameras": rows, "images": [torch.from_numpy(picture)]}], stream)
    return stream.getvalue()


@given(mutated(chunk_seed()))
@fuzzed
def test_mutated_chunks(data: bytes) -> None:
    attempt("000000.torch", data, check_cameras)


@given(st.sampled_from(IMAGE_SEEDS).flatmap(mutated))
@fuzzed
def test_mutated_images(data: bytes) -> None:
    actual = attempt("a.png", data, lambda path: read_images([path], ["a.png"]))
    if actual is not None:
        assert actual.shape[0] == 1
        assert ((actual >= 0) & (actual <= 1)).all()
