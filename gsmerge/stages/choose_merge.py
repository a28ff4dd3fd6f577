"""feature gaussians -> feature gaussians: the merge, and the start with or without networks, that the photos prefer.

Where depth is wrong, merging opens holes and puts surfaces of one view in front of another's. A small family of
merges differs in how depth uncertainty becomes geometry and opacity; each is scored by rendering every input view
from the Gaussians of the *other* views only, on half-size photos, and the best is kept. No held-out photo is used.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from gsmerge.geometry import sh0_to_rgb
from gsmerge.moments import Rule, feature_to_gaussians
from gsmerge.render import plan_view, prepare, splat_adjoint
from gsmerge.render.photos import Photos, photo_errors, photo_psnr, scene_photos, scene_pictures
from gsmerge.runtime.memory import release_memory
from gsmerge.runtime.threads import in_turn
from gsmerge.stages.decode import DecodeOptions, decode
from gsmerge.stages.merge import MergedViews
from gsmerge.types import FeatureGaussians, Gaussians, PixelScene, UnalignedScene
from gsmerge.views import pick_views, scored_views

MAX_VIEWS = 6  # that a start is judged by
MIN_VIEWS = 3  # with two, leaving one out leaves nothing to compare

# A name, and the layers that are drawn together: members of both in one array are as large as the scene, and only the
# candidate that wins needs them.
Candidate = tuple[str, tuple[FeatureGaussians, ...]]


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


@dataclass(frozen=True, eq=False)
class RobustMerge:
    """The merge that won.

    Args:
        features: Its Feature Gaussians.
        coarse: The coarse layer that candidates may have, see :mod:`gsmerge.stages.backing`; None: none has one.
        photos: The input views at half size, which judge.
        choices: The winners' names and the PSNR (dB) of every candidate, for the report: of views left out, with one
            or two views of all.
    """

    features: FeatureGaussians
    coarse: FeatureGaussians | None
    photos: Photos
    choices: dict[str, Any]


def choose_merge(
    features: FeatureGaussians,
    coarse: FeatureGaussians | None,
    photos: Photos,
    options: RobustOptions,
    *,
    leave_out: bool = True,
) -> RobustMerge:
    """The candidate that shows the photos best.

    From three views up every photo is rendered from the other views' Gaussians only. One or two views leave nothing
    to leave out: there the candidates differ in their spread alone, and the photos are rendered from everything.

    Args:
        features: Plain Feature Gaussians, unmerged across views.
        coarse: The coarse layer; None: no candidate has one.
        photos: The input views, usually at half size.
        options: The family.
        leave_out: False: the photos are always rendered from everything. For unaligned scenes, in which what several
            views show belongs to one of them, and would be missing with it.
    """
    many = len(photos) >= MIN_VIEWS
    family = _family(features, coarse, photos, options) if many else _spreads(features, options)
    name, best, scores = _best(family, photos, left_out=many and leave_out)
    return RobustMerge(best, coarse, photos, {"merge": name, "merge_scores": scores})


def close_holes(merged: FeatureGaussians, chosen: RobustMerge, options: RobustOptions) -> RobustMerge:
    """Wider Gaussians or a coarse layer where merging across views has opened holes.

    Several views' layers on one surface close each other's gaps; merged into one they may not. The photos, rendered
    from everything, decide.

    Args:
        merged: Feature Gaussians after merging across views.
        chosen: What they were before.
        options: The family.
    """
    family: list[Candidate] = [("as it is", (merged,))]
    coarse = chosen.coarse
    wide = replace(merged, spreads=merged.spreads * options.widen)
    narrow = not bool(merged.backing.all()) and float(merged.spreads[~merged.backing].max()) <= 1
    if narrow:
        family.append(("wide", (wide,)))
    if coarse is not None and not bool(merged.backing.any()):
        family.append(("back", (merged, coarse)))
        if narrow:
            family.append(("wide+back", (wide, coarse)))
    name, best, scores = _best(family, chosen.photos, left_out=False)
    return replace(chosen, features=best, choices=chosen.choices | {"closed": name, "closed_scores": scores})


def photos_choose(robust: bool | None, fit: str, effort: str) -> bool:
    """Whether photos choose the merge where there are any: as asked, or unless a full fit follows or it is a draft."""
    return fit != "full" and effort != "draft" if robust is None else robust


def _best(
    family: Iterable[Candidate], photos: Photos, *, left_out: bool
) -> tuple[str, FeatureGaussians, dict[str, float]]:
    """The member of the family with the best score, the first of equals, its name, and all scores."""
    scores: dict[str, float] = {}
    best: Candidate | None = None
    for name, layers in family:
        scores[name] = merge_psnr(layers, photos, left_out=left_out)
        if best is None or scores[name] > scores[best[0]]:
            best = name, layers
    assert best is not None
    name, layers = best
    return name, layers[0] if len(layers) == 1 else FeatureGaussians.concat(layers), scores


def _family(
    features: FeatureGaussians, backing: FeatureGaussians | None, photos: Photos, options: RobustOptions
) -> Iterator[Candidate]:
    """Plain, wide, weighed, and with the backing layer behind."""
    wide = replace(features, spreads=features.spreads * options.widen)
    yield "plain", (features,)
    yield "wide", (wide,)
    if backing is not None:
        yield "wide+back", (wide, backing)
    for name, base in (("plain", features), ("wide", wide)):
        weighed = replace(base, gains=weigh(base, photos, options))
        yield f"{name}+weigh", (weighed,)
        if backing is not None:
            yield f"{name}+weigh+back", (weighed, backing)


def _spreads(features: FeatureGaussians, options: RobustOptions) -> Iterator[Candidate]:
    """Plain, wide, and wider still."""
    yield "plain", (features,)
    for name, power in (("wide", 1), ("wider", 2)):
        yield name, (replace(features, spreads=features.spreads * options.widen**power),)


def merge_psnr(layers: Sequence[FeatureGaussians], photos: Photos, *, left_out: bool) -> float:
    """Mean PSNR (dB) of the photos, of many some, rendered from all Gaussians, or those of the other views only."""
    views = np.concatenate([layer.views for layer in layers])
    keep = (lambda view: views != view) if left_out else None
    gaussians = Gaussians.concat([feature_to_gaussians(layer) for layer in layers])
    return photo_psnr(gaussians, photos, scored_views(len(photos)), keep=keep)


def weigh(features: FeatureGaussians, photos: Photos, options: RobustOptions) -> np.ndarray:
    """Gains ``[g]`` from what the other views' photos show where a Gaussian appears in them.

    Optical depth times ``boost / (1 + (colour error / tolerance)^2)``; the error is measured in renders without
    the Gaussian's own view. Gaussians that no other view sees keep the boosted depth.
    """
    gaussians, views = feature_to_gaussians(features), features.views
    splats = prepare(gaussians)
    colors = sh0_to_rgb(gaussians.sh0[:, 0]).astype(np.float64)
    boosted = -options.boost * np.log1p(-gaussians.opacities.astype(np.float64))
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
    return (options.boost * trust).astype(np.float32)


def choose_start(
    starts: Sequence[MergedViews], scene: PixelScene | UnalignedScene, options: DecodeOptions, rule: Rule
) -> MergedViews:
    """With or without networks: the start whose Gaussians, one for each Feature Gaussian, show the views better.

    The choice does not depend on K, so what is encoded once is what every K begins with. Networks learn what real
    exports suffer from; a scene without those errors is better left as it is.

    Args:
        starts: The learned start, then the analytic one.
        scene: The canonical scene.
        options: Of decoding; K = 1 is taken.
        rule: How children are pooled.

    Returns:
        The better start, of equal ones the analytic, with its Gaussians and the PSNR (dB) of both among its choices.
    """
    scores: dict[str, float] = {}
    best = starts[0]
    for start in starts:
        name = "analytic" if start.networks is None else "learned"
        ones = decode(start.features, start.members, replace(options, k=1), None, rule, start.networks)
        release_memory()  # of the networks, in other threads
        scores[name] = views_psnr(ones, scene)
        if scores[name] >= max(scores.values()):
            best = replace(start, k1_gaussians=ones)
    return replace(best, choices={**best.choices, "start_scores": scores})


def views_psnr(gaussians: Gaussians, scene: PixelScene | UnalignedScene) -> float:
    """PSNR (dB) of the views at half size, over the pixels that have a Gaussian of their own.

    Args:
        gaussians: Canonical Gaussians.
        scene: The canonical scene; without photos, the colours of its pixels stand in for them.
    """
    photos = _photos(scene)

    def score(view: int, image: np.ndarray, _: np.ndarray) -> tuple[float, float]:
        error = ((np.clip(image, 0, 1) - photos.images[view]) ** 2).sum(-1)
        weight = _weight(scene, view, photos)
        return float((error * weight).sum(dtype=np.float64)), float(weight.sum(dtype=np.float64))

    error, count = np.sum(photo_errors(gaussians, photos, score, pick_views(len(photos), MAX_VIEWS)), axis=0)
    return float(-10 * np.log10(max(error / max(3 * count, 1), 1e-12)))


def _photos(scene: PixelScene | UnalignedScene) -> Photos:
    """The photos at half size, or the pictures that stand in for them."""
    if scene.images is None:
        scene = replace(scene, images=scene_pictures(scene))
    return scene_photos(scene, 2)


def _weight(scene: PixelScene | UnalignedScene, view: int, photos: Photos) -> np.ndarray:
    """``[h,w]`` share of each half-size pixel that has Gaussians; ones where Gaussians belong to no pixels."""
    size = photos.width, photos.height
    if isinstance(scene, UnalignedScene):
        return np.ones(size[::-1], np.float32)
    return cv2.resize(scene.valid[view].astype(np.float32), size, interpolation=cv2.INTER_AREA)
