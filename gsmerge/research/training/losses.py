"""Compute losses: renders compared with photos, and regularizers.

All Feature Gaussians that reach into a window of a photo run through all networks, and the window is rendered from them
(paper section 4.6). Pixels that the scene does not cover have no loss, so networks need not guess them. LPIPS has the
values of :mod:`gsmerge.scoring.lpips`, and torch can differentiate it. Two regularizers act in early training. One
penalises Gaussians that are far from the moments of their groups (the "teacher" of the paper). The other penalises
children of one group that lie upon each other.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from itertools import permutations, product

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from gsmerge.method.geometry.pooling import Members, pool_members, to_gaussians
from gsmerge.method.kernels.raster.step import C1, C2, WINDOW_SIDE
from gsmerge.method.networks.tensors import gaussian_sizes, quat_to_rotmat, skew_vectors
from gsmerge.method.raster.autograd import render_tensors
from gsmerge.method.raster.photos import NEAR_PLANE
from gsmerge.research.training.modules import Networks
from gsmerge.research.training.predict import Prediction, analytic_gaussians, decode_crop, predict, refine_crop
from gsmerge.research.training.train_options import TrainOptions
from gsmerge.research.training.windows import Window
from gsmerge.scoring.lpips import EPSILON, INPUT_SCALE, INPUT_SHIFT, Convolution, min_size, read_layers
from gsmerge.types import SH_C0, Gaussians


def lpips_loss(image: Tensor, reference: Tensor, mask: Tensor, net: str = "vgg") -> Tensor:
    """Measure LPIPS, differentiable in ``image [h,w,3]`` float32 on the CPU; the reference has no gradient.

    Pixels outside of ``mask [h,w]`` are taken from the reference. Returns 0 if the images are too small for the network
    or the mask is empty.
    """
    if min(image.shape[:2]) < min_size(net) or not bool(mask.any()):
        return image.new_zeros(())
    layers = read_layers(net)
    kernels = _kernels(net)
    with torch.no_grad():
        reference_features = list(_unit_features(reference, layers, kernels))
    visible = torch.where(mask[..., None], image, reference)
    layer_weights = [torch.from_numpy(layer.weights) for layer in layers if layer.weights is not None]
    distance = torch.zeros((), dtype=torch.float64)
    image_features = _unit_features(visible, layers, kernels)
    for weights, features, expected in zip(layer_weights, image_features, reference_features, strict=True):
        distance = distance + ((features - expected).square().mean((1, 2)) @ weights).double()
    return distance


@lru_cache(maxsize=1)
def _kernels(net: str) -> list[Tensor]:
    """Return the kernels ``[out,in,h,w]`` of a network, channels last in memory."""
    return [torch.from_numpy(layer.kernel).permute(0, 3, 1, 2) for layer in read_layers(net)]


def _unit_features(image: Tensor, layers: tuple[Convolution, ...], kernels: list[Tensor]) -> Iterator[Tensor]:
    """Yield the features ``[c,h,w]`` of each compared layer, with unit length at every pixel."""
    values = (2 * image[None] - 1 - torch.from_numpy(INPUT_SHIFT)) / torch.from_numpy(INPUT_SCALE)
    features = values.permute(0, 3, 1, 2)
    for layer, kernel in zip(layers, kernels, strict=True):
        conv = layer.conv
        if conv.pool:
            features = functional.max_pool2d(features, conv.pool, 2)
        bias = torch.from_numpy(layer.bias)
        features = functional.conv2d(features, kernel, bias, conv.stride, conv.padding).relu_()
        if layer.weights is not None:
            lengths = torch.linalg.vector_norm(features, dim=1, keepdim=True)
            yield (features / (lengths + float(EPSILON)))[0]


def window_loss(
    networks: Networks, window: Window, options: TrainOptions, step: int, rng: np.random.Generator
) -> Tensor:
    """Compute the loss of a window: the difference between its render and the photo, plus regularizers.

    The render has a random background. If all levels (values of K) are trained jointly, the loss is the mean over the
    levels. The weight of the diversity loss is relative to the photometric loss, because the diversity loss has no
    natural scale.
    """
    crop = window.crop
    background = rng.random(3, dtype=np.float32)
    levels = options.levels if options.joint else (crop.k,)
    teacher, diversity = options.regularizer_weights(step)
    photo = window.image
    mask = window.mask
    lpips_weight = options.lpips_weight_at(step)
    refined = refine_crop(crop, networks, options, step)
    total = torch.zeros(())
    for k in levels:
        prediction = decode_crop(refined, crop, k)
        # The loss of a render: difference of colours, 1 - SSIM, and LPIPS in the steps that use it
        image = draw_window(prediction.gaussians, window, background)
        color = color_loss(image, photo, mask, options.photo_loss)
        similar = masked_ssim(image, photo, mask) if options.ssim_weight else torch.ones(())
        loss = options.photo_weight * color + options.ssim_weight * (1 - similar)
        if lpips_weight:
            loss = loss + lpips_weight * lpips_loss(image, photo, mask)
        if diversity and k > 1:
            sibling_loss = diversity_loss(prediction.gaussians, prediction.parents, prediction.sizes)
            loss = loss + diversity * float(loss.detach()) * sibling_loss
        if teacher:
            loss = loss + teacher * teacher_loss(prediction, crop.example.members)
        total = total + loss / len(levels)
    return total


def draw_window(gaussians: Gaussians, window: Window, background: np.ndarray) -> Tensor:
    """Render a window ``[h,w,3]``, differentiable in the Gaussians."""
    eps2d = window.crop.example.photos.eps2d
    camera = window.camera.to("cpu")
    return render_tensors(gaussians, camera, background, with_depths=False, eps2d=eps2d, near=NEAR_PLANE).images[0]


def color_loss(image: Tensor, photo: Tensor, mask: Tensor, kind: str) -> Tensor:
    """Average absolute (``"l1"``) or squared (``"mse"``) differences of images ``[h,w,3]`` within ``mask [h,w]``."""
    difference = (image - photo).abs() if kind == "l1" else (image - photo).square()
    return (difference * mask[..., None]).sum() / (3 * mask.sum()).clamp_min(1)


def loss_ssim(image: Tensor, photo: Tensor) -> Tensor:
    """Compute the structural similarity ``[h,w,3]`` of image and photo around every pixel, differentiable by torch.

    Windows are uniform, which makes the gradient quick, and have ``WINDOW_SIDE`` pixels per side. Pixels beyond the
    border are zero. Covariances are sums divided by the number of pixels. The constants of SSIM are K1 = .01 and K2 =
    .03. The full fit has the same formula, and takes its loss and gradient from ``gsmerge.method.kernels.raster.step``.
    The SSIM of reports, :func:`gsmerge.method.raster.metrics.ssim`, has Gaussian windows, so its values differ.
    """
    stacked = torch.stack([image, photo, image * image, photo * photo, image * photo]).permute(0, 3, 1, 2)
    mx, my, xx, yy, xy = functional.avg_pool2d(stacked, WINDOW_SIDE, 1, WINDOW_SIDE // 2).permute(0, 2, 3, 1)
    c1 = float(C1)
    c2 = float(C2)
    numerator = (2 * mx * my + c1) * (2 * (xy - mx * my) + c2)
    return numerator / ((mx * mx + my * my + c1) * (xx - mx * mx + yy - my * my + c2))


def masked_ssim(image: Tensor, photo: Tensor, mask: Tensor) -> Tensor:
    """Average :func:`loss_ssim` of image and photo ``[h,w,3]`` over the pixels of ``mask [h,w]``.

    An empty mask gives 1.
    """
    if not bool(mask.any()):
        return torch.ones(())
    return (loss_ssim(image, photo).mean(-1) * mask).sum() / mask.sum()


def render_window(window: Window, networks: Networks | None, options: TrainOptions) -> tuple[Tensor, float]:
    """Predict and render a window ``[h,w,3]`` on black, clipped to [0, 1].

    Also returns the share of the Feature Gaussians that were merged with others. Without ``networks`` the closed
    formulas of the stages are used, and the share is 0.
    """
    with torch.no_grad():
        if networks is None:
            gaussians = analytic_gaussians(window.crop, options).to("cpu")
            matched = 0.0
        else:
            prediction = predict(window.crop, networks, options, 0)
            gaussians = prediction.gaussians
            matched = prediction.matched
        return draw_window(gaussians, window, np.zeros(3, np.float32)).clamp(0, 1), matched


def window_psnr(window: Window, image: Tensor) -> float:
    """Compute the PSNR (dB) of a render ``[h,w,3]`` of a window, over the pixels of the window's mask."""
    error = float(color_loss(image, window.image, window.mask, "mse"))
    max_db = 100.0  # PSNR of windows without an error
    return min(max_db, -10 * float(np.log10(max(error, 1e-12))))


