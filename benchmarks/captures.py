"""Export captures as feed-forward backbones would, and read and score their held-out views, for all benchmarks.

python benchmarks/captures.py SCENE OUT                    # plain: a Gaussian for each pixel, view by view
python benchmarks/captures.py SCENE OUT --style anysplat   # or da3, depthsplat

Captures (docs/internals/stability.md) are in ``scenes/train`` and ``scenes/eval`` below ``GSMERGE_DATA``, or else below
``../shared``. An export has the capture's depth, confidence and colour. Its scales, rotations, opacities and offsets,
which the depth network does not predict, follow from these with jitter. The bytes are the same every time. The other
benchmarks import this file.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import resource
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

import gsmerge
from gsmerge.method.geometry.transforms import quat_to_rotmat, rgb_to_sh0, rotmat_to_quat
from gsmerge.method.raster.metrics import psnr, ssim
from gsmerge.scoring.lpips import INSTALL, lpips, lpips_available
from gsmerge.types import Cameras, Gaussians

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])  # OpenGL camera axes <-> OpenCV camera axes
BORDER = 8  # pixels that da3 (of 256) and depthsplat leave out
LPIPS_VIEWS = 4  # most target views of a scene on which LPIPS is measured, at equal intervals
CAPTURES = "docs/internals/stability.md says how captures are made, and which files are not public"
Rows = dict[str, np.ndarray]  # columns of Gaussians by name: means, quats, scales, opacities, sh0
Record = dict[str, Any]


def make_parser(text: str, scenes: str = "eval") -> argparse.ArgumentParser:
    """Make a parser with arguments for the captures to measure, and for the folder of exports and finished runs."""
    parser = argparse.ArgumentParser(description=text, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="?", default=scenes, help="train, eval, or names, with commas between")
    cache = Path(tempfile.gettempdir()) / "gsmerge-benchmarks"
    parser.add_argument("--cache", type=lambda text: Path(text).resolve(), default=cache, help="exports and runs")
    return parser


def scene_folders(text: str) -> list[Path]:
    """Find the folders of captures, which are named by ``train``, ``eval`` or their names; leave out missing ones."""
    root = Path(os.environ.get("GSMERGE_DATA", Path(__file__).parents[2] / "shared"))
    known = {path.name: path for path in sorted(root.glob("scenes/*/*")) if path.is_dir()}
    folders: list[Path] = []
    for name in text.split(","):
        matches = [path for path in known.values() if name in (path.name, path.parent.name)]
        folders += matches
        if not matches:
            print(f"{name} is left out, because it is not below {root}; {CAPTURES}", file=sys.stderr)
    if not folders:
        raise SystemExit(f"expected captures below GSMERGE_DATA, found none; {CAPTURES}")
    return folders


def export_capture(scene: Path, cache: Path, style: str = "plain") -> Path:
    """Return the ``.ply`` of a capture in a style; it is written into ``cache`` unless it is there."""
    out = cache / f"{scene.name}-{style}"
    if not (out / "done").exists():
        write_export(scene, out, style)
        (out / "done").touch()
    return next(out.rglob("*.ply"))


@dataclass(frozen=True)
class Targets:
    """Held-out photos: ``images [t,h,w,3]``, cameras, and the paper's visibility masks ``[t,h,w]`` (supplement A)."""

    images: np.ndarray
    cameras: Cameras
    masks: np.ndarray


def read_held_out(scene: Path) -> Targets:
    """Read the target views of a capture; a pixel is visible if a point of a context view falls on it or next to it."""
    frames = [f for f in json.loads((scene / "transforms.json").read_text())["frames"] if f["role"] == "target"]
    images = [cv2.imread(str(scene / f["file_path"]))[..., ::-1].astype(np.float32) / 255 for f in frames]
    viewmats = np.stack([np.linalg.inv(np.array(f["transform_matrix"]) @ FLIP) for f in frames])
    Ks = np.array([[[f["fl_x"], 0, f["cx"]], [0, f["fl_y"], f["cy"]], [0, 0, 1]] for f in frames])
    points = np.concatenate([_context_points(view) for view in read_context(scene)])
    height, width = images[0].shape[:2]
    masks = np.stack([_visible_mask(points, w2c, K, height, width) for w2c, K in zip(viewmats, Ks, strict=True)])
    return Targets(np.stack(images), Cameras(viewmats, Ks, width, height), masks)


