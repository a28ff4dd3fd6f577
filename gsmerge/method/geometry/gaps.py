"""Fill gaps of pictures."""

from __future__ import annotations

import cv2
import numpy as np


def fill_gaps(picture: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Fill the pixels of a picture ``[h,w,c]`` outside ``valid [h,w]`` with the values of the nearest pixel inside."""
    if valid.all() or not valid.any():
        return picture
    _, labels = cv2.distanceTransformWithLabels(
        (~valid).astype(np.uint8), cv2.DIST_L1, 3, labelType=cv2.DIST_LABEL_PIXEL
    )
    nearest = np.zeros(int(labels.max()) + 1, np.int64)
    nearest[labels[valid]] = np.flatnonzero(valid)
    return np.asarray(picture.reshape(valid.size, -1)[nearest[labels]])
