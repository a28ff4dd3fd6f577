"""Captures of docs/internals/captures.md: their folders, exports, target views and visibility.

They are in ``scenes/train`` and ``scenes/eval`` below ``GSMERGE_DATA``, or else below ``../shared``.
"""

from __future__ import annotations

import json
import os
import sys
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from capture_exports import FLIP, read_scene
from capture_exports import export as write_export
from one_line_errors import CAPTURES

from gsmerge.types import Cameras

LEFT_OUT = ("terrace", "mamechun")  # failure cases: depth mostly wrong, targets mostly unseen


def shared_folder() -> Path | None:
    """The folder with ``scenes/``, None where there is none."""
    folder = Path(os.environ.get("GSMERGE_DATA", Path(__file__).parents[2] / "shared"))
    return folder if (folder / "scenes").is_dir() else None


def scene_folders(split: str) -> list[Path]:
    """``train`` or ``eval``: the scenes of that split; otherwise those of names with commas between that are there."""
    root = shared_folder()
    if root is None:
        raise SystemExit(f"expected captures below GSMERGE_DATA, found none; {CAPTURES}")
    known = {p.name: p for p in sorted(root.glob("scenes/*/*")) if p.is_dir()}
    if split in ("train", "eval"):
        return [p for p in known.values() if p.parent.name == split]
    names = split.split(",")
    missing = [name for name in names if name not in known]
    if missing:
        print(f"left out, as not below {root}: {', '.join(missing)}; {CAPTURES}", file=sys.stderr)
    if len(missing) == len(names):
        raise SystemExit(1)
    return [known[name] for name in names if name in known]


def export(scene: Path, cache: Path, style: str = "plain") -> Path:
    """The ``.ply`` of a scene, written once into ``cache``."""
    out = cache / f"{scene.name}-{style}"
    files = sorted(out.rglob("*.ply")) if (out / "done").exists() else []
    if files:
        return files[0]
    path = write_export(scene, out, style)
    (out / "done").touch()
    return path


@dataclass(frozen=True)
class Targets:
    """Held-out photos: ``images [t,h,w,3]``, cameras, and the paper's visibility masks ``[t,h,w]`` (supplement A)."""

    images: np.ndarray
    cameras: Cameras
    masks: np.ndarray


def read_held_out(scene: Path) -> Targets:
    """The target views of a scene; a pixel is visible if a context depth sample falls on it or on a neighbour."""
    frames = [f for f in json.loads((scene / "transforms.json").read_text())["frames"] if f["role"] == "target"]
    views = read_scene(scene)
    images = [cv2.imread(str(scene / f["file_path"]))[..., ::-1].astype(np.float32) / 255 for f in frames]
    viewmats = np.stack([np.linalg.inv(np.array(f["transform_matrix"]) @ FLIP) for f in frames])
    Ks = np.array([[[f["fl_x"], 0, f["cx"]], [0, f["fl_y"], f["cy"]], [0, 0, 1]] for f in frames])
    points = np.concatenate([_points(v) for v in views])
    height, width = images[0].shape[:2]
    masks = np.stack([_visible(points, w2c, K, height, width) for w2c, K in zip(viewmats, Ks, strict=True)])
    cameras = Cameras(viewmats, Ks, width, height)
    return Targets(np.stack(images), cameras, masks)


def _points(view: dict) -> np.ndarray:
    height, width = view["depth"].shape
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rays = np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(view["K"]).T
    return (rays * view["depth"][..., None]).reshape(-1, 3) @ view["c2w"][:3, :3].T + view["c2w"][:3, 3]


def _visible(points: np.ndarray, w2c: np.ndarray, K: np.ndarray, height: int, width: int) -> np.ndarray:
    camera = points @ w2c[:3, :3].T + w2c[:3, 3]
    image = camera[camera[:, 2] > 1e-6] @ K.T
    x, y = np.floor(image[:, :2] / image[:, 2:]).astype(int).T
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    hit = np.zeros((height, width), np.uint8)
    hit[y[inside], x[inside]] = 1
    return cv2.dilate(hit, np.ones((3, 3), np.uint8)) > 0
