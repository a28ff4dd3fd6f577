"""How well superpixels alone approximate a photo: every pixel takes its superpixel's mean colour (paper, section 5)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import numpy as np

from gsmerge.io.content_hash import digest
from gsmerge.measure.preview import draw_means
from gsmerge.render.metrics import psnr
from gsmerge.research.charts.record import PROXIES, known_fields
from gsmerge.runtime.jsonl import append_line, read_lines
from gsmerge.runtime.threads import parallel_map
from gsmerge.stages.superpixels import superpixels
from gsmerge.views import pick_views

SEGMENTATIONS = ("rdseg", "bass-adaptive", "bass-st", "bass", "slic")
SHARES = (0.0025, 0.005, 0.01, 0.02, 0.044, 0.1)  # superpixels per pixel


@dataclass(frozen=True)
class Proxy:
    """One point of the proxy curve."""

    key: str  # hash of scene, segmentation, share and number of photos
    scene: str  # its name
    segmentation: str  # superpixel method
    superpixels: int  # of each view
    share: float  # superpixels per pixel
    views: int  # photos that were measured
    psnr: float  # mean over those, dB


def proxy_psnr(image: np.ndarray, count: int, segmentation: str) -> float:
    """PSNR (dB) of a photo ``[h,w,3]`` (sRGB in [0, 1]) with ``count`` superpixels in their mean colours."""
    means = draw_means(image, superpixels(image, count, segmentation))
    return psnr(means.astype(np.float64) / 255, image.astype(np.float64))


def proxy_points(scene_sha256: str, max_views: int) -> dict[str, tuple[str, float]]:
    """Segmentation and share of every point of a scene, by key."""
    return {
        digest({"scene": scene_sha256, "segmentation": name, "share": share, "views": max_views}): (name, share)
        for name in SEGMENTATIONS
        for share in SHARES
    }


def measure_proxies(
    folder: Path,
    scene: str,
    images: np.ndarray,
    points: Mapping[str, tuple[str, float]],
    *,
    max_views: int,
    progress: Callable[[], None],
) -> None:
    """Measure points, see :func:`proxy_points`, on photos ``[v,h,w,3]``, and store each as soon as it is done."""
    views = pick_views(len(images), max_views)
    pixels = images.shape[1] * images.shape[2]
    for key, (name, share) in points.items():
        count = max(1, round(share * pixels))
        values = parallel_map(partial(proxy_psnr, count=count, segmentation=name), images[views])
        finite = [min(value, 100.0) for value in values]  # a flat photo is reproduced exactly
        point = Proxy(key, scene, name, count, share, len(views), float(np.mean(finite)))
        append_line(folder / PROXIES, asdict(point))
        progress()


def read_proxies(folder: Path) -> tuple[dict[str, Proxy], Sequence[str]]:
    """All points of a results folder by key, and notes on lines that were left out."""
    lines = read_lines(folder / PROXIES)
    points = {}
    for value in lines.values:
        with suppress(TypeError, ValueError):  # a line of another version
            point = Proxy(**known_fields(Proxy, value))
            points[point.key] = point
    return points, lines.notes
