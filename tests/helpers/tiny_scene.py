"""A tiny per-pixel scene is written in every camera format, as the formats' own documents describe them."""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from gsmerge.io import CameraFile, write_ply
from gsmerge.method.geometry.transforms import normalize, quat_to_rotmat, rotmat_to_quat
from gsmerge.method.kernels import elementary
from gsmerge.method.kernels.matrices import invert, matmul
from gsmerge.types import Gaussians

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True)
class Tiny:
    """Three views of 20 x 14 with oblong pixels and a principal point off the middle."""

    c2w: np.ndarray  # [3,4,4] OpenCV
    K: np.ndarray  # [3,3]
    width: int
    height: int
    images: np.ndarray  # [3,h,w,3] uint8
    gaussians: Gaussians
    names: tuple[str, ...]

    @property
    def w2c(self) -> np.ndarray:
        return invert(self.c2w)

    def save(self, folder: Path, *, cameras: bool = True, images: bool = True) -> Path:
        folder.mkdir(parents=True, exist_ok=True)
        write_ply(folder / "scene.ply", self.gaussians)
        if cameras:
            write_transforms(folder / "transforms.json", self)
        if images:
            write_images(folder / "images", self)
        return folder


def rotation(x: float, y: float, z: float) -> np.ndarray:
    """Return the matrix ``[3,3]`` of a rotation vector, radians."""
    angle = math.sqrt(x * x + y * y + z * z)
    half = elementary.sin(angle / 2) / angle if angle else 0.0
    return quat_to_rotmat(np.array([elementary.cos(angle / 2), half * x, half * y, half * z]))


def make_tiny(width: int = 20, height: int = 14) -> Tiny:
    rng = np.random.default_rng(3)
    K = np.array([[1.1 * width, 0, 0.45 * width], [0, 1.5 * height, 0.55 * height], [0, 0, 1.0]])
    c2w = np.tile(np.eye(4), (3, 1, 1))
    for i in range(3):
        c2w[i, :3, :3] = rotation(0.1 * i + 0.2, 0.5 - 0.4 * i, 0.15 * i - 0.1)
        c2w[i, :3, 3] = (1.0 * i - 0.5, 0.3 * i + 0.2, -0.4 * i - 1.5)
    y, x = np.mgrid[:height, :width]
    means = []
    for pose in c2w:
        depth = 2 + 0.5 * elementary.sin(x / 3) + 0.3 * rng.random((height, width))
        u, v = (x + 0.5 + rng.uniform(-0.2, 0.2, x.shape), y + 0.5 + rng.uniform(-0.2, 0.2, x.shape))
        camera = np.stack([(u - K[0, 2]) / K[0, 0] * depth, (v - K[1, 2]) / K[1, 1] * depth, depth], -1)
        means.append(matmul(camera.reshape(-1, 3), pose[:3, :3].T) + pose[:3, 3])
    n = 3 * width * height
    images = rng.integers(0, 256, (3, height, width, 3), np.uint8)
    quats = normalize(rng.normal(size=(n, 4)).astype(np.float32))
    gaussians = Gaussians(
        means=np.concatenate(means).astype(np.float32),
        quats=quats,
        scales=rng.uniform(0.01, 0.1, (n, 3)).astype(np.float32),
        opacities=rng.uniform(0.05, 0.95, n).astype(np.float32),
        sh0=((images.reshape(n, 1, 3) / 255.0).astype(np.float32) - 0.5) / 0.28209479,
        shN=np.zeros((n, 0, 3), np.float32),
    )
    return Tiny(c2w, K, width, height, images, gaussians, ("a b/2.png", "a b/10.png", "a b/11.png"))


def write_images(folder: Path, tiny: Tiny) -> None:
    for name, image in zip(tiny.names, tiny.images, strict=True):
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), image[..., ::-1])


def frames_of(tiny: Tiny) -> dict:
    matrices = matmul(tiny.c2w, FLIP).tolist()
    frames = [{"file_path": f"images/{n}", "transform_matrix": m} for n, m in zip(tiny.names, matrices, strict=True)]
    K = tiny.K
    sizes = {"w": tiny.width, "h": tiny.height}
    return {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], **sizes, "frames": frames}