def teacher_loss(prediction: Prediction, members: Members) -> Tensor:
    """Compute the distance of Gaussians from the moments of their groups (paper section 4.6).

    The teacher of a group is one Gaussian with the opacity-weighted mean and covariance of its members' means
    (equations teacher_mean and teacher_cov), the members' mean colour, and the opacity that conserves the members'
    optical depth. The loss is the angle between the rotations plus L1 distances of means, logarithms of scales,
    opacities and base colours. Distances between means are in units of the teacher's size. A Gaussian has 24 equivalent
    pairs of rotation and scales, of which the pair nearest to the prediction is used.
    """
    g = prediction.gaussians
    merged = prediction.merged
    if len(g) == 0:
        return g.means.new_zeros(())
    moments = pool_members(members, merged.starts, merged.members, "paper")
    teacher = to_gaussians(moments.covars, moments.extinctions, moments.means, moments.sh).to("cpu")[prediction.parents]
    scales = teacher.scales
    quats = teacher.quats
    # A Gaussian does not change if its rotation is multiplied by one of the 24 signed permutations of axes, and its
    # scales are permuted alike. ``orders [n,3,3]`` are those with which the teacher is nearest to the prediction
    signed = torch.stack([torch.diag(torch.tensor(signs)) for signs in product((1.0, -1.0), repeat=3)])
    unsigned = torch.stack([torch.eye(3)[list(order)] for order in permutations(range(3))])
    proper = (signed[:, None] @ unsigned).reshape(-1, 3, 3)
    proper = proper[torch.linalg.det(proper) > 0]  # [24,3,3]
    with torch.no_grad():
        between = quat_to_rotmat(g.quats).transpose(1, 2) @ quat_to_rotmat(quats)
        orders = proper[torch.einsum("nij,pji->np", between, proper).argmax(1)]
    scales = (scales[:, None] @ orders.abs())[:, 0]
    rotations = quat_to_rotmat(g.quats).transpose(1, 2) @ quat_to_rotmat(quats) @ orders
    cosines = (rotations.diagonal(dim1=1, dim2=2).sum(1) - 1) / 2
    # The small number makes the gradient finite at an angle of 0
    angles = torch.atan2((skew_vectors(rotations).square().sum(1) + 1e-12).sqrt(), cosines)
    sizes = gaussian_sizes(scales)
    distances = (g.means - teacher.means).abs() / sizes[:, None]
    stretches = (torch.log(g.scales) - torch.log(scales)).abs()
    colors = SH_C0 * (g.sh0 - teacher.sh0).abs()
    parts = (angles, distances, stretches, (g.opacities - teacher.opacities).abs(), colors)
    return torch.stack([part.mean() for part in parts]).sum()


