"""Partition each view into superpixels of similar colour and regular shape (paper section 4.1).

The default, ``rdseg``, places superpixels where they lower the squared colour error most. First ``rdseg`` cuts the
image into more rectangles than requested, where cuts lower the error most. It then merges rectangles by Ward's rule
down to the exact number, and moves pixels at borders between superpixels if this lowers the error. ``bass`` is Bayesian
adaptive superpixel segmentation from a hexagonal grid. ``bass-st`` starts from seeds that are drawn by the Shi-Tomasi
response instead, as in the paper. ``slic`` is that of scikit-image, with which the paper compares both. ``grid`` makes
plain rectangles. Rectangles of a few pixels are as good as other superpixels if no fit follows, and take almost no
time. All methods make exactly as many superpixels as requested. No superpixel is empty, each is 4-connected, and each
run gives the same bits.
"""

from __future__ import annotations

from functools import partial

import cv2
import numpy as np

from gsmerge.arrays import Array, as_array, like
from gsmerge.method.kernels.superpixels.bass import (
    corner_response,
    hexagonal_seeds,
    infer_labels,
    seed_density,
    seeds_from_density,
    voronoi,
)
from gsmerge.method.kernels.superpixels.regions import pad_labels, refine, split_rectangles
from gsmerge.method.kernels.superpixels.ward import merge_regions
from gsmerge.method.stages.limits import count_for
from gsmerge.runtime.threads import parallel_map
from gsmerge.settings.stages import SegmentOptions
from gsmerge.types import Groups

# defaults of rdseg: rectangles per superpixel, and sweeps before they are merged
RECTANGLES = 2.0
EARLY_SWEEPS = 0


def segment(images: np.ndarray, options: SegmentOptions, count: int | None = None) -> Groups:
    """Cut every view into the same number of superpixels.

    ``images [v,h,w,3]`` are float in [0, 1] or uint8. ``count`` is the number of superpixels per view, by default that
    of the options.
    """
    if images.ndim != 4 or images.shape[3] != 3:
        raise ValueError(f"images: expected shape [v, h, w, 3], got {list(images.shape)}")
    _, height, width, _ = images.shape
    count = count_for(options, height, width) if count is None else count
    rectangles = RECTANGLES if options.rectangles is None else options.rectangles
    early_sweeps = EARLY_SWEEPS if options.early_sweeps is None else options.early_sweeps

    cut = partial(
        superpixels, count=count, segmentation=options.segmentation, rectangles=rectangles,
        early_sweeps=early_sweeps, compactness=options.compactness,
    )  # fmt: skip
    labels = parallel_map(cut, images)
    stacked = np.stack(labels) if labels else np.empty((0, height, width), np.int32)
    return Groups(stacked, tuple(int(view_labels.max()) + 1 for view_labels in labels))


def superpixels(
    image: Array,
    count: int,
    segmentation: str = "rdseg",
    *,
    rectangles: float = RECTANGLES,
    early_sweeps: int = EARLY_SWEEPS,
    compactness: float = 1e-5,
) -> Array:
    """Cut an image into exactly ``count`` superpixels, each non-empty and 4-connected.

    Args:
        image: ``[h,w,3]`` sRGB, float in [0, 1] or uint8, as an array or a tensor.
        count: Superpixels, 1 to h·w.
        segmentation: ``rdseg``, ``bass``, ``bass-st``, ``slic`` or ``grid``.
        rectangles: For ``rdseg``: rectangles per superpixel before merging, at least 1.
        early_sweeps: For ``rdseg``: sweeps over border pixels before merging.
        compactness: Weight of squared pixels, relative to squared colours, in [0, 1] (not for the BASS methods).

    Returns:
        Labels ``[h,w]`` int32 from 0 on without gaps, the same in every run. A tensor gives a tensor.

    Raises:
        ValueError: If an argument is out of range, or ``slic`` is asked for without scikit-image.

    Example:
        >>> labels = gsmerge.superpixels(gsmerge.read_scene("demo").images[0], 60)
        >>> labels.shape, int(labels.max())
        ((32, 48), 59)
    """
    SegmentOptions(segmentation=segmentation, rectangles=rectangles, compactness=compactness)  # checks the values
    pixels = _as_pixels(as_array(image))
    height, width, _ = pixels.shape
    if count < 1:
        raise ValueError(f"count: expected at least 1 superpixel, got {count}")
    if count > height * width:
        raise ValueError(
            f"count: expected at most {height * width} superpixels ({width} x {height} pixels), got {count}"
        )
    if segmentation == "grid":
        return like(grid_labels(height, width, count), image)
    if segmentation == "rdseg":
        spread = np.float32(compactness**0.5)
        num_rectangles = int(rectangles * count)
        pixel_start = 0.45  # with more rectangles per pixel than this, the pixels themselves are merged instead
        if num_rectangles > pixel_start * height * width:
            num_regions = height * width  # every pixel is its own region
            labels = pad_labels(np.arange(num_regions, dtype=np.int32).reshape(height, width))
        else:
            block_side = 32  # side in pixels of the squares that are cut into rectangles
            labels, num_regions = split_rectangles(pixels, num_rectangles, block_side, float(compactness))
            labels = refine(labels, pixels, num_regions, early_sweeps, spread)
        labels = merge_regions(labels, pixels, num_regions, count, spread)
        num_sweeps = 2  # most sweeps in which each pixel may change to a neighbouring region
        labels = refine(labels, pixels, count, num_sweeps, spread)
    elif segmentation == "slic":
        pieces, num_pieces = _slic(pixels, count)
        labels = merge_regions(pieces, pixels, num_pieces, count, np.float32(compactness**0.5))
    else:
        if segmentation == "bass":
            seeds = hexagonal_seeds(height, width, count)
        else:
            seeds = seeds_from_density(seed_density(corner_response(pixels), count), count)
        colours = np.ascontiguousarray(_to_lab(pixels) / np.float32(100))
        labels = infer_labels(pad_labels(voronoi(seeds, height, width)), colours, count)
    return like(np.ascontiguousarray(labels[1:-1, 1:-1]), image)


