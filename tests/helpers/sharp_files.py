"""SHARP saves files of one photo each, two layers of Gaussians on a square grid, and the camera inside."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from plyfile import PlyData, PlyElement

from gsmerge import Scene
from gsmerge.method.geometry.transforms import multiply_quats, rotmat_to_quat
from gsmerge.method.kernels import elementary
from gsmerge.method.kernels.matrices import matmul
from gsmerge.types import Cameras, Gaussians

COLUMNS = ["x", "y", "z", *(f"f_dc_{i}" for i in range(3)), "opacity", *(f"scale_{i}" for i in range(3)),
           *(f"rot_{i}" for i in range(4))]  # fmt: skip


def split_views(scene: Scene, scales: Sequence[float]) -> list[Scene]:
    """Return every view of an aligned scene as a scene of its own, in its camera's frame and a unit of its own."""
    size, parts = scene.pixels_per_view, []
    for view, (scale, viewmat) in enumerate(zip(scales, scene.cameras.viewmats, strict=True)):
        g = scene.gaussians[view * size : (view + 1) * size]
        turn, shift = viewmat[:3, :3], viewmat[:3, 3]
        own = replace(
            g,
            means=(scale * (matmul(g.means, turn.T) + shift)).astype(np.float32),
            quats=multiply_quats(rotmat_to_quat(turn[None])[0], g.quats).astype(np.float32),
            scales=(scale * g.scales).astype(np.float32),
        )
        cameras = Cameras(np.eye(4)[None], scene.cameras.Ks[[view]], scene.cameras.width, scene.cameras.height)
        pixels = scene.pixels.select([view])[1]
        parts.append(Scene(own, cameras, scene.images[[view]], pixels, (scene.names[view],)))
    return parts


def write_sharp(path: Path, view: Scene, photo_size: tuple[int, int], photo: Path | None = None) -> None:
    """Write a scene of one view, in its camera's frame, on a square grid of the view's height."""
    side, width = view.cameras.height, view.cameras.width
    columns = ((np.arange(side) + 0.5) * width / side).astype(int)
    front = view.gaussians[(np.arange(side)[:, None] * width + columns).reshape(-1)]
    back = replace(front, means=1.1 * front.means, opacities=np.full(len(front), 0.1, np.float32))
    g = Gaussians.concat([front, back])
    values = [
        g.means,
        g.sh0[:, 0],
        elementary.log(g.opacities / (1 - g.opacities))[:, None],
        elementary.log(g.scales),
        g.quats,
    ]
    rows = np.zeros(len(g), [(name, "f4") for name in COLUMNS])
    for name, column in zip(COLUMNS, np.concatenate(values, 1).T, strict=True):
        rows[name] = column
    focal = view.cameras.Ks[0, 0, 0] * photo_size[0] / width
    K = [focal, 0, photo_size[0] / 2, 0, focal, photo_size[1] / 2, 0, 0, 1]
    write_elements(path, rows, np.eye(4).reshape(-1), K, photo_size)
    if photo is not None:
        image = (view.images[0][..., ::-1] * 255).round().astype(np.uint8)
        cv2.imwrite(str(photo), cv2.resize(image, photo_size))


def write_elements(
    path: Path, rows: np.ndarray, extrinsic: Sequence[float], intrinsic: Sequence[float],
    size: Sequence[int] | None,
) -> None:  # fmt: skip
    """Write rows with SHARP's elements, in its order; ``size`` None: as its first versions did, without it."""
    parts = {
        "extrinsic": ("f4", extrinsic), "intrinsic": ("f4", intrinsic), "image_size": ("u4", size),
        "frame": ("i4", (1, len(rows))), "disparity": ("f4", (0.1, 0.9)), "color_space": ("u1", (0,)),
        "version": ("u1", (1, 5, 0)),
    }  # fmt: skip
    elements = [PlyElement.describe(rows, "vertex")]
    elements += [PlyElement.describe(np.array([(v,) for v in values], [(name, kind)]), name)
                 for name, (kind, values) in parts.items() if values is not None]  # fmt: skip
    PlyData(elements, byte_order="<").write(str(path))
