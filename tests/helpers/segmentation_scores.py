"""Photos that come with scikit-image and scikit-learn tell what superpixels of them are worth."""

from __future__ import annotations

import cv2
import numpy as np

from gsmerge.method.kernels import elementary

SIDE = 476  # longer side of the photos, pixels; densities are superpixels per SIDE x SIDE pixels
DENSITIES = (5_000, 12_000, 23_000)


def photos() -> dict[str, np.ndarray]:
    """Return six photos, ``[h,w,3]`` uint8, the longer side 476 pixels."""
    import skimage.data  # here, since the two take seconds that each process of a run of tests would spend
    import sklearn.datasets

    actual = {name: getattr(skimage.data, name)() for name in ("astronaut", "coffee", "chelsea", "rocket")}
    actual |= {name: sklearn.datasets.load_sample_image(f"{name}.jpg") for name in ("china", "flower")}
    return {name: shrink(image) for name, image in actual.items()}


def shrink(image: np.ndarray) -> np.ndarray:
    """Return a photo whose longer side is 476 pixels."""
    height, width, _ = image.shape
    scale = SIDE / max(height, width)
    return cv2.resize(image, (round(width * scale), round(height * scale)), interpolation=cv2.INTER_AREA)


def count_at(image: np.ndarray, density: int) -> int:
    """Return the number of superpixels of ``image`` at so many per 476 x 476 pixels."""
    return round(density * image.shape[0] * image.shape[1] / SIDE**2)


def _means(values: np.ndarray, labels: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    return np.bincount(labels, values.reshape(-1)) / sizes


def _psnr(image: np.ndarray, other: np.ndarray) -> float:
    return float(-10 * elementary.log10(np.mean((image - other) ** 2)))


def proxy_psnr(image: np.ndarray, labels: np.ndarray) -> float:
    """Return the PSNR of the picture in which every superpixel has its mean colour, dB.

    Args:
        image: ``[h,w,3]`` uint8.
        labels: ``[h,w]``, dense from 0.
    """
    colours, flat = image / 255.0, labels.reshape(-1)
    sizes = np.bincount(flat)
    means = np.stack([_means(colours[..., i], flat, sizes) for i in range(3)], 1)
    return _psnr(colours, means[flat].reshape(image.shape))


def splat_psnr(image: np.ndarray, labels: np.ndarray) -> float:
    """Return the PSNR of the picture blended from one Gaussian per superpixel, dB: does its shape suit a Gaussian?

    Each Gaussian has the mean, the halved covariance (of the pixels' areas, hence + 1/12) and the mean colour of its
    superpixel; weights are normalised, and cut at three standard deviations.
    """
    height, width = labels.shape
    flat, colours = labels.reshape(-1), image / 255.0
    sizes = np.bincount(flat)
    ys, xs = (grid.reshape(-1) for grid in np.mgrid[:height, :width])
    mean_y, mean_x = _means(ys, flat, sizes), _means(xs, flat, sizes)
    dy, dx = ys - mean_y[flat], xs - mean_x[flat]
    yy, xx = (_means(dy * dy, flat, sizes) + 1 / 12) / 2, (_means(dx * dx, flat, sizes) + 1 / 12) / 2
    xy = _means(dx * dy, flat, sizes) / 2
    det = yy * xx - xy * xy
    means = np.stack([_means(colours[..., i], flat, sizes) for i in range(3)], 1)
    picture, weights = np.zeros(image.shape), np.full((height, width, 1), 1e-12)
    reach_y, reach_x = np.ceil(3 * np.sqrt(yy)) + 1, np.ceil(3 * np.sqrt(xx)) + 1
    for k in range(len(sizes)):
        top, left = max(0, int(mean_y[k] - reach_y[k])), max(0, int(mean_x[k] - reach_x[k]))
        bottom, right = int(mean_y[k] + reach_y[k]) + 1, int(mean_x[k] + reach_x[k]) + 1
        v, u = np.ogrid[top : min(bottom, height), left : min(right, width)]
        v, u = v - mean_y[k], u - mean_x[k]
        weight = elementary.exp(-0.5 * (xx[k] * v * v - 2 * xy[k] * u * v + yy[k] * u * u) / det[k])[..., None]
        picture[top:bottom, left:right] += weight * means[k]
        weights[top:bottom, left:right] += weight
    return _psnr(colours, picture / weights)
