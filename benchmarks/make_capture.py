"""Make a capture of docs/internals/stability.md from public photos, their cameras and a checkout of IterMVS.

python benchmarks/make_capture.py instant-ngp/data/nerf/fox captures/scenes/eval/fox --itermvs IterMVS
GSMERGE_DATA=captures python benchmarks/quality.py fox

That page says how captures are made. IterMVS is github.com/FangjinhuaWang/IterMVS and needs torch.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import combinations, pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from captures import make_frame

from gsmerge.io.cameras.camera_file import CameraFile
from gsmerge.io.cameras.read_cameras import find_cameras, read_cameras
from gsmerge.io.image_names import natural_key
from gsmerge.method.geometry.transforms import project_points

SIDE, MULTIPLE = 480, 32  # longer side of photos, and the divisor of both sides, pixels
SOURCES = 4  # most other views from which a view's depth is predicted
CHECKPOINT = "checkpoints/blendedmvs/model_000015.ckpt"  # in the checkout of IterMVS
RATIO = 0.75  # largest ratio of the distances of the best match and the second best (Lowe)
MOST_ERROR, LEAST_ANGLE = 1.0, 1.0  # pixels between a point and its keypoints, degrees between its rays
LEAST_POINTS = 10  # least number of points of a view
SHARES, MARGIN = (2, 98), (0.6, 2.0)  # the range of depths is given by these percentiles of points, times these factors
# Predicts depth and confidence [h,w] of the first view, from all views and the range of depths
Predict = Callable[["list[View]", float, float], "tuple[np.ndarray, np.ndarray]"]


@dataclass(frozen=True)
class View:
    """A photo ``[h,w,3]`` uint8 BGR with intrinsics ``K [3,3]`` at its size and pose ``w2c [4,4]``, OpenCV axes."""

    name: str
    image: np.ndarray
    K: np.ndarray
    w2c: np.ndarray
    depths: list[float] = field(default_factory=list)  # depths of the points that it shares with other views


def pick_views(count: int, views: int) -> tuple[list[int], list[int]]:
    """Choose evenly spread input views, and held-out views midway between them; return the indices of both."""
    if count < 2 * views - 1:
        raise SystemExit(f"expected at least {2 * views - 1} photos for {views} views, found {count}: lower --views")
    inputs = np.linspace(0, count - 1, views).round().astype(int).tolist()
    return inputs, [(a + b) // 2 for a, b in pairwise(inputs)]


def find_photos(folder: Path, cameras: CameraFile) -> list[tuple[int, Path]]:
    """List the index and the photo of each camera that has one in a folder or its ``images``, in the order of names."""
    order = sorted(range(len(cameras)), key=lambda i: natural_key(cameras.names[i]))
    places = [(i, (folder / cameras.names[i], folder / "images" / Path(cameras.names[i]).name)) for i in order]
    return [(i, next(path for path in paths if path.is_file())) for i, paths in places if any(map(Path.is_file, paths))]


def read_view(path: Path, cameras: CameraFile, index: int, number: int) -> View:
    """Read a photo, undistort, reduce and crop it, and name it by ``number``; ``index`` is that of its camera."""
    photo = cv2.imread(str(path))
    if photo is None:
        raise SystemExit(f"{path}: expected a photo, found none that can be read")
    height, width = photo.shape[:2]
    camera_size = np.array([cameras.widths[index] or width, cameras.heights[index] or height])
    K = cameras.Ks[index] * np.array([width / camera_size[0], height / camera_size[1], 1])[:, None]
    lens = cameras.lenses[index] if cameras.lenses else None
    if lens is not None and lens.model == "fisheye":
        raise SystemExit(f"{path}: expected a photo of a perspective lens, found a fisheye: undistort it first")
    if lens is not None:  # pixels that the lens did not see become black, as in the captures that were measured
        photo = cv2.undistort(photo, K, np.pad(lens.coefficients, (0, 8 - len(lens.coefficients))))
    target = np.array([width, height]) * SIDE / max(width, height)
    target = np.maximum(np.round(target).astype(int) // MULTIPLE, 1) * MULTIPLE
    scale = max(target / (width, height))
    size = [math.ceil(side * scale - 1e-6) for side in (width, height)]
    left, top = (np.array(size) - target) // 2
    K = K * np.array([size[0] / width, size[1] / height, 1])[:, None]
    K[:2, 2] -= left, top
    photo = cv2.resize(photo, size, interpolation=cv2.INTER_AREA)[top : top + target[1], left : left + target[0]]
    return View(f"{number:05d}", photo, K, cameras.viewmats[index])


def share_points(views: list[View]) -> np.ndarray:
    """Match points between all pairs of views, and add their depths to the views.

    Returns the number of points ``[v,v]`` that each pair shares.
    """
    sift, matcher, counts = cv2.SIFT_create(), cv2.BFMatcher(), np.zeros((len(views), len(views)), int)
    keypoints = [sift.detectAndCompute(cv2.cvtColor(view.image, cv2.COLOR_BGR2GRAY), None) for view in views]
    for i, j in combinations(range(len(views)), 2):
        pairs = matcher.knnMatch(keypoints[i][1], keypoints[j][1], k=2)
        best = [pair[0] for pair in pairs if len(pair) == 2 and pair[0].distance < RATIO * pair[1].distance]
        if best:
            ids = zip(*((m.queryIdx, m.trainIdx) for m in best), strict=True)
            places = [
                np.array([keypoints[v][0][k].pt for k in of_v]) + 0.5 for v, of_v in zip((i, j), ids, strict=True)
            ]
            depths = triangulate(views[i], views[j], *places)
            counts[i, j] = counts[j, i] = len(depths)
            for view, column in zip((views[i], views[j]), depths.T, strict=True):
                view.depths.extend(column)
    return counts


def triangulate(a: View, b: View, in_a: np.ndarray, in_b: np.ndarray) -> np.ndarray:
    """Triangulate matching places ``[m,2]`` of two views; return the depths ``[n,2]`` of consistent points in both."""
    matrices = [view.K @ view.w2c[:3] for view in (a, b)]
    homogeneous = cv2.triangulatePoints(*matrices, in_a.T, in_b.T)
    points = (homogeneous[:3] / np.where(homogeneous[3] == 0, 1e-12, homogeneous[3])).T
    good, depths, rays = np.ones(len(points), bool), [], []
    for view, place in ((a, in_a), (b, in_b)):
        seen, depth = (values[0] for values in project_points(points, view.w2c[None], view.K[None]))
        rays.append(points + view.w2c[:3, :3].T @ view.w2c[:3, 3])
        good &= (depth > 0) & (np.linalg.norm(seen - place, axis=-1) < MOST_ERROR)
        depths.append(depth)
    cosines = (rays[0] * rays[1]).sum(1) / np.prod([np.linalg.norm(r, axis=1) for r in rays], 0)
    good &= cosines < math.cos(math.radians(LEAST_ANGLE))
    return np.stack(depths, 1)[good]


def load_network(checkout: Path, checkpoint: Path) -> Predict:
    """Load IterMVS, and return the function that predicts with it."""
    import torch

    sys.path.insert(0, str(checkout))
    from models.net import Pipeline  # a module of the checkout

    network = Pipeline(iteration=4, test=True)
    weights = torch.load(checkpoint, map_location="cpu", weights_only=True)["model"]
    network.eval().load_state_dict({name.removeprefix("module."): value for name, value in weights.items()})

    def predict(views: list[View], near: float, far: float) -> tuple[np.ndarray, np.ndarray]:
        """Predict depth and confidence of the first view; see ``Predict``."""
        photos = np.stack([view.image[..., ::-1] for view in views]).astype(np.float32) / 127.5 - 1
        images = torch.from_numpy(photos.transpose(0, 3, 1, 2).copy())[None]
        matrices = {}
        for level in range(1, 4):
            scale = np.diag([0.5**level, 0.5**level, 1.0])
            both = [np.concatenate([scale @ view.K @ view.w2c[:3], view.w2c[3:]]) for view in views]
            matrices[f"level_{level}"] = torch.from_numpy(np.stack(both).astype(np.float32))[None]
        with torch.no_grad():
            made = network({"level_0": images, "level_2": images}, matrices, torch.tensor([near]), torch.tensor([far]))
        return made["depths_upsampled"][0, 0].numpy(), made["confidence_upsampled"][0, 0].numpy()

    return predict


def write_depth(out: Path, view: View, sources: list[View], predict: Predict) -> dict[str, Any]:
    """Predict the depth of a view and write it; return the entries of the view's frame that describe it."""
    if len(view.depths) < LEAST_POINTS or not sources:
        raise SystemExit(f"{view.name}: expected {LEAST_POINTS} points in common with others, found {len(view.depths)}")
    near, far = np.percentile(view.depths, SHARES) * MARGIN
    depth, confidence = predict([view, *sources], near, far)
    steps = (1 / depth - 1 / far) / (1 / near - 1 / far)
    paths = {"depth_path": f"depth/{view.name}.png", "confidence_path": f"depth/{view.name}_conf.png"}
    cv2.imwrite(str(out / paths["depth_path"]), np.rint(65535 * steps.clip(0, 1)).astype(np.uint16))
    cv2.imwrite(str(out / paths["confidence_path"]), np.rint(255 * confidence.clip(0, 1)).astype(np.uint8))
    return {**paths, "depth_near": near, "depth_far": far}


