"""Superpixels on a device: exact numbers, connected, and worth as much as the kernels'."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch
from segmentation_scores import photos, proxy_psnr
from skimage.measure import label

from gsmerge.gpu.rectangles import split_rectangles
from gsmerge.gpu.regions import adjacent_pairs, merge_regions, move_borders, pixel_features
from gsmerge.gpu.segment import covers, segment
from gsmerge.kernels.superpixels import kd, sweeps, ward
from gsmerge.kernels.superpixels.regions import pad_labels
from gsmerge.stages.segment import SEGMENTATIONS, SegmentOptions, superpixels

SPREAD = 1e-5**0.5


@pytest.fixture(scope="module")
def pictures() -> np.ndarray:
    """``[2,h,w,3]`` float32 in [0, 1]: pieces of two photos."""
    sources = [photos()[name] for name in ("astronaut", "coffee")]
    small = [cv2.resize(image, (106, 84), interpolation=cv2.INTER_AREA)[:76, :98] for image in sources]
    return np.stack(small).astype(np.float32) / 255


def squared_error(picture: np.ndarray, labels: np.ndarray) -> float:
    """Of the colours about the means of their regions, and of places about their own, at the weight of the default."""
    places = np.stack(np.mgrid[: picture.shape[0], : picture.shape[1]], -1) * SPREAD
    features, flat = np.concatenate([picture, places], -1).reshape(-1, 5).astype(float), labels.reshape(-1)
    sizes = np.bincount(flat)
    means = np.stack([np.bincount(flat, features[:, i]) / sizes for i in range(5)], 1)
    return float(((features - means[flat]) ** 2).sum())


def assert_partition(labels: np.ndarray, count: int) -> None:
    """``count`` labels of one view, each 4-connected."""
    assert np.array_equal(np.unique(labels), np.arange(count))
    assert label(labels + 1, connectivity=1, background=0).max() == count


@pytest.mark.parametrize("count", [1, 40, 300])
@pytest.mark.parametrize("effort", ["draft", "default", "best"])
def test_superpixels_are_exact_connected_and_as_good(pictures: np.ndarray, count: int, effort: str) -> None:
    options = SegmentOptions(effort=effort)
    labels = segment(torch.from_numpy(pictures), options, count).numpy()
    gaps = []
    for picture, ours in zip(pictures, labels, strict=True):
        assert_partition(ours, count)
        theirs = superpixels(picture, count, effort=effort)
        gaps.append(proxy_psnr(picture * 255, ours) - proxy_psnr(picture * 255, theirs))
    assert np.mean(gaps) > -0.3


def test_every_pixel_may_be_the_start(pictures: np.ndarray) -> None:
    few = pictures[:, :20, :24]
    labels = segment(torch.from_numpy(few), SegmentOptions(), 200).numpy()
    for picture, ours in zip(few, labels, strict=True):
        assert_partition(ours, 200)
        assert proxy_psnr(picture * 255, ours) > proxy_psnr(picture * 255, superpixels(picture, 200)) - 0.3


def test_flat_and_tiny_pictures() -> None:
    for shape, count in (((1, 40, 50, 3), 70), ((2, 1, 7, 3), 3), ((1, 5, 1, 3), 5), ((1, 1, 1, 3), 1)):
        for ours in segment(torch.full(shape, 0.5), SegmentOptions(), count).numpy():
            assert_partition(ours, count)


def test_views_do_not_depend_on_each_other(pictures: np.ndarray) -> None:
    both = segment(torch.from_numpy(pictures), SegmentOptions(), 150)
    for view in range(2):
        assert torch.equal(both[view], segment(torch.from_numpy(pictures[view : view + 1]), SegmentOptions(), 150)[0])


def test_rectangles_are_worth_the_kernels(pictures: np.ndarray) -> None:
    """The kernel takes cuts of nearly equal gains in any order."""
    labels, each = split_rectangles(torch.from_numpy(pictures), 400, 32, 1e-5)
    assert each == 400
    for view, picture in enumerate(pictures):
        ours = labels[view].numpy() - 400 * view
        assert_partition(ours, 400)
        for number in range(0, 400, 7):
            rows, columns = np.nonzero(ours == number)
            assert len(rows) == (np.ptp(rows) + 1) * (np.ptp(columns) + 1)
        padded, _ = kd.split_rectangles(picture, 400, 32, 1e-5)
        assert squared_error(picture, ours) < 1.01 * squared_error(picture, padded[1:-1, 1:-1])


def test_blocks_may_be_more_than_are_asked_for(pictures: np.ndarray) -> None:
    labels, each = split_rectangles(torch.from_numpy(pictures), 2, 32, 1e-5)
    assert each == (76 // 32) * (98 // 32) == len(torch.unique(labels[0]))


def test_merging_is_worth_the_kernels(pictures: np.ndarray) -> None:
    padded, each = kd.split_rectangles(pictures[0], 400, 32, 1e-5)
    start = torch.from_numpy(padded[1:-1, 1:-1].astype(np.int64))[None]
    ours = merge_regions(start, pixel_features(torch.from_numpy(pictures[:1])), each, 150, SPREAD)[0].numpy()
    theirs = ward.merge_regions(padded, pictures[0], each, 150, np.float32(SPREAD))[1:-1, 1:-1]
    assert_partition(ours, 150)
    assert squared_error(pictures[0], ours) == pytest.approx(squared_error(pictures[0], theirs), rel=0.02)


def test_pairs_are_the_kernels(pictures: np.ndarray) -> None:
    padded, _ = kd.split_rectangles(pictures[1], 90, 32, 1e-5)
    ours = adjacent_pairs(torch.from_numpy(padded[None, 1:-1, 1:-1].astype(np.int64))).numpy()
    assert sorted(map(tuple, ours)) == sorted(map(tuple, ward.adjacent_pairs(padded)))


def test_every_pass_of_moves_lowers_the_error(pictures: np.ndarray) -> None:
    tensor = torch.from_numpy(pictures)
    start, each = split_rectangles(tensor, 150, 32, 1e-5)
    errors = []
    for passes in (0, 1, 2, 6):
        labels = move_borders(start, pixel_features(tensor), 2 * each, passes, SPREAD).numpy()
        assert_partition(labels[0], each)
        errors.append(squared_error(pictures[0], labels[0]))
    assert errors == sorted(errors, reverse=True)
    swept = sweeps.refine(pad_labels(start[0].numpy()), pictures[0], each, 2, np.float32(SPREAD))
    assert errors[-1] < 1.02 * squared_error(pictures[0], swept[1:-1, 1:-1])


def test_only_one_method_is_covered() -> None:
    assert [name for name in SEGMENTATIONS if covers(SegmentOptions(segmentation=name))] == ["rdseg"]