def _context_points(view: dict[str, Any]) -> np.ndarray:
    """Return the world point ``[n,3]`` of each pixel of a view by its depth."""
    height, width = view["depth"].shape
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rays = np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(view["K"]).T
    return (rays * view["depth"][..., None]).reshape(-1, 3) @ view["c2w"][:3, :3].T + view["c2w"][:3, 3]


def _visible_mask(points: np.ndarray, w2c: np.ndarray, K: np.ndarray, height: int, width: int) -> np.ndarray:
    """Return the mask ``[h,w]`` of a camera's pixels on which points fall, and of their neighbours."""
    camera = points @ w2c[:3, :3].T + w2c[:3, 3]
    image = camera[camera[:, 2] > 1e-6] @ K.T
    x, y = np.floor(image[:, :2] / image[:, 2:]).astype(int).T
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    hit = np.zeros((height, width), np.uint8)
    hit[y[inside], x[inside]] = 1
    return cv2.dilate(hit, np.ones((3, 3), np.uint8)) > 0


def score(gaussians: Gaussians, targets: Targets, perceptual: bool = False) -> tuple[float, ...]:
    """Return the mean PSNR (dB) and SSIM over the visible pixels of all target views.

    With ``perceptual``, LPIPS (VGG) over some of the views is the third score.
    """
    images = gsmerge.render(gaussians, targets.cameras).images.clip(0, 1)
    triples = zip(images, targets.images, targets.masks, strict=True)
    means = tuple(map(float, np.mean([(psnr(a, b, mask), ssim(a, b, mask)) for a, b, mask in triples], 0)))
    if not perceptual:
        return means
    chosen = range(0, len(images), math.ceil(len(images) / LPIPS_VIEWS))
    return *means, float(np.mean([lpips(images[i], targets.images[i], "vgg", targets.masks[i]) for i in chosen]))


def require_lpips() -> None:
    """Stop if LPIPS has no weights."""
    if not lpips_available("vgg"):
        raise SystemExit(f"LPIPS needs weights: {INSTALL}")


class Records:
    """Finished measurements in a file, one JSON line each, so that an interrupted benchmark can continue."""

    def __init__(self, path: Path) -> None:
        self.path = path
        path.parent.mkdir(parents=True, exist_ok=True)
        self.rows = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []

    def get(self, key: Mapping[str, Any], measure: Callable[[], Mapping[str, Any]]) -> Record:
        """Return the record with a key; if there is none, measure now, and store the key with the measurement."""
        for row in self.rows:
            if key.items() <= row.items():
                return row
        self.rows.append({**key, **measure()})
        line = json.dumps(self.rows[-1])
        print(line, file=sys.stderr, flush=True)
        with self.path.open("a") as file:
            file.write(f"{line}\n")
        return self.rows[-1]


def mean_of(records: Sequence[Mapping[str, Any]], name: str) -> float:
    """Average a number over the records that have it; NaN if none has it."""
    return float(np.mean([record[name] for record in records if name in record] or [np.nan]))


def run_command(call: Sequence[str], tree: Path | None = None, threads: int | None = None) -> tuple[float, bytes]:
    """Run a command; return its processor seconds and its output. ``tree`` is the checkout whose package it uses."""
    env = dict(os.environ)
    env |= {"PYTHONPATH": str(tree.resolve())} if tree else {}
    env |= {"GSMERGE_THREADS": str(threads)} if threads else {}
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(call, check=True, stdout=subprocess.PIPE, env=env, cwd=tempfile.gettempdir())
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, done.stdout


