"""scene -> groups, on a device: ``rdseg`` of :mod:`gsmerge.stages.segment` for all views at once."""

from __future__ import annotations

import torch
from torch import Tensor

from gsmerge.gpu.rectangles import split_rectangles
from gsmerge.gpu.regions import merge_regions, move_borders, pixel_features
from gsmerge.stages.segment import BLOCK, EFFORTS, NUM_SWEEPS, PIXEL_START, SegmentOptions

PASSES = 3  # over all pixels for each sweep of the kernel, which carries a border on as it goes


def covers(options: SegmentOptions) -> bool:
    """Whether :func:`segment` does what the options ask for."""
    return options.segmentation == "rdseg"


def segment(images: Tensor, options: SegmentOptions, count: int) -> Tensor:
    """Cut every view into exactly ``count`` superpixels, each non-empty and 4-connected.

    The seeds are those of ``rdseg``: rectangles cut best first, merged with Ward's rule. Border pixels then move by its
    rule, a quarter of them at a time.

    Args:
        images: ``[v,h,w,3]`` sRGB in [0, 1].
        options: Effort and compactness.
        count: Superpixels of each view, 1 to h·w.

    Returns:
        ``[v,h,w]`` int64, 0 to ``count - 1`` in every view; the same on every run.
    """
    views, height, width, _ = images.shape
    rectangles_each, first_sweeps = EFFORTS[options.effort]
    spread, wanted = options.compactness**0.5, int(rectangles_each * count)
    features = pixel_features(images)
    if wanted > PIXEL_START * height * width:
        labels, each = _every_pixel(images), height * width
    else:
        labels, each = split_rectangles(images, wanted, BLOCK, options.compactness)
        labels = move_borders(labels, features, views * each, PASSES * first_sweeps, spread)
    labels = merge_regions(labels, features, each, count, spread)
    labels = move_borders(labels, features, views * count, PASSES * NUM_SWEEPS, spread)
    return labels - labels.amin((1, 2), keepdim=True)


def _every_pixel(images: Tensor) -> Tensor:
    """Labels in which every pixel is its own region."""
    views, height, width, _ = images.shape
    return torch.arange(views * height * width, device=images.device).reshape(views, height, width)