def make_capture(folder: Path, out: Path, predict: Predict, views: int) -> None:
    """Write a capture with ``views`` input views: its photos, depths and ``transforms.json``."""
    place = find_cameras(folder)
    if place is None:
        raise SystemExit(f"{folder}: expected cameras (transforms.json or a COLMAP model), found none")
    cameras = read_cameras(place)
    photos = find_photos(folder, cameras)
    inputs, held_out = pick_views(len(photos), views)
    for name in ("images", "depth"):
        (out / name).mkdir(parents=True, exist_ok=True)
    read = {i: read_view(photos[i][1], cameras, photos[i][0], i) for i in (*inputs, *held_out)}
    shared, frames = share_points([read[number] for number in inputs]), []
    for number, view in sorted(read.items()):
        cv2.imwrite(str(out / "images" / f"{view.name}.jpg"), view.image, [cv2.IMWRITE_JPEG_QUALITY, 93])
        pose, shape = np.linalg.inv(view.w2c), view.image.shape
        frame = make_frame(f"images/{view.name}.jpg", view.K, pose, shape) | {"role": "target"}
        if number in inputs:
            row = shared[inputs.index(number)]
            best = [read[inputs[i]] for i in np.argsort(-row, kind="stable")[:SOURCES] if row[i]]
            frame |= {"role": "context", **write_depth(out, view, best, predict)}
        frames.append(frame)
        print(view.name, frame["role"], flush=True)
    (out / "transforms.json").write_text(json.dumps({"camera_model": "PINHOLE", "frames": frames}, indent=1))


def main() -> None:
    """Make the capture that the command line describes."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folder", type=Path, help="photos with their cameras: transforms.json or a COLMAP model")
    parser.add_argument("out", type=Path, help="below GSMERGE_DATA: scenes/eval/NAME, or train")
    parser.add_argument("--itermvs", type=Path, required=True, help="checkout of IterMVS")
    parser.add_argument("--checkpoint", type=Path, help=f"weights of IterMVS; by default {CHECKPOINT} in the checkout")
    parser.add_argument("--views", type=int, default=12, help="input views")
    args = parser.parse_args()
    predict = load_network(args.itermvs, args.checkpoint or args.itermvs / CHECKPOINT)
    make_capture(args.folder, args.out, predict, args.views)


if __name__ == "__main__":
    main()
