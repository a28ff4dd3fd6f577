"""Write a capture as feed-forward backbones write their scenes: a Gaussian for each pixel of its context views.

python benchmarks/capture_exports.py SCENE OUT                    # plain: all pixels, view by view
python benchmarks/capture_exports.py SCENE OUT --style anysplat   # or da3, depthsplat

Depth, confidence and colour are the capture's (docs/internals/captures.md); scales, rotations, opacities and offsets,
which its depth network does not predict, follow from them with jitter. A seed gives the same bytes every time.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from gsmerge.geometry import quat_to_rotmat, rgb_to_sh0, rotmat_to_quat

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])  # OpenGL camera axes <-> OpenCV camera axes
BORDER = 8  # pixels that da3 (of 256) and depthsplat leave out
Rows = dict[str, np.ndarray]  # of Gaussians: means, quats, scales, opacities, sh0, of the same length


def read_scene(folder: Path, max_views: int | None = None) -> list[dict[str, Any]]:
    """Context views: image ``[h,w,3]`` 0 to 1, depth along z and conf ``[h,w]``, K ``[3,3]``, c2w ``[4,4]`` OpenCV."""
    frames = [f for f in json.loads((folder / "transforms.json").read_text())["frames"] if f["role"] == "context"]
    if max_views and max_views < len(frames):
        frames = [frames[i] for i in np.linspace(0, len(frames) - 1, max_views).round().astype(int)]
    return [_read_view(folder, frame) for frame in frames]


def _read_view(folder: Path, frame: dict[str, Any]) -> dict[str, Any]:
    steps = cv2.imread(str(folder / frame["depth_path"]), cv2.IMREAD_UNCHANGED) / 65535
    near, far = frame["depth_near"], frame["depth_far"]
    return {
        "name": Path(frame["file_path"]).name,
        "image": cv2.imread(str(folder / frame["file_path"]))[..., ::-1] / 255,
        "depth": 1 / (steps * (1 / near - 1 / far) + 1 / far),
        "conf": cv2.imread(str(folder / frame["confidence_path"]), cv2.IMREAD_GRAYSCALE) / 255,
        "K": np.array([[frame["fl_x"], 0, frame["cx"]], [0, frame["fl_y"], frame["cy"]], [0, 0, 1]]),
        "c2w": np.array(frame["transform_matrix"]) @ FLIP,
    }


def view_gaussians(view: dict[str, Any], rng: np.random.Generator) -> Rows:
    """A view's Gaussians, row by row of its pixels: thin discs in the surface, in the world's frame."""
    (height, width), K, c2w = view["depth"].shape, view["K"], view["c2w"]
    count = height * width
    z = view["depth"] * np.exp(rng.normal(0, 0.002, (height, width)))
    x = np.arange(width) + 0.5 + rng.uniform(-0.25, 0.25, (height, width))
    y = np.arange(height)[:, None] + 0.5 + rng.uniform(-0.25, 0.25, (height, width))
    points = np.stack([(x - K[0, 2]) / K[0, 0] * z, (y - K[1, 2]) / K[1, 1] * z, z], -1)
    axes = (c2w[:3, :3] @ _surface_frames(points)).reshape(-1, 3, 3)
    jitter = np.exp(rng.normal(0, 0.25, (count, 3)))
    scales = (z / K[0, 0]).reshape(-1, 1) * np.array([0.75, 0.75, 0.25]) * jitter
    oversized = rng.random(count) < 0.003  # every backbone makes a few far too large ones
    scales[oversized] *= rng.uniform(3, 10, (oversized.sum(), 1))
    opacities = 0.25 + 0.7 * view["conf"].reshape(-1) + rng.normal(0, 0.05, count)
    rgb = (view["image"].reshape(-1, 3) + rng.normal(0, 0.01, (count, 3))).clip(0, 1)
    means = points.reshape(-1, 3) @ c2w[:3, :3].T + c2w[:3, 3]
    quats = _positive_first(rotmat_to_quat(axes))
    return {
        "means": means,
        "quats": quats,
        "scales": scales,
        "opacities": opacities.clip(0.02, 0.995),
        "sh0": rgb_to_sh0(rgb),
    }


def _surface_frames(points: np.ndarray) -> np.ndarray:
    """Axes ``[h,w,3,3]`` as columns, the last normal to the smoothed surface, or along the ray where steep."""
    smooth = cv2.GaussianBlur(points, (0, 0), 1.5)
    normals = _normalized(np.cross(np.gradient(smooth, axis=1), np.gradient(smooth, axis=0)))
    rays = points / np.linalg.norm(points, axis=-1, keepdims=True)
    steep = np.abs((normals * rays).sum(-1)) < 0.25
    normals[steep] = rays[steep]
    first = _normalized(np.cross(np.broadcast_to([0.0, 1.0, 0.0], normals.shape), normals))
    return np.stack([first, np.cross(normals, first), normals], -1)


def _normalized(vectors: np.ndarray) -> np.ndarray:
    return vectors / (np.linalg.norm(vectors, axis=-1, keepdims=True) + 1e-12)


def _positive_first(quats: np.ndarray) -> np.ndarray:
    return quats * np.where(quats[:, :1] < 0, -1, 1)


def take(rows: Rows, index: np.ndarray) -> Rows:
    return {name: values[index] for name, values in rows.items()}


def concat(parts: Sequence[Rows]) -> Rows:
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def rotate_world(rows: Rows, rotation: np.ndarray) -> Rows:
    quats = _positive_first(rotmat_to_quat(rotation @ quat_to_rotmat(rows["quats"])))
    return {**rows, "means": rows["means"] @ rotation.T, "quats": quats}


def voxel_merge(rows: Rows, size: float) -> Rows:
    """The means of each voxel by opacity, in the order of voxels."""
    keys = np.floor(rows["means"] / size).astype(np.int64)
    _, firsts, voxels = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    voxels, weights = voxels.reshape(-1), rows["opacities"]
    total = np.bincount(voxels, weights)
    signs = np.sign((rows["quats"] * rows["quats"][firsts][voxels]).sum(1, keepdims=True) + 1e-12)
    values = {**rows, "quats": rows["quats"] * signs, "opacities": weights[:, None]}
    merged = {
        name: np.stack([np.bincount(voxels, weights * column) for column in array.T], 1) / total[:, None]
        for name, array in values.items()
    }
    merged["quats"] /= np.linalg.norm(merged["quats"], axis=1, keepdims=True)
    return merged | {"opacities": merged["opacities"][:, 0].clip(0, 1)}


def ply_header(count: int, harmonics: int = 0) -> bytes:
    """The header of a ``.ply`` of so many rows, with so many columns of higher harmonics."""
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", *(f"f_rest_{i}" for i in range(harmonics))]
    names += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    return "\n".join([*lines, *(f"property float {name}" for name in names), "end_header", ""]).encode()


def ply_rows(rows: Rows, harmonics: np.ndarray | None = None, *, logits: bool = True) -> bytes:
    """Rows of a ``.ply``; opacities as logits or as they are."""
    opacities = rows["opacities"][:, None]
    opacities = np.log(opacities / (1 - opacities)) if logits else opacities
    more = np.zeros((len(opacities), 0)) if harmonics is None else harmonics
    zeros = np.zeros_like(rows["means"])
    columns = [rows["means"], zeros, rows["sh0"], more, opacities, np.log(rows["scales"]), rows["quats"]]
    return np.concatenate(columns, 1).astype("<f4").tobytes()


def write_ply(path: Path, rows: Rows, *, logits: bool = True) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(ply_header(len(rows["means"])) + ply_rows(rows, logits=logits))
    return path


def write_views(out: Path, views: Sequence[dict[str, Any]]) -> None:
    """Photos and ``transforms.json`` of views."""
    (out / "images").mkdir(parents=True, exist_ok=True)
    for view in views:
        photo = np.round(view["image"][..., ::-1] * 255).astype(np.uint8)
        cv2.imwrite(str(out / "images" / view["name"]), photo, [cv2.IMWRITE_JPEG_QUALITY, 97])
    frames = [frame_of(f"images/{v['name']}", v["K"], v["c2w"], v["depth"].shape) for v in views]
    (out / "transforms.json").write_text(json.dumps({"camera_model": "PINHOLE", "frames": frames}, indent=1))


def frame_of(path: str, K: np.ndarray, c2w: np.ndarray, shape: Sequence[int]) -> dict[str, Any]:
    """A frame of ``transforms.json`` of an OpenCV pose ``[4,4]`` and a shape (height, width)."""
    head = {"file_path": path, "w": shape[1], "h": shape[0]}
    values = {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
    return {**head, **{name: float(v) for name, v in values.items()}, "transform_matrix": (c2w @ FLIP).tolist()}


def export(scene: Path, out: Path, style: str = "plain", max_views: int | None = None, nested: float = 1.0) -> Path:
    """Write a capture in a backbone's style, and return its ``.ply``; ``nested``: da3's cameras are so much larger."""
    rng, views = np.random.default_rng(0), read_scene(scene, max_views)
    parts = [view_gaussians(view, rng) for view in views]
    return STYLES[style](out, views, parts, nested)


def _plain(out: Path, views: list[dict[str, Any]], parts: list[Rows], nested: float) -> Path:
    write_views(out, views)
    return write_ply(out / "scene.ply", concat(parts))


def _da3(out: Path, views: list[dict[str, Any]], parts: list[Rows], nested: float) -> Path:
    """Without borders and the farthest tenth; cameras and depth as arrays."""
    kept, (height, width) = [], views[0]["depth"].shape
    top, left = int(BORDER / 256 * height), int(BORDER / 256 * width)
    for view, rows in zip(views, parts, strict=True):
        mask = np.zeros((height, width), bool)
        mask[top : height - top, left : width - left] = True
        kept.append(take(rows, (mask & (view["depth"] <= np.quantile(view["depth"], 0.9))).reshape(-1)))
    poses = np.stack([np.linalg.inv(view["c2w"])[:3] for view in views]).astype(np.float32)
    poses[:, :, 3] *= nested
    depth = np.stack([view["depth"] * nested for view in views]).astype(np.float32).round(6)
    Ks, conf = (np.stack([view[name] for view in views]).astype(np.float32) for name in ("K", "conf"))
    images = np.stack([np.round(view["image"] * 255) for view in views]).astype(np.uint8)
    place = out / "exports" / "npz"
    place.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(place / "results.npz", extrinsics=poses, intrinsics=Ks, depth=depth, conf=conf, image=images)
    return write_ply(out / "gs_ply" / "0000.ply", concat(kept))


def _depthsplat(out: Path, views: list[dict[str, Any]], parts: list[Rows], nested: float) -> Path:
    """Without borders, the view running fastest, turned by the first camera."""
    inner = np.arange(views[0]["depth"].size).reshape(views[0]["depth"].shape)[BORDER:-BORDER, BORDER:-BORDER]
    order = (np.arange(len(parts)) * views[0]["depth"].size + inner.reshape(-1, 1)).reshape(-1)
    write_views(out, views)
    return write_ply(out / "gaussians.ply", rotate_world(take(concat(parts), order), views[0]["c2w"][:3, :3].T))


def _anysplat(out: Path, views: list[dict[str, Any]], parts: list[Rows], nested: float) -> Path:
    """In voxels of the median pixel's size, opacities as they are."""
    size = np.median([np.median(view["depth"]) / view["K"][0, 0] for view in views])
    write_views(out, views)
    return write_ply(out / "gaussians.ply", voxel_merge(concat(parts), size), logits=False)


STYLES = {"plain": _plain, "da3": _da3, "depthsplat": _depthsplat, "anysplat": _anysplat}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("scene", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--style", choices=STYLES, default="plain")
    parser.add_argument("--views", type=int, help="use this many context views, evenly spaced")
    parser.add_argument("--nested", type=float, default=1.0, help="da3: cameras are so much larger than the Gaussians")
    args = parser.parse_args()
    print(export(args.scene, args.out, args.style, args.views, args.nested))


if __name__ == "__main__":
    import one_line_errors  # noqa: F401

    main()
