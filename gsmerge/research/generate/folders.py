"""Write folders of synthetic scenes, each complete or absent; existing scenes are not made again."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from gsmerge.errors import UsageError
from gsmerge.frozen import asdict, dataclass
from gsmerge.io import write_ply
from gsmerge.io.atomic import AddOutput, atomic_outputs
from gsmerge.io.cameras.camera_file import FLIP
from gsmerge.method.kernels.matrices import matmul
from gsmerge.research.generate.photograph import Float
from gsmerge.research.generate.shapes import invert_motion
from gsmerge.research.generate.synthetic_scene import GenerateOptions, make_synthetic_scene
from gsmerge.runtime.threads import parallel_map, use_threads
from gsmerge.types import Cameras


@dataclass(frozen=True)
class SceneFolder:
    """Folder of one scene of a series."""

    folder: Path
    kept: bool  # True if the scene existed already


def generate_scene(folder: Path, options: GenerateOptions | None = None, *, seed: int = 0, index: int = 0) -> Path:
    """Write scene ``index`` of a series to a folder, and return the folder. A ``seed`` defines a series of scenes.

    A folder with the same scene is not changed. Raises UsageError if the folder has other contents, and SceneError if
    it cannot be written.
    """
    options = options or GenerateOptions()
    facts = scene_facts(seed, index, options)
    if not is_complete(folder, facts):
        scene = make_synthetic_scene(seed, index, options)
        record = {
            **facts,
            "num_views": len(scene.cameras),
            "num_gaussians": len(scene.gaussians),
            "noise": asdict(scene.noise),
        }
        with atomic_outputs() as add:
            _write_views(add, folder, scene.cameras, scene.images)
            _write_views(add, folder / "targets", scene.targets, scene.target_images)
            write_ply(add(folder / "scene.ply"), scene.gaussians)
            add(folder / RECORD).write_bytes(json.dumps(record, indent=1).encode() + b"\n")
    return folder


def generate(
    out: Path,
    count: int,
    options: GenerateOptions | None = None,
    *,
    seed: int = 0,
    threads: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> list[SceneFolder]:
    """Generate scenes ``out/scene_0000`` and so on, all different; the same arguments give the same bytes.

    Every folder gets ``scene.ply``, ``transforms.json``, ``images/``, held-out views in ``targets/``, and
    ``generated.json`` with the random settings. A folder with the same scene is not changed. Therefore an interrupted
    call can be repeated, and a call with a larger ``count`` adds scenes. Random numbers depend only on ``seed`` and the
    scene's number. ``progress`` is called with the number of finished scenes and the number of all scenes.

    Raises:
        ValueError: If ``count`` or ``seed`` is out of range.
        UsageError: If a folder has other contents.
        SceneError: If a folder cannot be written.
    """
    options = options or GenerateOptions()
    if count < 1 or seed < 0:
        raise ValueError(f"expected at least 1 scene and a seed from 0, got {count} and {seed}")
    planned = []
    for index in range(count):
        folder = out / f"scene_{index:04d}"
        planned.append(SceneFolder(folder, is_complete(folder, scene_facts(seed, index, options))))
    todo = [i for i, scene in enumerate(planned) if not scene.kept]

    def fill_folder(index: int) -> None:
        """Generate the scene of one folder."""
        generate_scene(planned[index].folder, options, seed=seed, index=index)

    with use_threads(threads) as workers:
        for start in range(0, len(todo), workers):
            parallel_map(fill_folder, todo[start : start + workers])
            if progress is not None:
                progress(count - len(todo) + min(start + workers, len(todo)), count)
    return planned


RECORD = "generated.json"


def scene_facts(seed: int, index: int, options: GenerateOptions) -> dict[str, Any]:
    """Return all that defines a scene, as JSON types. The record of a scene begins with this description."""
    record_version = 3  # increases if the same seed and options give other scenes than before
    return {"record_version": record_version, "seed": seed, "index": index, "options": options.to_dict()}


def is_complete(folder: Path, facts: Mapping[str, Any]) -> bool:
    """Return True if a folder has the complete scene with these facts.

    Raises UsageError if the folder has other contents.
    """
    try:
        record = json.loads((folder / RECORD).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        record = None
    if isinstance(record, dict) and {name: record.get(name) for name in facts} == dict(facts):
        return True
    if folder.is_dir() and any(folder.iterdir()):
        problem = (
            "expected no folder, or one with the same scene, found something else; remove it, or choose another OUT"
        )
        raise UsageError(f"{folder}: {problem}")
    return False


def _write_views(add: AddOutput, folder: Path, cameras: Cameras, images: Sequence[Float]) -> None:
    """Write photos to ``images/``, and their cameras to ``transforms.json`` (nerfstudio: camera to world, OpenGL)."""
    frames = []
    digits = max(3, len(str(len(images) - 1)))
    for i, image in enumerate(images):
        name = f"images/view_{i:0{digits}d}.png"
        _, data = cv2.imencode(".png", np.round(image[..., ::-1] * 255).astype(np.uint8))
        add(folder / name).write_bytes(data.tobytes())
        c2w = matmul(invert_motion(cameras.viewmats[i]), FLIP)
        frames.append({"file_path": name, "transform_matrix": c2w.tolist()})
    K = cameras.Ks[0]
    shared = {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "w": cameras.width, "h": cameras.height}
    document = {"camera_model": "PINHOLE", **shared, "frames": frames}
    add(folder / "transforms.json").write_bytes(json.dumps(document, indent=1).encode() + b"\n")