def make_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Format a table in Markdown."""
    lines = [head, ["---", *["---:"] * (len(head) - 1)], *rows]
    return "\n".join(f"|{'|'.join(line)}|" for line in lines)


def parse_setting(text: str) -> tuple[str, object]:
    """Parse a setting NAME=VALUE of compact, whose value is JSON or text, and return name and value."""
    name, value = text.split("=", 1)
    try:
        return name, json.loads(value)
    except json.JSONDecodeError:
        return name, value


def read_context(folder: Path, max_views: int | None = None) -> list[dict[str, Any]]:
    """Read a capture's context views, at most ``max_views`` of them.

    A view has ``name``, ``image [h,w,3]`` in [0, 1], ``depth [h,w]`` along z, ``conf [h,w]`` (confidence), ``K [3,3]``
    and ``c2w [4,4]`` with OpenCV axes.
    """
    frames = [f for f in json.loads((folder / "transforms.json").read_text())["frames"] if f["role"] == "context"]
    if max_views and max_views < len(frames):
        frames = [frames[i] for i in np.linspace(0, len(frames) - 1, max_views).round().astype(int)]
    return [_read_context_view(folder, frame) for frame in frames]


def _read_context_view(folder: Path, frame: dict[str, Any]) -> dict[str, Any]:
    """Read one context view; its depth is stored as a share of the range of inverse depths."""
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
    """Make a Gaussian for each pixel of a view, in row-major order: thin discs on the surface, in the world's frame."""
    (height, width), K, c2w = view["depth"].shape, view["K"], view["c2w"]
    count = height * width
    z = view["depth"] * np.exp(rng.normal(0, 0.002, (height, width)))
    x = np.arange(width) + 0.5 + rng.uniform(-0.25, 0.25, (height, width))
    y = np.arange(height)[:, None] + 0.5 + rng.uniform(-0.25, 0.25, (height, width))
    points = np.stack([(x - K[0, 2]) / K[0, 0] * z, (y - K[1, 2]) / K[1, 1] * z, z], -1)
    axes = (c2w[:3, :3] @ _surface_frames(points)).reshape(-1, 3, 3)
    jitter = np.exp(rng.normal(0, 0.25, (count, 3)))
    scales = (z / K[0, 0]).reshape(-1, 1) * np.array([0.75, 0.75, 0.25]) * jitter
    oversized = rng.random(count) < 0.003  # every backbone makes a few Gaussians that are far too large
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
    """Compute axes ``[h,w,3,3]`` as columns; the last one is the surface's normal, or the ray on steep surfaces."""
    smooth = cv2.GaussianBlur(points, (0, 0), 1.5)
    normals = _normalized(np.cross(np.gradient(smooth, axis=1), np.gradient(smooth, axis=0)))
    rays = points / np.linalg.norm(points, axis=-1, keepdims=True)
    steep = np.abs((normals * rays).sum(-1)) < 0.25
    normals[steep] = rays[steep]
    first = _normalized(np.cross(np.broadcast_to([0.0, 1.0, 0.0], normals.shape), normals))
    return np.stack([first, np.cross(normals, first), normals], -1)


def _normalized(vectors: np.ndarray) -> np.ndarray:
    """Scale vectors to unit length."""
    return vectors / (np.linalg.norm(vectors, axis=-1, keepdims=True) + 1e-12)


def _positive_first(quats: np.ndarray) -> np.ndarray:
    """Change signs of quaternions so that their first number is not negative."""
    return quats * np.where(quats[:, :1] < 0, -1, 1)


def take_rows(rows: Rows, index: np.ndarray) -> Rows:
    """Select rows of all columns."""
    return {name: values[index] for name, values in rows.items()}


def concat_rows(parts: Sequence[Rows]) -> Rows:
    """Join the rows of several parts."""
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def rotate_world(rows: Rows, rotation: np.ndarray) -> Rows:
    """Rotate Gaussians about the origin of the world."""
    quats = _positive_first(rotmat_to_quat(rotation @ quat_to_rotmat(rows["quats"])))
    return {**rows, "means": rows["means"] @ rotation.T, "quats": quats}


def merge_voxels(rows: Rows, size: float) -> Rows:
    """Average the Gaussians of each voxel, weighted by opacity; voxels are in ascending order."""
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


def write_ply(path: Path, rows: Rows, *, logits: bool = True) -> Path:
    """Write rows to a ``.ply``, with opacities as logits or as they are; return its path."""
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"]
    names += ["scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows['means'])}"]
    header = "\n".join([*lines, *(f"property float {name}" for name in names), "end_header", ""]).encode()
    opacities = rows["opacities"][:, None]
    opacities = np.log(opacities / (1 - opacities)) if logits else opacities
    columns = [rows["means"], np.zeros_like(rows["means"]), rows["sh0"], opacities, np.log(rows["scales"])]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(header + np.concatenate([*columns, rows["quats"]], 1).astype("<f4").tobytes())
    return path


