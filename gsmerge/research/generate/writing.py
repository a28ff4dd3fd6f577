"""Made scenes as folders: complete, or not there."""

from __future__ import annotations

import json
import os
import secrets
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from gsmerge.errors import SceneError, UsageError
from gsmerge.io import write_ply
from gsmerge.research.generate.noise import Float
from gsmerge.research.generate.options import GenerateOptions
from gsmerge.research.generate.scene import MadeScene
from gsmerge.types import Cameras

RECORD = "generated.json"
RECORD_VERSION = 1  # goes up when the same seed and options make other scenes
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])  # OpenGL camera axes <-> OpenCV camera axes


def scene_key(seed: int, index: int, options: GenerateOptions) -> dict[str, Any]:
    """What a scene hangs on."""
    return {"record_version": RECORD_VERSION, "seed": seed, "index": index, "options": options.to_dict()}


def is_made(folder: Path, key: Mapping[str, Any]) -> bool:
    """Whether a folder holds this scene already."""
    try:
        record = json.loads((folder / RECORD).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return isinstance(record, dict) and {name: record.get(name) for name in key} == dict(key)


def check_replaceable(folder: Path, *, overwrite: bool) -> None:
    """Refuse a folder that is there and holds something else.

    Raises:
        UsageError: If it may not be replaced, or holds what was not made here.
    """
    if not os.path.lexists(folder):
        return
    if not (folder / RECORD).is_file():
        raise UsageError(f"{folder}: expected no folder, or a made scene, found something else; choose another OUT")
    if not overwrite:
        raise UsageError(
            f"{folder}: holds a scene of other options; pass --overwrite to replace it, or choose another OUT"
        )


def write_scene(folder: Path, made: MadeScene, key: Mapping[str, Any]) -> dict[str, Any]:
    """Write a made scene, in place of one that is there, and return its record.

    Raises:
        SceneError: If the folder cannot be written.
    """
    record = {
        **key,
        "style": made.style,
        "path": made.path,
        "num_views": len(made.cameras),
        "num_gaussians": len(made.gaussians),
        "noise": asdict(made.noise),
    }
    with _folder(folder) as temporary:
        _write_views(temporary, made.cameras, made.images)
        _write_views(temporary / "targets", made.targets, made.target_images)
        write_ply(temporary / "scene.ply", made.gaussians)
        (temporary / RECORD).write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    return record


@contextmanager
def _folder(folder: Path) -> Iterator[Path]:
    """A hidden folder beside the final one, which takes its place when the block ends well."""
    temporary = folder.with_name(f".{folder.name}-{secrets.token_hex(4)}")
    try:
        temporary.mkdir(parents=True)
        yield temporary
        if folder.exists():
            shutil.rmtree(folder)
        temporary.rename(folder)
    except OSError as error:
        raise SceneError(folder, f"cannot be written ({error.strerror})", "choose another folder") from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _write_views(folder: Path, cameras: Cameras, images: Sequence[Float]) -> None:
    """``images/`` and ``transforms.json`` (nerfstudio: camera to world, OpenGL axes)."""
    (folder / "images").mkdir(parents=True)
    frames = []
    for i, image in enumerate(images):
        name = f"images/view_{i:03d}.png"
        ok, data = cv2.imencode(".png", np.round(image[..., ::-1] * 255).astype(np.uint8))
        if not ok:
            raise RuntimeError("the image library could not write a PNG")
        (folder / name).write_bytes(data.tobytes())
        c2w = np.linalg.inv(cameras.viewmats[i].numpy()) @ FLIP
        frames.append({"file_path": name, "transform_matrix": c2w.tolist()})
    K = cameras.Ks[0].numpy()
    shared = {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "w": cameras.width, "h": cameras.height}
    document = {"camera_model": "PINHOLE", **shared, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
