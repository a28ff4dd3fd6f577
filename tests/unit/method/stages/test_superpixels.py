"""Superpixels follow colours, and their number is exact."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import pytest
from messages import refuses

from gsmerge.method.kernels.superpixels.bass import seed_density, seeds_from_density
from gsmerge.method.stages.limits import count_for
from gsmerge.method.stages.superpixels import saliency, segment, superpixels
from gsmerge.settings.stages import SEGMENTATIONS, SegmentOptions


def random_image(height: int, width: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).random((height, width, 3), dtype=np.float32)


def test_two_colours_part_where_they_meet() -> None:
    image = np.zeros((12, 17, 3))
    image[:, 7:] = 1
    labels = superpixels(image, 2)
    assert len(np.unique(labels[:, :7])) == 1
    assert len(np.unique(labels[:, 7:])) == 1
    assert labels[0, 0] != labels[0, 16]


@pytest.mark.parametrize("segmentation", ["rdseg", "bass-st"])
def test_detail_gets_the_superpixels(segmentation: str) -> None:
    image = np.full((64, 64, 3), 0.5)
    image[:, 32:] = random_image(64, 32)
    labels = superpixels(image, 200, segmentation)
    assert len(np.unique(labels[:, 34:])) > 2 * len(np.unique(labels[:, :30])), segmentation


def test_superpixels_of_bytes_and_of_floats_are_the_same() -> None:
    image = (random_image(20, 30) * 255).astype(np.uint8)
    expected = superpixels(image, 40)
    assert np.array_equal(superpixels(image / 255.0, 40), expected)
    assert np.array_equal(superpixels(np.asfortranarray(image), 40), expected)
    assert expected.dtype == np.int32


@pytest.mark.parametrize("segmentation", SEGMENTATIONS)
def test_tensors_give_tensors(segmentation: str, torch: Any) -> None:
    """With the labels and the saliency of arrays; one that collects gradients, too."""
    image = random_image(20, 30)
    bytes_, followed = torch.from_numpy((image * 255).astype(np.uint8)), torch.from_numpy(image).requires_grad_()
    for tensor in (torch.from_numpy(image), followed, bytes_):
        labels, response = superpixels(tensor, 40, segmentation), saliency(tensor)
        assert labels.dtype == torch.int32
        assert response.dtype == torch.float32
        array = tensor.detach().numpy()
        assert isinstance(superpixels(array, 40, segmentation), np.ndarray)
        assert np.array_equal(labels.numpy(), superpixels(array, 40, segmentation))
        assert np.array_equal(response.numpy(), saliency(array))


@pytest.mark.parametrize("segmentation", SEGMENTATIONS)
def test_count_out_of_range_is_refused(segmentation: str) -> None:
    image = random_image(4, 5)
    with refuses(ValueError, "count", 20, 21):
        superpixels(image, 21, segmentation)
    with refuses(ValueError, "count", 1, 0):
        superpixels(image, 0, segmentation)


@pytest.mark.parametrize(
    ("image", "found"),
    [
        (np.zeros((4, 4)), [4, 4]), (np.zeros((4, 4, 4)), [4, 4, 4]), (np.zeros((0, 4, 3)), [0, 4, 3]),
        (np.full((4, 4, 3), 255.0), "255 to 255"), (np.full((4, 4, 3), np.nan), "nan"),
        (np.full((4, 4, 3), np.inf), "inf"), (np.zeros((4, 4, 3), np.int64), "int64"),
    ],
)  # fmt: skip
def test_image_of_a_wrong_shape_or_type_is_refused(image: np.ndarray, found: object) -> None:
    for use in (lambda: superpixels(image, 2), lambda: saliency(image)):
        with refuses(ValueError, "image", found):
            use()


def test_count_follows_a_number_or_a_share_of_pixels() -> None:
    assert count_for(SegmentOptions(superpixels=7), 100, 100) == 7
    assert count_for(SegmentOptions(superpixels="5%"), 20, 30) == 30
    assert count_for(SegmentOptions(superpixels="0.1%"), 5, 5) == 1


def test_number_or_share_of_no_superpixels_is_refused() -> None:
    with refuses(ValueError, "superpixels", 1, 0):
        SegmentOptions(superpixels=0)
    with refuses(ValueError, "superpixels", "4.4%", "'0%'"):
        SegmentOptions(superpixels="0%")


def test_segment_treats_each_view_alone() -> None:
    images = np.stack([random_image(16, 24, seed) for seed in range(3)])
    groups = segment(images, SegmentOptions(superpixels="10%"))
    assert groups.counts == (38, 38, 38)
    for view in range(3):
        assert np.array_equal(groups.labels[view], superpixels(images[view], 38))
    assert segment(images, SegmentOptions(), count=5).counts == (5, 5, 5)
    assert segment(images[:0], SegmentOptions()).labels.shape == (0, 16, 24)
    with refuses(ValueError, "images", "[v, h, w, 3]", [16, 24, 3]):
        segment(images[0], SegmentOptions())


def test_saliency_is_high_at_a_corner_only() -> None:
    image = np.zeros((21, 21, 3))
    image[10:, 10:] = 1
    response = saliency(image)
    assert response.dtype == np.float32
    y, x = divmod(int(response.argmax()), 21)
    assert abs(y - 10) <= 1
    assert abs(x - 10) <= 1
    assert response[0:5].max() == 0  # flat
    assert response[20, 5:15].max() < 1e-6  # straight edge


@pytest.mark.parametrize("value", [0.0, 1.0])
def test_flat_pictures_get_even_seeds(value: float) -> None:
    response = saliency(np.full((40, 60, 3), value))
    assert response.max() == 0
    density = seed_density(response, 240)
    assert density == pytest.approx(np.full((40, 60), 0.1))
    seeds = seeds_from_density(density, 240)
    quarters = np.histogram2d(seeds[:, 0], seeds[:, 1], bins=2, range=[[0, 40], [0, 60]])[0]
    assert quarters == pytest.approx(np.full((2, 2), 60), abs=6)


def test_slic_without_its_package_says_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "skimage.segmentation", None)
    with pytest.raises(ValueError, match="pip install scikit-image"):
        superpixels(np.zeros((8, 8, 3), np.float32), 4, "slic")