def write_transforms(path: Path, tiny: Tiny) -> None:
    path.write_text(json.dumps(frames_of(tiny)))


def write_colmap_text(folder: Path, tiny: Tiny, model: str = "PINHOLE", extra: str = "") -> None:
    folder.mkdir(parents=True, exist_ok=True)
    K = tiny.K
    params = f"{K[0, 0]} {K[1, 1]} {K[0, 2]} {K[1, 2]}"
    (folder / "cameras.txt").write_text(f"# comment\n7 {model} {tiny.width} {tiny.height} {params}{extra}\n")
    lines = ["# Image list with two lines of data per image:", ""]
    for i, (name, pose) in enumerate(zip(tiny.names, tiny.w2c, strict=True)):
        numbers = " ".join(repr(float(v)) for v in (*rotmat_to_quat(pose[None, :3, :3])[0], *pose[:3, 3]))
        lines += [f"{i + 4} {numbers} 7 {name}", "" if i == 0 else "10.5 3.5 -1 4.0 4.0 12 " * 3]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    (folder / "points3D.txt").write_text("")


def write_colmap_binary(folder: Path, tiny: Tiny, model: int = 1, extra: tuple[float, ...] = ()) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    K = tiny.K
    params = (K[0, 0], K[1, 1], K[0, 2], K[1, 2], *extra)
    head = struct.pack("<QiiQQ", 1, 7, model, tiny.width, tiny.height)
    (folder / "cameras.bin").write_bytes(head + struct.pack(f"<{len(params)}d", *params))
    data = struct.pack("<Q", len(tiny.names))
    for i, (name, pose) in enumerate(zip(tiny.names, tiny.w2c, strict=True)):
        data += struct.pack("<i7di", i + 4, *rotmat_to_quat(pose[None, :3, :3])[0], *pose[:3, 3], 7)
        data += name.encode() + b"\0" + struct.pack("<Q", i) + struct.pack("<ddq", 1.0, 2.0, -1) * i
    (folder / "images.bin").write_bytes(data)
    (folder / "rigs.bin").write_bytes(b"rigs")
    (folder / "frames.bin").write_bytes(b"frames")


def write_inria(path: Path, tiny: Tiny) -> None:
    K = tiny.K
    entries = [
        {
            "id": i,
            "img_name": Path(name).stem,
            "width": tiny.width,
            "height": tiny.height,
            "position": pose[:3, 3].tolist(),
            "rotation": pose[:3, :3].tolist(),
            "fy": K[1, 1],
            "fx": K[0, 0],
        }
        for i, (name, pose) in enumerate(zip(tiny.names, tiny.c2w, strict=True))
    ]
    path.write_text(json.dumps(entries))


def write_npz(path: Path, tiny: Tiny, **changes: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    arrays = {
        "extrinsics": tiny.w2c[:, :3].astype(np.float32),
        "intrinsics": np.tile(tiny.K, (len(tiny.c2w), 1, 1)).astype(np.float32),
        "depth": np.ones((len(tiny.c2w), tiny.height, tiny.width), np.float32),
        "image": tiny.images,
    }
    np.savez(path, **{k: v for k, v in (arrays | changes).items() if v is not None})


def assert_same(actual: CameraFile, tiny: Tiny, *, K: np.ndarray | None = None, atol: float = 1e-9) -> None:
    assert actual.viewmats.dtype == actual.Ks.dtype == np.float64
    assert np.allclose(actual.viewmats, tiny.w2c, atol=atol)
    assert np.allclose(actual.Ks, tiny.K if K is None else K, atol=atol * 100)
    assert actual.widths.tolist() == [tiny.width] * 3
    assert actual.heights.tolist() == [tiny.height] * 3
    assert len(actual) == 3


def save_json(path: Path, data: object) -> Path:
    path.write_text(json.dumps(data))
    return path


@contextmanager
def edited_json(path: Path) -> Iterator[Any]:
    """Yield the content of a file, and write it again after the block."""
    data = json.loads(path.read_text())
    yield data
    path.write_text(json.dumps(data))
