"""Scenes of many views: the context views of a scene repeated, each time from a slightly other pose.

python benchmarks/many_views.py redkitchen OUT --views 84
"""

from __future__ import annotations

import argparse
import json
import shutil
from pathlib import Path

import cv2
import numpy as np
from capture_exports import read_scene
from shared_scenes import scene_folders

TURN = 0.2  # degrees
SHIFT = 0.002  # of the median depth


def many_views(scene: Path, out: Path, num_views: int, seed: int = 0) -> Path:
    """A scene folder with ``num_views`` context views, for the exporter; created once.

    Views stand in the order of the scene's own, the repetitions of each one after the other. The first has the pose
    of the original, others one that is jittered by about ``TURN`` and ``SHIFT``, as by pose estimation from a video
    that hardly moves. Photos and depth are the same. Target views are kept.

    Args:
        scene: Folder with ``transforms.json``, as the scenes next to the repository.
        out: Folder to write.
        num_views: Context views, at least as many as the scene has.
        seed: Of the poses.

    Returns:
        ``out``.

    Raises:
        ValueError: If the scene has more context views already.
    """
    done = out / "done.json"
    made_of = {"scene": scene.name, "num_views": num_views, "seed": seed}
    if done.exists() and json.loads(done.read_text()) == made_of:
        return out
    document = json.loads((scene / "transforms.json").read_text())
    frames = document["frames"]
    context = [f for f in frames if f["role"] == "context"]
    if num_views < len(context):
        raise ValueError(f"expected at least the {len(context)} context views of {scene}, got {num_views}")
    shift = SHIFT * float(np.median([np.median(view["depth"]) for view in read_scene(scene)]))
    targets = [f for f in frames if f["role"] != "context"]
    for frame in targets:
        _copy(scene / frame["file_path"], out / frame["file_path"])
    rng = np.random.default_rng(seed)
    sources = [view * len(context) // num_views for view in range(num_views)]
    repeated = []
    for view, source in enumerate(sources):
        frame = dict(context[source])
        if view > 0 and sources[view - 1] == source:
            frame["transform_matrix"] = _jittered(np.array(frame["transform_matrix"]), shift, rng).tolist()
        for key in ("file_path", "depth_path", "confidence_path"):
            path = Path(frame[key])
            frame[key] = str(path.with_name(f"{view:04d}_{path.name}"))
            _copy(scene / path, out / frame[key])
        repeated.append(frame)
    (out / "transforms.json").write_text(json.dumps(document | {"frames": repeated + targets}, indent=1))
    done.write_text(json.dumps(made_of))
    return out


def _copy(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(source, target)


def _jittered(pose: np.ndarray, shift: float, rng: np.random.Generator) -> np.ndarray:
    """A camera-to-world pose turned about its own centre by about ``TURN`` degrees, and moved by about ``shift``."""
    axis = rng.normal(size=3)
    angle = np.radians(TURN) * rng.normal()
    turn, _ = cv2.Rodrigues(axis / np.linalg.norm(axis) * angle)
    direction = rng.normal(size=3)
    moved = pose.copy()
    moved[:3, :3] = pose[:3, :3] @ turn
    moved[:3, 3] += direction / np.linalg.norm(direction) * shift * rng.normal()
    return moved


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("scene", help="name of one of the scenes next to the repository")
    parser.add_argument("out", type=Path)
    parser.add_argument("--views", type=int, default=84)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    print(many_views(scene_folders(args.scene)[0], args.out, args.views, args.seed))


if __name__ == "__main__":
    main()