def write_views(out: Path, views: Sequence[dict[str, Any]]) -> None:
    """Write the photos and the ``transforms.json`` of views."""
    (out / "images").mkdir(parents=True, exist_ok=True)
    for view in views:
        photo = np.round(view["image"][..., ::-1] * 255).astype(np.uint8)
        cv2.imwrite(str(out / "images" / view["name"]), photo, [cv2.IMWRITE_JPEG_QUALITY, 97])
    frames = [make_frame(f"images/{v['name']}", v["K"], v["c2w"], v["depth"].shape) for v in views]
    (out / "transforms.json").write_text(json.dumps({"camera_model": "PINHOLE", "frames": frames}, indent=1))


def make_frame(path: str, K: np.ndarray, c2w: np.ndarray, shape: Sequence[int]) -> dict[str, Any]:
    """Make a frame of ``transforms.json`` from an OpenCV pose ``[4,4]`` and a shape (height, width)."""
    head = {"file_path": path, "w": shape[1], "h": shape[0]}
    values = {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
    return {**head, **{name: float(v) for name, v in values.items()}, "transform_matrix": (c2w @ FLIP).tolist()}


def write_export(
    scene: Path, out: Path, style: str = "plain", max_views: int | None = None, nested: float = 1.0
) -> Path:
    """Export a capture in a backbone's style, and return its ``.ply``.

    ``nested`` is the factor on the cameras' positions and the depths of da3, as nested models write them.
    """
    rng, views = np.random.default_rng(0), read_context(scene, max_views)
    parts = [view_gaussians(view, rng) for view in views]
    return STYLES[style](out, views, parts, nested)


def _write_plain(out: Path, views: list[dict[str, Any]], parts: list[Rows], nested: float) -> Path:
    """Write all Gaussians, view by view."""
    write_views(out, views)
    return write_ply(out / "scene.ply", concat_rows(parts))


def _write_da3(out: Path, views: list[dict[str, Any]], parts: list[Rows], nested: float) -> Path:
    """Leave out borders and the farthest tenth of each view; write cameras and depth as arrays."""
    kept, (height, width) = [], views[0]["depth"].shape
    top, left = int(BORDER / 256 * height), int(BORDER / 256 * width)
    for view, rows in zip(views, parts, strict=True):
        mask = np.zeros((height, width), bool)
        mask[top : height - top, left : width - left] = True
        kept.append(take_rows(rows, (mask & (view["depth"] <= np.quantile(view["depth"], 0.9))).reshape(-1)))
    poses = np.stack([np.linalg.inv(view["c2w"])[:3] for view in views]).astype(np.float32)
    poses[:, :, 3] *= nested
    depth = np.stack([view["depth"] * nested for view in views]).astype(np.float32).round(6)
    Ks, conf = (np.stack([view[name] for view in views]).astype(np.float32) for name in ("K", "conf"))
    images = np.stack([np.round(view["image"] * 255) for view in views]).astype(np.uint8)
    place = out / "exports" / "npz"
    place.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(place / "results.npz", extrinsics=poses, intrinsics=Ks, depth=depth, conf=conf, image=images)
    return write_ply(out / "gs_ply" / "0000.ply", concat_rows(kept))


def _write_depthsplat(out: Path, views: list[dict[str, Any]], parts: list[Rows], nested: float) -> Path:
    """Leave out borders, let the view run fastest in the order of rows, and rotate the world by the first camera."""
    inner = np.arange(views[0]["depth"].size).reshape(views[0]["depth"].shape)[BORDER:-BORDER, BORDER:-BORDER]
    order = (np.arange(len(parts)) * views[0]["depth"].size + inner.reshape(-1, 1)).reshape(-1)
    write_views(out, views)
    return write_ply(
        out / "gaussians.ply", rotate_world(take_rows(concat_rows(parts), order), views[0]["c2w"][:3, :3].T)
    )


def _write_anysplat(out: Path, views: list[dict[str, Any]], parts: list[Rows], nested: float) -> Path:
    """Merge Gaussians in voxels of the median pixel's size, and write opacities as they are."""
    size = np.median([np.median(view["depth"]) / view["K"][0, 0] for view in views])
    write_views(out, views)
    return write_ply(out / "gaussians.ply", merge_voxels(concat_rows(parts), size), logits=False)


STYLES = {"plain": _write_plain, "da3": _write_da3, "depthsplat": _write_depthsplat, "anysplat": _write_anysplat}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("scene", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--style", choices=STYLES, default="plain")
    args = parser.parse_args()
    if not (args.scene / "transforms.json").is_file():
        raise SystemExit(f"{args.scene}: expected a capture, found none; {CAPTURES}")
    print(write_export(args.scene, args.out, args.style))
