"""feature gaussians -> feature gaussians: the merge that the photos themselves prefer.

Where depth is wrong, merging opens holes and puts surfaces of one view in front of another's. A small family of
merges differs in how depth uncertainty becomes geometry and opacity; each is scored by rendering every input view
from the Gaussians of the *other* views only, on half-size photos, and the best is kept. No held-out photo is used.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch

from gsmerge.moments import feature_to_gaussians
from gsmerge.render import composite, plan_view, prepare, splat_adjoint
from gsmerge.render.metrics import psnr
from gsmerge.render.photos import Photos
from gsmerge.runtime.threads import in_turn, parallel_map
from gsmerge.types import SH_C0, FeatureGaussians
from gsmerge.views import judged_views

MIN_VIEWS = 3  # with two, leaving one out leaves nothing to compare


@dataclass(frozen=True)
class RobustOptions:
    """The family of merges and how it is judged.

    Args:
        robust: Choose among the family by the photos; otherwise the plain merge is taken. None: unless a full fit
            follows, which closes holes and moves surfaces itself and is better in the same time, or it is a draft;
            networks stand in for it, too.
        widen: Standard deviations of the "wide" members times this; a single layer of merged Gaussians is not
            closed at 1.
        boost: Factor on the optical depth before the other views' photos weigh it down.
        tolerance: Colour error at which a Gaussian keeps half of its boosted optical depth.
        rounds: Times that the weighing looks again.

    Raises:
        ValueError: If a setting is out of range.
    """

    robust: bool | None = None
    widen: float = 1.2
    boost: float = 3.0
    tolerance: float = 0.1
    rounds: int = 2

    def __post_init__(self) -> None:
        for name in ("widen", "boost", "tolerance"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name}: expected more than 0, got {getattr(self, name)}")
        if self.rounds < 1:
            raise ValueError(f"rounds: expected at least 1, got {self.rounds}")


@dataclass(frozen=True)
class RobustChoice:
    """The merge that won and the PSNR (dB) of every candidate: of views left out, with one or two views of all."""

    name: str
    scores: dict[str, float]


def choose_merge(
    features: FeatureGaussians,
    backing: FeatureGaussians | None,
    photos: Photos,
    options: RobustOptions,
    *,
    left_out: bool = True,
) -> tuple[FeatureGaussians, RobustChoice]:
    """The candidate that shows the photos best.

    From three views up every photo is rendered from the other views' Gaussians only. One or two views leave nothing
    to leave out: there the candidates differ in their spread alone, and the photos are rendered from everything.

    Args:
        features: Plain Feature Gaussians, unmerged across views.
        backing: The coarse layer, see :mod:`gsmerge.stages.backing`; None: no candidate has one.
        photos: The input views, usually at half size.
        options: The family.
        left_out: False: the photos are always rendered from everything. For Gaussians that are in no order: what
            several views show belongs to one of them, and would be missing with it.
    """
    many = len(photos) >= MIN_VIEWS
    family = _family(features, backing, photos, options) if many else _spreads(features, options)
    return _best(family, photos, left_out=many and left_out)


def close_holes(
    merged: FeatureGaussians, backing: FeatureGaussians | None, photos: Photos, options: RobustOptions
) -> tuple[FeatureGaussians, RobustChoice]:
    """Wider Gaussians or a backing layer where merging across views has opened holes.

    Several views' layers on one surface close each other's gaps; merged into one they may not. The photos, rendered
    from everything, decide.

    Args:
        merged: Feature Gaussians after merging across views.
        backing: The coarse layer, for candidates without one; None: no candidate gets one.
        photos: The input views, usually at half size.
        options: The family.
    """
    family = [("as it is", merged)]
    wide = replace(merged, spreads=merged.spreads * options.widen)
    narrow = not bool(merged.backing.all()) and float(merged.spreads[~merged.backing].max()) <= 1
    if narrow:
        family.append(("wide", wide))
    if backing is not None and not bool(merged.backing.any()):
        family.append(("back", FeatureGaussians.concat([merged, backing])))
        if narrow:
            family.append(("wide+back", FeatureGaussians.concat([wide, backing])))
    return _best(family, photos, left_out=False)


def _best(
    family: Iterable[tuple[str, FeatureGaussians]], photos: Photos, *, left_out: bool
) -> tuple[FeatureGaussians, RobustChoice]:
    """The member of the family with the best score; the first of equals."""
    scores: dict[str, float] = {}
    best: tuple[str, FeatureGaussians] | None = None
    for name, candidate in family:
        scores[name] = photo_psnr(candidate, photos, left_out=left_out)
        if best is None or scores[name] > scores[best[0]]:
            best = name, candidate
    assert best is not None
    return best[1], RobustChoice(best[0], scores)


def _family(
    features: FeatureGaussians, backing: FeatureGaussians | None, photos: Photos, options: RobustOptions
) -> Iterator[tuple[str, FeatureGaussians]]:
    """Plain, wide, weighed, and with the backing layer behind."""
    wide = replace(features, spreads=features.spreads * options.widen)
    yield "plain", features
    yield "wide", wide
    if backing is not None:
        yield "wide+back", FeatureGaussians.concat([wide, backing])
    for name, base in (("plain", features), ("wide", wide)):
        weighed = replace(base, gains=weigh(base, photos, options))
        yield f"{name}+weigh", weighed
        if backing is not None:
            yield f"{name}+weigh+back", FeatureGaussians.concat([weighed, backing])


def _spreads(features: FeatureGaussians, options: RobustOptions) -> Iterator[tuple[str, FeatureGaussians]]:
    """Plain, wide, and wider still."""
    yield "plain", features
    for name, power in (("wide", 1), ("wider", 2)):
        yield name, replace(features, spreads=features.spreads * options.widen**power)


def photo_psnr(features: FeatureGaussians, photos: Photos, *, left_out: bool) -> float:
    """Mean PSNR (dB) of the photos, of many some, rendered from all Gaussians, or those of the other views only."""
    splats, views = prepare(feature_to_gaussians(features)), features.views.numpy()

    def score(view: int) -> float:
        plan = plan_view(splats, **photos.camera(view), keep=views != view if left_out else None)
        image, _ = composite(plan)
        return psnr(np.clip(image, 0, 1), photos.images[view])

    return float(np.mean(parallel_map(score, judged_views(len(photos)))))


def weigh(features: FeatureGaussians, photos: Photos, options: RobustOptions) -> torch.Tensor:
    """Gains ``[g]`` from what the other views' photos show where a Gaussian appears in them.

    Optical depth times ``boost / (1 + (colour error / tolerance)^2)``; the error is measured in renders without
    the Gaussian's own view. Gaussians that no other view sees keep the boosted depth.
    """
    gaussians, views = feature_to_gaussians(features), features.views.numpy()
    splats = prepare(gaussians)
    colors = (0.5 + SH_C0 * gaussians.sh0[:, 0]).double().numpy()
    boosted = -options.boost * np.log1p(-gaussians.opacities.double().numpy())
    trust = np.ones(len(features))
    for round_index in range(options.rounds):
        opacities = np.clip(1 - np.exp(-boosted * trust), 1e-4, 0.999).astype(np.float32)

        def testimony(view: int, opacities: np.ndarray = opacities) -> np.ndarray:
            plan = plan_view(splats, **photos.camera(view), keep=views != view, opacities=opacities)
            image = photos.images[view]
            squares = np.einsum("hwc,hwc->hw", image, image)
            return splat_adjoint(plan, np.dstack([np.ones_like(squares), image, squares]))

        sums = np.zeros((len(features), 5))
        for seen_there in in_turn(testimony, range(len(photos))):
            sums += seen_there
        mass = sums[:, 0]
        error = (colors**2).sum(1) * mass - 2 * (colors * sums[:, 1:4]).sum(1) + sums[:, 4]
        error = np.maximum(error, 0) / (3 * mass + 1e-9)
        seen = mass / (mass + 1)
        fresh = seen / (1 + error / options.tolerance**2) + 1 - seen
        trust = np.maximum(fresh if round_index == 0 else np.sqrt(trust * fresh), 0.05)
    return torch.from_numpy(options.boost * trust).float()
