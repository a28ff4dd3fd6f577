"""Starts of a scene, with and without networks -> the start that shows the views better."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import cv2
import numpy as np

from gsmerge.facts.views import pick_views
from gsmerge.raster.metrics import decibels
from gsmerge.raster.photos import Photos, photo_errors, scene_photos, scene_pictures
from gsmerge.runtime.memory import release_memory
from gsmerge.runtime.record import choose, stage
from gsmerge.settings.stages import DecodeOptions
from gsmerge.stages.decode import decode
from gsmerge.stages.merge import MergedViews
from gsmerge.types import Gaussians, Scene

if TYPE_CHECKING:
    from gsmerge.networks.checkpoint import Checkpoint

MAX_VIEWS = 6  # that a start is judged by


def choose_start(
    starts: Sequence[MergedViews], scene: Scene, options: DecodeOptions, checkpoint: Checkpoint | None
) -> MergedViews:
    """Choose between the merges with and without networks by which shows the views better at K = 1.

    The choice does not depend on K, so what is encoded once is what every K begins with. Networks
    learn what real exports suffer from; a scene without those errors is better left alone.
    ``starts``: the learned start, then the analytic one, which wins ties; or one alone. The record
    gets the PSNR (dB) of both.
    """
    best = starts[0] if len(starts) == 1 else _better_start(starts, scene, options)
    choose(groups=best.num_groups, clusters=len(best.features))
    if best.networks is not None and checkpoint is not None:
        choose(networks=checkpoint.facts())
    return best


@stage("choose")
def _better_start(starts: Sequence[MergedViews], scene: Scene, options: DecodeOptions) -> MergedViews:
    """Compare starts by what they become at K = 1."""
    best, scores = starts[0], dict[str, float]()
    for start in starts:
        name = "analytic" if start.networks is None else "learned"
        ones = decode(start.features, start.members, replace(options, k=1), networks=start.networks)
        release_memory()  # of the networks, in other threads
        scores[name] = views_psnr(ones, scene)
        if scores[name] >= max(scores.values()):
            best = replace(start, k1_gaussians=ones)
    choose(start_scores=scores)
    return best


def views_psnr(gaussians: Gaussians, scene: Scene) -> float:
    """Measure the PSNR (dB) of the views at half size, over the pixels that have a Gaussian of their own.

    Without photos, the colours of the scene's pixels stand in for them.
    """
    photos = scene_photos(replace(scene, images=scene_pictures(scene)), 2)

    def score(view: int, image: np.ndarray, _: np.ndarray) -> tuple[float, float]:
        error = ((np.clip(image, 0, 1) - photos.images[view]) ** 2).sum(-1)
        weight = _weight(scene, view, photos)
        return float((error * weight).sum(dtype=np.float64)), float(weight.sum(dtype=np.float64))

    error, count = np.sum(photo_errors(gaussians, photos, score, pick_views(len(photos), MAX_VIEWS)), axis=0)
    return decibels(error / max(3 * count, 1))


def _weight(scene: Scene, view: int, photos: Photos) -> np.ndarray:
    """Return the share of each half-size pixel that has Gaussians, ``[h,w]``; ones for unaligned scenes."""
    size = photos.width, photos.height
    if not scene.aligned:
        return np.ones(size[::-1], np.float32)
    return cv2.resize(scene.valid[view].astype(np.float32), size, interpolation=cv2.INTER_AREA)
