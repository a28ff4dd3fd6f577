"""How well superpixels alone can show a photo: every pixel takes its superpixel's mean colour (paper, section 5)."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from gsmerge.io.content_hash import digest
from gsmerge.measure.preview import draw_means
from gsmerge.render.metrics import psnr
from gsmerge.research.charts.store import PROXIES
from gsmerge.runtime.jsonl import append_line, read_lines
from gsmerge.runtime.threads import parallel_map
from gsmerge.stages.segment import superpixels
from gsmerge.views import pick_views

SEGMENTATIONS = ("rdseg", "bass-st", "bass", "slic")
SHARES = (0.0025, 0.005, 0.01, 0.02, 0.044, 0.1)  # superpixels per pixel


@dataclass(frozen=True)
class Proxy:
    """One point of the proxy curve.

    Args:
        key: Of scene, segmentation and numbers.
        scene: Name for people.
        segmentation: How the superpixels were cut.
        superpixels: Of each view.
        share: Superpixels per pixel.
        views: Photos that were measured.
        psnr: Mean over those, dB.
    """

    key: str
    scene: str
    segmentation: str
    superpixels: int
    share: float
    views: int
    psnr: float


def proxy_psnr(image: Tensor, count: int, segmentation: str) -> float:
    """PSNR (dB) of a photo whose superpixels are filled with their mean colours.

    Args:
        image: ``[h,w,3]`` sRGB in [0, 1].
        count: Superpixels.
        segmentation: ``rdseg``, ``bass``, ``bass-st`` or ``slic``.
    """
    means = draw_means(image, superpixels(image, count, segmentation))
    return psnr(means.astype(np.float64) / 255, image.double().numpy())


def wanted_proxies(scene_sha256: str, most_views: int) -> dict[str, tuple[str, float]]:
    """Segmentation and share of every point of a scene, by key."""
    return {
        digest({"scene": scene_sha256, "segmentation": name, "share": share, "views": most_views}): (name, share)
        for name in SEGMENTATIONS
        for share in SHARES
    }


def measure_proxies(
    folder: Path,
    scene: str,
    images: Tensor,
    wanted: Mapping[str, tuple[str, float]],
    *,
    most_views: int,
    progress: Callable[[], None],
) -> None:
    """Measure points and keep each as it is done.

    Args:
        folder: The results folder.
        scene: The scene's name.
        images: ``[v,h,w,3]`` photos.
        wanted: Segmentation and share of the points by key, see :func:`wanted_proxies`.
        most_views: Photos at most, evenly spread.
        progress: Called after each point.
    """
    views = pick_views(len(images), most_views)
    pixels = images.shape[1] * images.shape[2]
    for key, (name, share) in wanted.items():
        count = max(1, round(share * pixels))
        values = parallel_map(partial(_one_view, images, count, name), views)
        finite = [min(value, 100.0) for value in values]  # a flat photo is met exactly
        made = Proxy(key, scene, name, count, share, len(views), float(np.mean(finite)))
        append_line(folder / PROXIES, asdict(made))
        progress()


def _one_view(images: Tensor, count: int, segmentation: str, view: int) -> float:
    return proxy_psnr(images[view], count, segmentation)


def read_proxies(folder: Path) -> tuple[dict[str, Proxy], Sequence[str]]:
    """All points of a results folder by key, and notes on lines that were dropped."""
    lines = read_lines(folder / PROXIES)
    found: dict[str, Proxy] = {}
    for value in lines.values:
        made = _proxy(value)
        if made is not None:
            found[made.key] = made
    return found, lines.notes


def _proxy(value: Mapping[str, Any]) -> Proxy | None:
    try:
        made = Proxy(**value)
    except TypeError:
        return None
    texts = all(isinstance(text, str) for text in (made.key, made.scene, made.segmentation))
    numbers = (made.superpixels, made.share, made.views, made.psnr)
    return made if texts and all(isinstance(n, int | float) and math.isfinite(n) for n in numbers) else None
