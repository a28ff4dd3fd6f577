"""The region of a crop, from its text."""

from __future__ import annotations

import numpy as np

from gsmerge.method.geometry.transforms import euler_to_rotmat, lies_inside
from gsmerge.settings.stages import parse_crop
from gsmerge.types import Region


def find_region(crop: str) -> Region:
    """Return the region that the text of a crop describes, in world units."""
    shape, parsed = parse_crop(crop)
    numbers = np.array(parsed)
    if shape == "sphere":
        return Region(numbers[:3], np.full(3, numbers[3]), np.eye(3), is_sphere=True)
    low = numbers[:3]
    high = numbers[3:6]
    degrees = np.pad(numbers[6:], (0, 9 - len(numbers)))
    rotation = euler_to_rotmat(degrees).T if degrees.any() else np.eye(3)
    return Region((low + high) / 2, (high - low) / 2, rotation, is_sphere=False)


def inside_crop(means: np.ndarray, crop: str) -> np.ndarray:
    """Return a mask ``[n]`` of the world-frame centres ``[n,3]`` inside a crop, border included."""
    return lies_inside(find_region(crop), means)
