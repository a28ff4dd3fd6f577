"""Encode cameras for viewers, as INRIA's ``cameras.json`` and as settings of SuperSplat's viewer."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gsmerge.io.cameras.camera_file import CENTRED_PX
from gsmerge.method.geometry.transforms import camera_centres, lower_median, normalize
from gsmerge.types import Cameras

ENDING = ".cameras.json"
TRACK = "gsmerge"  # name of the camera track in settings that gsmerge writes
# Effects of SuperSplat's viewer, with the numbers that settings must have even if the effects are disabled
_EFFECTS: dict[str, dict[str, Any]] = {
    "sharpness": {"amount": 0}, "bloom": {"intensity": 1, "blurLevel": 2},
    "grading": {"brightness": 1, "contrast": 1, "saturation": 1, "tint": [1, 1, 1]},
    "vignette": {"intensity": 0.5, "inner": 0.3, "outer": 0.75, "curvature": 1}, "fringing": {"intensity": 0.5},
}  # fmt: skip


def viewer_cameras_path(output: Path) -> Path:
    """Return the path of the camera file for viewers: ``out.ply`` -> ``out.cameras.json``."""
    name = output.name
    stem = name[: -len(".compressed.ply")] if name.lower().endswith(".compressed.ply") else output.stem
    max_name = 255  # bytes of a file's name
    stem = os.fsencode(stem)[: max_name - len(ENDING)].decode("utf-8", "ignore")
    return output.with_name(stem + ENDING)


def viewer_cameras(cameras: Cameras, names: Sequence[str]) -> str:
    """Return the text of cameras as INRIA's ``cameras.json``, for SuperSplat and other viewers.

    :func:`gsmerge.read_cameras` reads this file. Viewers assume that the principal point is in the middle. A principal
    point elsewhere is written as ``cx`` and ``cy``, which viewers ignore.
    """
    rotations = cameras.viewmats[:, :3, :3].transpose(0, 2, 1)
    centres = cameras.centres
    entries = list[dict[str, Any]]()
    for i, name in enumerate(names):
        K = cameras.Ks[i]
        entries.append({
            "id": i, "img_name": name, "width": cameras.width, "height": cameras.height,
            "position": centres[i].tolist(), "rotation": rotations[i].tolist(),
            "fy": float(K[1, 1]), "fx": float(K[0, 0]),
        })  # fmt: skip
        if not np.allclose(2 * K[:2, 2], (cameras.width, cameras.height), rtol=0, atol=CENTRED_PX):
            entries[-1] |= {"cx": float(K[0, 2]), "cy": float(K[1, 2])}
    return json.dumps(entries) + "\n"


def order_views(cameras: Cameras) -> list[int]:
    """Return the numbers of the views, ordered by their distance from the median centre and the mean direction."""
    if len(cameras) == 0:
        return []
    centres = camera_centres(cameras.viewmats)
    forward = cameras.viewmats[:, 2, :3]
    offsets = centres - lower_median(centres)
    deviations = forward - normalize(forward.mean(0))
    distances, turns = (np.sqrt((rows * rows).sum(1)) for rows in (offsets, deviations))
    return np.argsort(distances / (distances.mean() or 1.0) + turns, kind="stable").tolist()


def vertical_field(cameras: Cameras, view: int) -> float:
    """Return the vertical field of view in radians, rounded so that it is equal on every processor."""
    return round(2 * math.atan(cameras.height / (2 * float(cameras.Ks[view, 1, 1]))), 9)


def is_own_settings(path: Path) -> bool:
    """Return whether gsmerge wrote a file of settings, as the name of its track shows."""
    return f'"{TRACK}"' in path.read_text(encoding="utf-8", errors="replace")


def viewer_settings(cameras: Cameras, means: np.ndarray) -> str:
    """Return the text of a ``settings.json``, version 2, which tells SuperSplat's viewer where to look from.

    The camera is the first of :func:`order_views`. The target of the camera lies at the median depth of the ``means
    [n,3]`` in front of the camera. The viewer turns the scene by half a turn about z, and applies the field of view to
    the longer side of its image. The settings have a camera track with two keys, both at this camera, because the
    viewer would move its camera if the settings had no track.
    """
    view = order_views(cameras)[0]
    forward = cameras.viewmats[view, 2, :3].astype(np.float64)
    centre = cameras.centres[view].astype(np.float64)
    num_sampled = 10_000  # Gaussians from which a depth is estimated
    depths = ((means[:: max(1, len(means) // num_sampled)] - centre) * forward).sum(1)
    depth = float(np.median(depths[depths > 0])) if (depths > 0).any() else 1.0
    position, target = (np.array([-1.0, -1.0, 1.0]) * point for point in (centre, centre + depth * forward))
    longer = max(cameras.width / float(cameras.Ks[view, 0, 0]), cameras.height / float(cameras.Ks[view, 1, 1]))
    fov = round(math.degrees(2 * math.atan(longer / 2)), 4)
    pose = {"position": position.tolist(), "target": target.tolist(), "fov": fov}
    keys = {
        "times": [0, 1],
        "values": {"position": [*position, *position], "target": [*target, *target], "fov": [fov, fov]},
    }
    track = {
        "name": TRACK, "duration": 1, "frameRate": 1, "loopMode": "none", "interpolation": "spline", "smoothness": 1,
        "keyframes": keys,
    }  # fmt: skip
    effects = {name: {"enabled": False, **numbers} for name, numbers in _EFFECTS.items()}
    settings = {
        "version": 2, "tonemapping": "none", "highPrecisionRendering": False, "background": {"color": [0, 0, 0]},
        "postEffectSettings": effects, "animTracks": [track], "cameras": [{"initial": pose}], "annotations": [],
        "startMode": "animTrack",
    }  # fmt: skip
    return json.dumps(settings) + "\n"
