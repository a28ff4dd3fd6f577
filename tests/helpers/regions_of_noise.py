"""These functions compute the error that superpixels minimise, slowly, and what touches what."""

from __future__ import annotations

import numpy as np

RING = ((0, 1), (0, 2), (1, 2), (2, 2), (2, 1), (2, 0), (1, 0), (0, 0))  # N, NE, E, SE, S, SW, W, NW of 3 x 3
COMPACTNESS = 1e-3
SPREAD = np.float32(COMPACTNESS**0.5)


def features(pixels: np.ndarray) -> np.ndarray:
    """Return ``[n,5]`` float64: colours and weighted positions."""
    y, x = np.mgrid[: pixels.shape[0], : pixels.shape[1]] * float(SPREAD)
    return np.concatenate([pixels.reshape(-1, 3).astype(np.float64), y.reshape(-1, 1), x.reshape(-1, 1)], 1)


def squared_error(points: np.ndarray) -> float:
    return float(((points - points.mean(0)) ** 2).sum()) if len(points) else 0.0


def total_error(pixels: np.ndarray, labels: np.ndarray) -> float:
    points, flat = features(pixels), labels.reshape(-1)
    return sum(squared_error(points[flat == k]) for k in np.unique(flat))


def ring_of(mask: int) -> np.ndarray:
    cells = np.zeros((3, 3), int)
    for bit, place in enumerate(RING):
        cells[place] = mask >> bit & 1
    return cells


def neighbours(labels: np.ndarray) -> set[tuple[int, int]]:
    pairs = np.concatenate(
        [
            np.stack([labels[:, :-1].reshape(-1), labels[:, 1:].reshape(-1)], 1),
            np.stack([labels[:-1].reshape(-1), labels[1:].reshape(-1)], 1),
        ]
    )
    return {(int(min(p)), int(max(p))) for p in pairs if p[0] != p[1]}
