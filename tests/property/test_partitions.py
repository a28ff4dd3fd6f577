"""Any picture and segmentation gives the exact number of superpixels, each in one piece and none empty."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from skimage.measure import label as connected_parts

from gsmerge.method.stages.superpixels import superpixels

SEGMENTATIONS = [
    ("rdseg", {"rectangles": 1.0, "early_sweeps": 0}),
    ("rdseg", {}),
    ("rdseg", {"rectangles": 3.0, "early_sweeps": 1}),
    ("bass", {}),
    ("bass-st", {}),
    ("slic", {}),
    *(("rdseg", {"compactness": value}) for value in (0.0, 1e-3, 1.0)),
]


def noise(height: int, width: int) -> np.ndarray:
    return np.random.default_rng(height * 1000 + width).random((height, width, 3), dtype=np.float32)


def checkerboard(height: int, width: int) -> np.ndarray:
    return np.repeat((np.indices((height, width)).sum(0) % 2)[..., None], 3, 2).astype(np.float32)


PICTURES = {
    "constant": np.full((24, 31, 3), 0.3),
    "black": np.zeros((16, 20, 3)),
    "white": np.ones((16, 20, 3)),
    "noise": noise(25, 33),
    "row": noise(1, 60),
    "column": noise(60, 1),
    "3x3": noise(3, 3),
    "two-tone": np.repeat(np.repeat(np.array([[[0.0], [1.0]]]), 20, 0), 3, 2).repeat(15, 1),
    "checkerboard": checkerboard(24, 24),
    "blocks": np.kron(noise(3, 4), np.ones((11, 13, 1))),
}


def assert_partition(labels: np.ndarray, height: int, width: int, count: int) -> None:
    assert labels.shape == (height, width)
    assert labels.dtype == np.int32
    assert np.array_equal(np.unique(labels), np.arange(count))
    assert connected_parts(labels, connectivity=1, background=-1).max() == count


def counts_of(num_pixels: int) -> list[int]:
    expected = {1, 2, num_pixels // 10, num_pixels // 3, num_pixels - 1, num_pixels}
    return sorted(k for k in expected if k >= 1)


@pytest.mark.parametrize("picture", PICTURES)
@pytest.mark.parametrize(("segmentation", "options"), SEGMENTATIONS)
def test_partitions_are_exact_for_any_picture_and_segmentation(
    picture: str, segmentation: str, options: dict[str, Any]
) -> None:
    image = PICTURES[picture]
    height, width, _ = image.shape
    for count in counts_of(height * width):
        labels = superpixels(image, count, segmentation, **options)
        assert_partition(labels, height, width, count)


@settings(max_examples=25, deadline=None, derandomize=True)
@given(
    height=st.integers(1, 20),
    width=st.integers(1, 20),
    share=st.floats(0, 1),
    colours=st.integers(1, 5),
    kind=st.sampled_from(SEGMENTATIONS),
    seed=st.integers(0, 999),
)
def test_partitions_are_exact_for_any_size(
    height: int, width: int, share: float, colours: int, kind: tuple[str, str], seed: int
) -> None:
    """Few colours make ties; sizes down to one pixel."""
    image = np.random.default_rng(seed).integers(0, colours, (height, width, 3)) / max(colours - 1, 1)
    count = 1 + int(share * (height * width - 1))
    assert_partition(superpixels(image, count, kind[0], **kind[1]), height, width, count)
