"""What each number of Gaussians would bring: short fits, judged by parts of the photos that they left out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gsmerge.allocate import RegionTree
from gsmerge.build import Source, build
from gsmerge.fit import FitOptions
from gsmerge.fit.holdout import holdout_psnr, training_weights
from gsmerge.grouping import Canvas, cut_scene
from gsmerge.journal import Journal
from gsmerge.metrics import WINDOW, ssim
from gsmerge.options import CompactOptions
from gsmerge.perceptual import lpips, lpips_available
from gsmerge.photos import Photos, scene_photos
from gsmerge.render import composite, plan_view, prepare
from gsmerge.targets import CurvePoint
from gsmerge.threads import parallel_map
from gsmerge.types import Gaussians

SHORT, LONG = 60, 300  # steps of half-size photos: enough to find the knee; to tell tenths of a dB on clean scenes
HOLDOUT = 0.1  # share of the photos' blocks
NET, PERCEPTUAL_VIEWS = "alex", 2  # the fast net, and as many views: LPIPS takes longer than the fit
PERCEPTUAL_SIDE = 64  # pixels, at least


def measure_curve(
    source: Source,
    canvas: Canvas,
    tree: RegionTree,
    options: CompactOptions,
    steps: int,
    counts: Sequence[int],
    journal: Journal,
) -> list[CurvePoint]:
    """PSNR, SSIM and, where its weights are installed, LPIPS (AlexNet) of the photos at some counts.

    PSNR and SSIM are those of blocks that the short fits do not look at, at full size; LPIPS needs whole pictures.

    Args:
        source: The scene, which must have photos.
        canvas: Its pictures.
        tree: What superpixels are cut from.
        options: All settings; the fit's own length does not matter.
        steps: Length of the fits.
        counts: Numbers of Gaussians, each within the canvas' limits.
        journal: Told the progress.
    """
    short = FitOptions(fit="full", fit_steps=steps, coarse=1.0, holdout=HOLDOUT, rates=options.fit.rates)
    quick = replace(options, fit=short)
    whole = replace(canvas, share=1.0)  # so short a fit does not grow
    photos = scene_photos(source.scene)
    held = training_weights(photos, HOLDOUT, options.seed)
    points: list[CurvePoint] = []
    for count in counts:
        journal.curve_progress(len(points), len(counts))
        gaussians = build(source, cut_scene(source.scene, whole, tree, quick, count), quick, Journal())
        points.append(_point(count, gaussians, photos, held, quick.fit.min_gain))
    return points


def _point(count: int, gaussians: Gaussians, photos: Photos, held: list[np.ndarray], min_gain: float) -> CurvePoint:
    splats, views = prepare(gaussians), range(len(photos))
    images = parallel_map(lambda v: np.clip(composite(plan_view(splats, **photos.camera(v)))[0], 0, 1), views)
    similar = parallel_map(lambda v: _similarity(images[v], photos.images[v], held[v] == 0), views)
    perceptual = None
    if min(photos.height, photos.width) >= PERCEPTUAL_SIDE and lpips_available(NET):
        some = np.linspace(0, len(photos) - 1, min(PERCEPTUAL_VIEWS, len(photos))).round().astype(int)
        perceptual = float(np.mean([lpips(images[v], photos.images[v], NET) for v in some]))
    psnr = holdout_psnr(images, photos, held, min_gain)
    return CurvePoint(count, psnr, float(np.mean(similar)), perceptual)


def _similarity(image: np.ndarray, photo: np.ndarray, held: np.ndarray) -> float:
    """SSIM of the held-out windows that lie inside the picture; of the whole where none does, 0 where none can."""
    if min(held.shape) < WINDOW:
        return 0.0
    border = WINDOW // 2
    return ssim(image, photo, held if held[border:-border, border:-border].any() else None)
