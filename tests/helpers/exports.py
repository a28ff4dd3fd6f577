"""Exports of made scenes have rows as exporters write them, before any reader has touched them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from plyfile import PlyData, PlyElement
from tiny_scene import Tiny, make_tiny, rotation, write_images, write_transforms

from gsmerge.method.geometry.transforms import quat_to_rotmat, rotmat_to_quat
from gsmerge.method.kernels import elementary
from gsmerge.method.kernels.matrices import invert, matmul
from gsmerge.method.kernels.pictures import blur
from gsmerge.types import SH_C0, Scene


@dataclass(frozen=True)
class Smooth(Tiny):
    """A tiny scene of a smooth surface, with its depth maps ``[3,h,w]``."""

    depths: np.ndarray


def smooth_scene(width: int, height: int, K: np.ndarray | None = None) -> Smooth:
    """Return three views of a smooth, coloured surface, jitter a quarter of a pixel; K None: oblong pixels."""
    tiny, rng = make_tiny(width, height), np.random.default_rng(5)
    K = tiny.K if K is None else K
    y, x = np.mgrid[:height, :width]
    c2w = tiny.c2w.copy()
    means, depths, images = [], [], []
    for i in range(3):
        c2w[i, :3, :3] = rotation(0.02 * i + 0.1, 0.2 - 0.2 * i, 0.05 * i)
        c2w[i, :3, 3] = (0.6 * i - 0.6, 0.2 * i + 0.1, -0.2 * i - 1.5)
        depth = 3 + 0.5 * elementary.sin(x / 9 + i) * elementary.cos(y / 7) + 1e-4 * rng.random((height, width))
        u, v = (x + 0.5 + rng.uniform(-0.2, 0.2, x.shape), y + 0.5 + rng.uniform(-0.2, 0.2, x.shape))
        camera = np.stack([(u - K[0, 2]) / K[0, 0] * depth, (v - K[1, 2]) / K[1, 1] * depth, depth], -1)
        world = matmul(camera.reshape(-1, 3), c2w[i, :3, :3].T) + c2w[i, :3, 3]
        colors = 0.5 + 0.4 * elementary.sin(2.5 * world + np.array([0, 1, 2]))
        means.append(world)
        depths.append(depth)
        images.append((colors * 255).round().astype(np.uint8).reshape(height, width, 3))
    n = 3 * width * height
    gaussians = replace(
        tiny.gaussians,
        means=np.concatenate(means).astype(np.float32),
        scales=np.full((n, 3), 0.03, np.float32),
        sh0=((np.stack(images).reshape(n, 1, 3) / 255.0).astype(np.float32) - 0.5) / SH_C0,
    )
    return Smooth(c2w, K, width, height, np.stack(images), gaussians, tiny.names, np.stack(depths))


def with_intrinsics(tiny: Smooth, K: np.ndarray) -> Smooth:
    """Return the same pixels and depths, seen through another lens."""
    means = []
    for pose, points in zip(tiny.c2w, tiny.gaussians.means.astype(np.float64).reshape(3, -1, 3), strict=True):
        camera = matmul((points - pose[:3, 3]), pose[:3, :3])
        rays = matmul(matmul(camera, tiny.K.T), invert(K).T)
        means.append(matmul(rays, pose[:3, :3].T) + pose[:3, 3])
    moved = np.concatenate(means).astype(np.float32)
    return replace(tiny, K=K, gaussians=replace(tiny.gaussians, means=moved))


def depth_map_mask(depth: np.ndarray) -> np.ndarray:
    """Return what Depth Anything 3 keeps of a view: its own rule, in its own words."""
    height, width = depth.shape
    mask = np.zeros((height, width), bool)
    top, left = int(8 / 256 * height), int(8 / 256 * width)
    mask[top : height - top, left : width - left] = True
    return mask & (depth <= np.quantile(depth, 0.9))


def export_rows(tiny: Tiny, index: np.ndarray | None = None, rest: int = 0, normals: str = "f4") -> np.ndarray:
    """Return the scene's Gaussians, those of ``index`` in its order, as the 17 columns of nearly all exporters."""
    g = tiny.gaussians if index is None else tiny.gaussians[np.ascontiguousarray(index)]
    names = ["x", "y", "z", "nx", "ny", "nz", *(f"f_dc_{i}" for i in range(3)), *(f"f_rest_{i}" for i in range(rest)),
             "opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]  # fmt: skip
    names = [name for name in names if normals or name[0] != "n"]
    rows = np.zeros(len(g), [(name, normals if name[0] == "n" else "f4") for name in names])
    columns: dict[str, Any] = {"opacity": elementary.log(g.opacities / (1 - g.opacities))}
    columns |= {name: g.means[:, i] for i, name in enumerate("xyz")}
    columns |= {f"f_dc_{i}": g.sh0[:, 0, i] for i in range(3)}
    columns |= {f"scale_{i}": elementary.log(g.scales[:, i]) for i in range(3)}
    columns |= {f"rot_{i}": g.quats[:, i] for i in range(4)}
    for name, values in columns.items():
        rows[name] = values
    return rows


def turned(rows: np.ndarray, turn: np.ndarray, *, scale: float = 1.0, shift: np.ndarray | None = None) -> np.ndarray:
    """Return the rows in another world: ``scale * turn @ x + shift``."""
    out = rows.copy()
    means = matmul(scale * np.stack([rows[c] for c in "xyz"], 1), turn.T) + (0 if shift is None else shift)
    for i, name in enumerate("xyz"):
        out[name] = means[:, i]
        out[f"scale_{i}"] = rows[f"scale_{i}"] + elementary.log(scale)
    quats = np.stack([rows[f"rot_{i}"] for i in range(4)], 1)
    moved = rotmat_to_quat(matmul(turn, quat_to_rotmat(quats).astype(np.float64)))
    for i in range(4):
        out[f"rot_{i}"] = moved[:, i]
    return out


def with_surface_rotations(tiny: Tiny) -> Tiny:
    """Return discs that lie in the surface."""
    h, w = tiny.height, tiny.width
    grid = tiny.gaussians.means.astype(np.float64).reshape(-1, h, w, 3)
    across, down = np.gradient(grid, axis=2), np.gradient(grid, axis=1)
    across = np.stack([blur(a, 2.0) for a in across])
    down = np.stack([blur(a, 2.0) for a in down])
    normal = np.cross(across, down)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    first = across - (across * normal).sum(-1, keepdims=True) * normal
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    frames = np.stack([first, np.cross(normal, first), normal], -1)
    quats = rotmat_to_quat(frames.reshape(-1, 3, 3)).astype(np.float32)
    scales = np.tile(np.array([0.04, 0.03, 0.005], np.float32), (len(quats), 1))
    return replace(tiny, gaussians=replace(tiny.gaussians, quats=quats, scales=scales))


def save_export(folder: Path, tiny: Tiny, rows: np.ndarray, *, cameras: bool = True, name: str = "scene.ply") -> Path:
    """Write the rows with cameras and photos beside them; returns the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    PlyData([PlyElement.describe(rows, "vertex")], byte_order="<").write(str(folder / name))
    if cameras:
        write_transforms(folder / "transforms.json", tiny)
        write_images(folder / "images", tiny)
    return folder


def home(scene: Scene, tiny: Tiny, kept: np.ndarray | None = None) -> float:
    """Return the share of the stored (or kept) pixels whose Gaussian was made for them, known by its opacity."""
    same = np.abs(of_pixels(scene, "opacities") - tiny.gaussians.opacities) < 1e-5
    return float(same[scene.pixels.shown.reshape(-1) if kept is None else kept].mean())


def of_pixels(scene: Scene, name: str) -> np.ndarray:
    """Return a column of the Gaussian in front of each pixel, over all views; 0 where there is none."""
    values = getattr(scene.gaussians, name)[scene.pixels.fronts.reshape(-1)].copy()
    values[~scene.pixels.shown.reshape(-1)] = 0
    return values


def da3_rows(tiny: Smooth, depths: np.ndarray | None = None) -> np.ndarray:
    """Return rows of the pixels that Depth Anything 3 keeps, by these or the scene's own depth maps."""
    maps = tiny.depths if depths is None else depths
    return np.concatenate([np.flatnonzero(depth_map_mask(d)) + i * d.size for i, d in enumerate(maps)])
