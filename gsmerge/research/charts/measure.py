"""Scores, render time and pictures of a set of Gaussians."""

from __future__ import annotations

import math
from dataclasses import asdict, replace
from pathlib import Path

import cv2
import numpy as np

from gsmerge.io import HeldOutViews, atomic_output
from gsmerge.measure.evaluate import EvaluateOptions, Views, evaluate, near_plane
from gsmerge.measure.preview import Picture, heat_map, to_picture
from gsmerge.render import render
from gsmerge.research.charts.record import picture_path
from gsmerge.types import Gaussians, Scene
from gsmerge.views import even_views, midpoint_views, pick_views, subset

MAX_PICTURES = 2  # views of a run whose pictures are stored
MAX_WIDTH = 640  # pixels of a stored picture
MAX_ERROR = 0.25  # mean absolute error over the channels at the top of the error maps' scale
QUALITY = 88  # of the JPEG files
MAX_DB = 100.0  # PSNR of equal pictures, since JSON has no infinity


def choose_views(scene: Scene, held_out: HeldOutViews | None, count: int | None) -> tuple[Scene, Views | None]:
    """``count`` of the scene's views, evenly spread, and the held-out ones nearest the middle between them.

    Without ``count`` all views are kept, and where their places along the trajectory are not known all held-out ones.
    """
    targets = None if held_out is None else Views(held_out.cameras, held_out.images, held_out.names)
    if count is None or count >= len(scene):
        return scene, targets
    ids = even_views(len(scene), count)
    if held_out is not None and held_out.context_places is not None:
        chosen = midpoint_views([held_out.context_places[i] for i in ids], held_out.places)
        names = tuple(held_out.names[i] for i in chosen)
        targets = Views(held_out.cameras[chosen], held_out.images[chosen], names) if chosen else None
    return subset(scene, ids), targets


def measure(
    scene: Scene, gaussians: Gaussians | None, targets: Views | None, options: EvaluateOptions
) -> dict[str, float]:
    """Scores by name (``psnr_target_visible``, ...), means over the views; what cannot be measured is left out.

    Without ``gaussians`` the scene's own are measured.
    """
    results = {} if gaussians is None else {"result": gaussians}
    evaluation = evaluate(scene, results, targets, replace(options, own=gaussians is None))
    scores: dict[str, float] = {}
    for split in evaluation.num_views:
        full, masked = evaluation.results[-1].mean(split)
        for part, quality in (("", full), ("_visible", masked)):
            for name, value in asdict(quality).items():
                if value is not None and not math.isnan(value):
                    scores[f"{name}_{split}{part}"] = min(value, MAX_DB)
    return scores


def keep_pictures(
    folder: Path, key: str, scene_sha256: str, gaussians: Gaussians, scene: Scene, targets: Views | HeldOutViews | None
) -> tuple[str, ...]:
    """Write renders and error maps of a few views of a run, and once per scene the photos; returns the views' names.

    The views are the held-out ones, or the scene's without any; ``scene`` and ``targets`` have all of them, so that all
    runs of a scene have pictures of the same ones.
    """
    views = scene if targets is None else targets
    photos, names = views.images, views.names
    ids, near = pick_views(len(names), MAX_PICTURES), near_plane(scene)
    for i, view in enumerate(ids):
        image = render(gaussians, views.cameras[[view]], near=near).images[0].clip(0, 1)
        _write(picture_path(folder, key, i, "render"), to_picture(image))
        if photos is None:
            continue
        photo = picture_path(folder, scene_sha256, i, "photo")
        if not photo.exists():
            _write(photo, to_picture(photos[view]))
        _write(picture_path(folder, key, i, "error"), error_map(image, photos[view]))
    return tuple(names[view] for view in ids)


def error_map(image: np.ndarray, photo: np.ndarray) -> Picture:
    """Mean absolute error over the channels as a heat map, on the same scale for all pictures."""
    error = np.abs(image - photo).mean(2) / MAX_ERROR
    return heat_map(error.clip(0, 1))


def _write(path: Path, picture: Picture) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    height, width = picture.shape[:2]
    if width > MAX_WIDTH:
        size = MAX_WIDTH, max(1, round(height * MAX_WIDTH / width))
        picture = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)
    settings = [cv2.IMWRITE_JPEG_QUALITY, QUALITY] if path.suffix == ".jpg" else []
    _, data = cv2.imencode(path.suffix, picture[..., ::-1], settings)
    with atomic_output(path, overwrite=True) as temporary:
        temporary.write_bytes(data.tobytes())
