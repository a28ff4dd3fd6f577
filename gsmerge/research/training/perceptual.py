"""LPIPS as a loss: the distance of :mod:`gsmerge.measure.lpips`, differentiable by torch."""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache

import torch
from torch import Tensor
from torch.nn import functional

from gsmerge.measure.lpips import EPSILON, SCALE, SHIFT, Layer, min_size, read_layers


def lpips_loss(image: Tensor, reference: Tensor, mask: Tensor, net: str = "vgg") -> Tensor:
    """Measure LPIPS, differentiable in ``image [h,w,3]`` float32 on the CPU; the reference has no gradient.

    Pixels outside of ``mask [h,w]`` are taken from the reference; 0 where the images are too small
    for the network or no pixel counts.
    """
    if min(image.shape[:2]) < min_size(net) or not bool(mask.any()):
        return image.new_zeros(())
    layers, kernels = read_layers(net), _kernels(net)
    with torch.no_grad():
        features = list(_unit_features(reference, layers, kernels))
    seen = torch.where(mask[..., None], image, reference)
    compared = [torch.from_numpy(one.weights) for one in layers if one.weights is not None]
    distance = torch.zeros((), dtype=torch.float64)
    units = _unit_features(seen, layers, kernels)
    for weights, unit, other in zip(compared, units, features, strict=True):
        distance = distance + ((unit - other).square().mean((1, 2)) @ weights).double()
    return distance


@lru_cache(maxsize=1)
def _kernels(net: str) -> list[Tensor]:
    """Return the kernels ``[out,in,h,w]`` of a network, channels last in memory."""
    return [torch.from_numpy(layer.kernel).permute(0, 3, 1, 2) for layer in read_layers(net)]


def _unit_features(image: Tensor, layers: tuple[Layer, ...], kernels: list[Tensor]) -> Iterator[Tensor]:
    """Compute features ``[c,h,w]`` of unit length at every pixel, of each layer that is compared."""
    values = (2 * image[None] - 1 - torch.from_numpy(SHIFT)) / torch.from_numpy(SCALE)
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