# weights of the two terms of diversity_loss
GEOMETRY_WEIGHT = 0.75
OPACITY_WEIGHT = 0.25


def diversity_loss(gaussians: Gaussians, parents: Tensor, sizes: Tensor) -> Tensor:
    """Penalise siblings that overlap too much or too little, or differ in opacity (paper supplement D), from 0 to 1.

    Siblings are children of the same group. ``parents [n]`` of the children are ascending. The result is a mean over
    pairs of siblings, weighted by their volumes in units of the ``sizes [n]`` of their groups. The weights have no
    gradient, since a gradient would make siblings small. With volumes in world units, as in the paper, the loss of a
    million small Gaussians would be almost 0.
    """
    # Pairs of rows with the same parent, the lower row first. Parents are ascending, so siblings are next to each
    # other, and pairs are found by the gap between their rows
    count = int(torch.bincount(parents).max()) if len(parents) else 0
    rows = torch.arange(len(parents))
    firsts = [rows[: len(rows) - gap][parents[: len(rows) - gap] == parents[gap:]] for gap in range(1, count)]
    gaps = [torch.full_like(first, gap) for gap, first in enumerate(firsts, 1)]
    left = torch.cat([rows[:0], *firsts])
    right = left + torch.cat([rows[:0], *gaps])
    if len(left) == 0:
        return gaussians.means.new_zeros(())
    volumes = (gaussians.scales.detach() / sizes.detach()[:, None]).prod(1)
    weights = (volumes[left] * volumes[right]).clamp_min(1e-30).sqrt()
    overlap_loss = overlap_profile(gaussians, left, right)
    opacity_loss = (gaussians.opacities[left] - gaussians.opacities[right]).square()
    return (weights * (GEOMETRY_WEIGHT * overlap_loss + OPACITY_WEIGHT * opacity_loss)).sum() / weights.sum()


def overlap_profile(gaussians: Gaussians, left: Tensor, right: Tensor) -> Tensor:
    """Compute the paper's penalty ``[p]`` of pairs that overlap too much or too little.

    The pairs are rows ``left [p]`` and ``right [p]``. The penalty is 0 for pairs whose boxes have an intersection over
    union of a half. A box is parallel to the world's axes, and reaches one standard deviation to each side, as in
    matching.
    """
    axes = quat_to_rotmat(gaussians.quats) * gaussians.scales[:, None]
    halves = axes.norm(dim=2)
    away = (gaussians.means[left] - gaussians.means[right]).abs()
    a = halves[left]
    b = halves[right]
    shared = torch.minimum(torch.minimum(a + b - away, 2 * a), 2 * b).clamp_min(0).prod(1)
    union = (8 * a.prod(1) + 8 * b.prod(1) - shared).clamp_min(1e-30)
    overlaps = shared / union
    contact = (a.norm(dim=1) + b.norm(dim=1)).clamp_min(1e-12)
    gaps = (away.norm(dim=1) - contact).clamp_min(0) / contact
    free_overlap = 0.5  # intersection over union of two boxes at which the penalty is 0
    apart = 0.5 * ((free_overlap - overlaps) / free_overlap) ** 3 + 0.5 * (1 - torch.exp(-3 * gaps))
    return torch.where(overlaps >= free_overlap, ((overlaps - free_overlap) / (1 - free_overlap)) ** 3, apart)
