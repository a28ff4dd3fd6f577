"""The image loss matches autograd of a plain float64 loss."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from slow_steps import differentiate_rows, image_gradient

from gsmerge.method.kernels.raster.step import C1, C2

torch = pytest.importorskip("torch", reason="torch is not installed")
avg_pool2d = torch.nn.functional.avg_pool2d

SIZES = [(20, 17), (7, 7), (3, 5), (1, 9)]


def pictures(size: tuple[int, int], seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a render, a photo and weights of the pixels (a part of them zero)."""
    rng = np.random.default_rng(seed)
    photo = rng.uniform(0, 1, (*size, 3))
    image = photo + rng.normal(size=photo.shape) * 0.2
    weight = rng.uniform(0.2, 1, size) * (rng.random(size) > 0.2)
    return image.astype(np.float32), photo.astype(np.float32), weight.astype(np.float32)


def box(images: torch.Tensor) -> torch.Tensor:
    """Return means over 7 x 7 windows of ``[h,w,3]``, zero beyond the border."""
    return avg_pool2d(images.permute(2, 0, 1)[None], 7, 1, 3, count_include_pad=True)[0].permute(1, 2, 0)


def similarity(image: torch.Tensor, photo: torch.Tensor) -> torch.Tensor:
    """Return the SSIM ``[h,w,3]`` (Wang et al., 2004)."""
    mx, my = box(image), box(photo)
    xx, yy, xy = box(image * image) - mx * mx, box(photo * photo) - my * my, box(image * photo) - mx * my
    c1, c2 = float(C1), float(C2)
    return (2 * mx * my + c1) * (2 * xy + c2) / ((mx * mx + my * my + c1) * (xx + yy + c2))


def loss(
    image: torch.Tensor, photo: torch.Tensor, weight: torch.Tensor, ssim_lambda: float, edge_weight: float = 0.0
) -> torch.Tensor:
    off = image - photo
    each = (1 - ssim_lambda) * off.abs() + ssim_lambda * (1 - similarity(image, photo))
    down = torch.minimum(weight[1:], weight[:-1])[..., None] * (off[1:] - off[:-1]).abs()
    along = torch.minimum(weight[:, 1:], weight[:, :-1])[..., None] * (off[:, 1:] - off[:, :-1]).abs()
    edges = down.sum() + along.sum()
    return ((weight[..., None] * each).sum() + edge_weight * edges) / (image.shape[0] * image.shape[1])


def autograd(
    image: np.ndarray, photo: np.ndarray, weight: np.ndarray, ssim_lambda: float, edge_weight: float
) -> np.ndarray:
    variable = torch.from_numpy(image).double().requires_grad_()
    others = torch.from_numpy(photo).double(), torch.from_numpy(weight).double()
    loss(variable, *others, ssim_lambda, edge_weight).backward()
    return variable.grad.numpy()


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize(("ssim_lambda", "edge_weight"), [(0.0, 0.0), (0.2, 0.0), (1.0, 0.0), (0.2, 1.2), (1.0, 3.0)])
@pytest.mark.parametrize("weighted", [True, False])
def test_gradient_matches_autograd(
    size: tuple[int, int], ssim_lambda: float, edge_weight: float, weighted: bool
) -> None:
    image, photo, weight = pictures(size)
    weight = weight if weighted else np.ones_like(weight)
    actual, _ = image_gradient(image, photo, weight, ssim_lambda, edge_weight)
    reference = autograd(image, photo, weight, ssim_lambda, edge_weight)
    assert actual.dtype == np.float32
    assert np.linalg.norm(actual - reference) <= 1e-3 * np.linalg.norm(reference)


@pytest.mark.parametrize("cuts", [[0, 20], [0, 7, 20], list(range(21))])
def test_rows_do_not_depend_on_how_they_are_shared_out(cuts: list[int]) -> None:
    image, photo, weight = pictures((20, 17))
    whole, error = image_gradient(image, photo, weight, 0.2, 1.2)
    flat, goal = image.reshape(20, -1), photo.reshape(20, -1)
    gradient, errors = np.empty_like(flat), np.empty(20, np.float32)
    for first, last in pairwise(cuts):
        differentiate_rows(flat, goal, weight, 0.2, 1.2, first, last, gradient, errors)
    np.testing.assert_array_equal(gradient, whole.reshape(20, -1))
    assert float(errors.sum(dtype=np.float64)) == error


@pytest.mark.parametrize("size", SIZES)
def test_error_is_the_weighted_square(size: tuple[int, int]) -> None:
    image, photo, weight = pictures(size)
    expected = (weight[..., None] * (image - photo).astype(np.float64) ** 2).sum()
    assert image_gradient(image, photo, weight, 0.2)[1] == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("ssim_lambda", [0.0, 0.2, 1.0])
def test_gradient_is_zero_where_the_image_is_the_photo(ssim_lambda: float) -> None:
    _, photo, weight = pictures((16, 16))
    assert np.abs(image_gradient(photo, photo, weight, ssim_lambda, 1.2)[0]).max() < 1e-5


def test_another_exposure_has_no_edges_of_its_own() -> None:
    _, photo, weight = pictures((16, 16))
    brighter = np.full_like(photo, 0.25)
    plain, _ = image_gradient(brighter, 0 * photo, weight, 0.0)
    np.testing.assert_array_equal(image_gradient(brighter, 0 * photo, weight, 0.0, 1.2)[0], plain)


def test_pixels_without_weight_teach_nothing() -> None:
    """Nor do windows about them; what is learnt near them is of their neighbours' windows."""
    image, photo, _ = pictures((40, 40))
    weight = np.ones((40, 40), np.float32)
    weight[:, 20:] = 0
    gradient, _ = image_gradient(image, photo, weight, 0.2, 1.2)
    assert (gradient[:, 23:] == 0).all()
    assert (gradient[:, :20] != 0).any(-1).all()
    elsewhere = photo.copy()
    elsewhere[:, 23:] = 0.3  # seen by no window of a weighted pixel
    np.testing.assert_allclose(image_gradient(image, elsewhere, weight, 0.2, 1.2)[0], gradient, atol=1e-7)


def test_gradients_of_flat_pictures_are_finite() -> None:
    flat, weight = np.zeros((9, 9, 3), np.float32), np.ones((9, 9), np.float32)
    for image in (flat, flat + 1):
        assert np.isfinite(image_gradient(image, flat, weight, 0.2, 1.2)[0]).all()
    assert np.isfinite(image_gradient(flat, flat + 1, 0 * weight, 0.2, 1.2)[0]).all()