def _slic(pixels: np.ndarray, count: int) -> tuple[np.ndarray, int]:
    """Cut an image by scikit-image's SLIC into at least ``count`` pieces; return padded labels, and their number."""
    try:
        from skimage.measure import label
        from skimage.segmentation import slic
    except ImportError as error:
        raise ValueError("segmentation slic: scikit-image is not installed; run pip install scikit-image") from error
    lab = _to_lab(pixels)
    height, width, _ = pixels.shape
    asked = count
    compactness = 10 / max(float(np.ptp(lab)), 1e-3)  # its default; SLIC scales colours to [0, 1]
    while asked < height * width:
        pieces = slic(lab, asked, compactness, start_label=0, channel_axis=-1, convert2lab=False)
        pieces, num_pieces = label(pieces, background=-1, return_num=True, connectivity=1)
        if num_pieces >= count:
            return pad_labels((pieces - 1).astype(np.int32)), num_pieces
        asked += 1 + asked // 10  # SLIC makes about as many as it is asked for, and these are joined to the number
    return pad_labels(np.arange(height * width, dtype=np.int32).reshape(height, width)), height * width


def _to_lab(pixels: np.ndarray) -> np.ndarray:
    """Convert sRGB to CIELAB by OpenCV's tables, so that the bits are the same on every processor."""
    return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_RGB2Lab))


def grid_labels(height: int, width: int, count: int) -> np.ndarray:
    """Return labels ``[h,w]`` int32 of ``count`` rectangles in rows of equal or almost equal numbers."""
    min_rows = -(-count // width)  # least number of rows in which each rectangle has a pixel
    num_rows = min(height, count, max(min_rows, round((count * height / width) ** 0.5)))
    first_labels = np.arange(num_rows + 1) * count // num_rows  # first label of each row of rectangles
    row = np.arange(height) * num_rows // height  # row of rectangles that contains each row of pixels
    num_columns = np.diff(first_labels)[row]
    return (first_labels[row][:, None] + np.arange(width) * num_columns[:, None] // width).astype(np.int32)


def saliency(image: Array) -> Array:
    """Compute the Shi-Tomasi corner response of the grey image, over 3 x 3 pixels.

    The response is the smaller eigenvalue of the structure tensor.

    Args:
        image: ``[h,w,3]`` sRGB, float in [0, 1] or uint8, as an array or a tensor.

    Returns:
        ``[h,w]`` float32, at least 0, and 0 everywhere in a flat image. A tensor gives a tensor.

    Raises:
        ValueError: If the image has the wrong shape or range.

    Example:
        >>> gsmerge.saliency(gsmerge.read_scene("demo").images[0]).shape
        (32, 48)
    """
    return like(corner_response(_as_pixels(as_array(image))), image)


def scene_saliency(images: np.ndarray) -> np.ndarray:
    """Return the :func:`saliency` of every pixel of all views ``[v,h,w,3]`` as one array ``[v·h·w]``."""
    return np.concatenate(parallel_map(lambda image: corner_response(_as_pixels(image)).reshape(-1), images))


def _as_pixels(array: np.ndarray) -> np.ndarray:
    """Return an image as contiguous float32 ``[h,w,3]``, or raise ValueError if its values are not in [0, 1]."""
    if array.ndim != 3 or array.shape[2] != 3 or array.size == 0:
        raise ValueError(f"image: expected shape [h, w, 3], got {list(array.shape)}")
    if array.dtype == np.uint8:
        return np.divide(array, np.float32(255), dtype=np.float32, order="C")
    if not np.issubdtype(array.dtype, np.floating):
        raise ValueError(f"image: expected uint8 or float, got {array.dtype}")
    low = array.min()
    high = array.max()
    range_slack = 1e-3  # colours may leave [0, 1] by this much, because resampling makes such values
    if not (low >= -range_slack and high <= 1 + range_slack):  # also refuses NaN
        raise ValueError(f"image: expected values in [0, 1], got {low:g} to {high:g}")
    return np.ascontiguousarray(array, np.float32)
