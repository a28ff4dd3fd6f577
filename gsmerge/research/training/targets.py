"""Targets of training: changes by the full fit in the K analytic Gaussians of every merged Feature Gaussian.

A full fit of these to all photos, without growth, gives a target for each: fitted minus analytic, in the columns that
networks correct. Gaussians that no photo shows have no target.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import permutations, product

import numpy as np
import torch
from torch import Tensor

from gsmerge.errors import SceneError
from gsmerge.fit import FitJob, visible_mask
from gsmerge.fit.full import fit_full
from gsmerge.fit.schedule import prepare_fit
from gsmerge.networks.options import RESIDUAL
from gsmerge.networks.tensors import gaussian_sizes, quat_to_rotmat, rotate_vectors, skew_vectors
from gsmerge.networks.tokens import compute_group_features
from gsmerge.raster.photos import Photos
from gsmerge.research.training.scenes import TrainingScene, coverage, covered_pixels, reduced_masks
from gsmerge.research.training.train_options import TrainOptions
from gsmerge.settings.fit import FitOptions
from gsmerge.settings.stages import DecodeOptions
from gsmerge.stages.decode import divide
from gsmerge.types import SH_C0, FeatureGaussians, Gaussians, as_tensor

Progress = Callable[[int, int], None]  # step, steps


@dataclass(frozen=True, eq=False)
class Targets:
    """Target corrections of the n analytic Gaussians for one K, taken from a fit."""

    parents: np.ndarray  # [n] int64, the merged Feature Gaussian of each, ascending
    corrections: np.ndarray  # [n,13] float32
    mask: np.ndarray  # [n] whether there is a target


def fit_targets(
    training: TrainingScene,
    merged: FeatureGaussians,
    options: TrainOptions,
    name: str,
    progress: Progress | None = None,
) -> dict[int, Targets]:
    """Compute the targets for every K of ``options.levels`` by fitting analytic Feature Gaussians to photos.

    ``name`` is the scene's, for errors; ``progress`` is called with (step, steps) of the fits. A SceneError if the fit
    does not improve held-out patches of the photos.
    """
    masks, (full, half) = covered_pixels(coverage(training)), (training.photos(), training.photos(2))
    masks[: len(training.scene)] = True  # of the other photos, only what the scene covers counts
    weights = masks.astype(np.float32), reduced_masks(masks, half).astype(np.float32)
    photos = replace(full, weights=weights[0]), replace(half, weights=weights[1])
    frames = as_tensor(compute_group_features(merged, training.members, training.scene.cameras).frames)
    targets = {}
    for number, k in enumerate(options.levels):

        def report(step: int, steps: int, *_: float, number: int = number) -> None:
            if progress:
                progress(number * steps + step, len(options.levels) * steps)

        children, parents = divide(merged, training.members, np.full(len(merged), k))
        fitted, mask = _fit_level(name, photos, children, options, report)
        corrections = np.zeros((len(children), RESIDUAL), np.float32)
        start, end = children[mask].to("cpu"), fitted.to("cpu")
        corrections[mask] = corrections_between(start, end, frames[torch.from_numpy(parents[mask])])
        targets[k] = Targets(parents, corrections, mask)
    return targets


def _fit_level(
    name: str,
    photos: tuple[Photos, Photos],
    start: Gaussians,
    options: TrainOptions,
    progress: Callable[..., None],
) -> tuple[Gaussians, np.ndarray]:
    """Fit Gaussians fully without growth; return them with a mask ``[n]`` of those that a photo shows."""
    fit = FitOptions(fit_steps=options.fit_steps)
    mask = start.opacities >= DecodeOptions().min_opacity
    mask[mask.copy()] = visible_mask(start[mask], photos[1], fit.min_contribution)
    job = FitJob(photos, fit, seed=options.seed, progress=progress)
    fitted, report = fit_full(start[mask], prepare_fit(job))
    if not report.accepted:
        problem = f"expected a scene that the fit makes better ({report.stopped})"
        raise SceneError(name, problem, "leave it out")
    return fitted, mask


def corrections_between(start: Gaussians, end: Gaussians, frames: Tensor) -> Tensor:
    """Compute the corrections ``[n,13]`` in ``frames [n,3,3]`` that turn Gaussians ``start`` into ``end``, all tensors.

    Of the equal pairs of rotation and scales of ``end``, the one nearest to ``start`` counts.
    """
    back, sizes = frames.transpose(1, 2), gaussian_sizes(start.scales).clamp_min(1e-12)
    orders = nearest_axes(end.quats, start.quats)
    scales = (end.scales[:, None] @ orders.abs())[:, 0]
    rotations = quat_to_rotmat(end.quats) @ orders @ quat_to_rotmat(start.quats).transpose(1, 2)
    logits = [torch.logit(g.opacities.clamp(0.004, 0.999)) for g in (start, end)]  # clamped as in the fit
    columns = [  # in the order of gsmerge.networks.corrections
        rotate_vectors(back, end.means - start.means) / sizes[:, None],
        torch.log(scales.clamp_min(1e-12) / start.scales.clamp_min(1e-12)),
        rotate_vectors(back, rotation_vectors(rotations)),
        (logits[1] - logits[0])[:, None],
        SH_C0 * (end.sh0 - start.sh0)[:, 0],
    ]
    return torch.cat(columns, 1).nan_to_num()


def nearest_axes(quats: Tensor, reference: Tensor) -> Tensor:
    """Return the axis permutations with signs ``[n,3,3]`` that bring ``quats [n,4]`` nearest to a reference.

    A Gaussian has 24 equal pairs of rotation and scales: rotations times the result, and scales in that order.
    """
    signed = torch.stack([torch.diag(torch.tensor(signs)) for signs in product((1.0, -1.0), repeat=3)])
    orders = torch.stack([torch.eye(3)[list(order)] for order in permutations(range(3))])
    proper = (signed[:, None] @ orders).reshape(-1, 3, 3)
    proper = proper[torch.linalg.det(proper) > 0]  # [24,3,3]
    with torch.no_grad():
        between = quat_to_rotmat(reference).transpose(1, 2) @ quat_to_rotmat(quats)
        return proper[torch.einsum("nij,pji->np", between, proper).argmax(1)]


def rotation_vectors(rotations: Tensor) -> Tensor:
    """Convert rotations ``[n,3,3]`` by less than half a turn to rotation vectors ``[n,3]``."""
    axis = skew_vectors(rotations)
    sine, cosine = (axis.square().sum(1) + 1e-14).sqrt(), (rotations.diagonal(dim1=1, dim2=2).sum(1) - 1) / 2
    return axis * (torch.atan2(sine, cosine) / sine.clamp_min(1e-12))[:, None]
