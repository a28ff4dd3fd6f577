"""Baselines of a few lines: the input as it is or fitted, pruned, or merged over blocks of pixels or superpixels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gsmerge.baselines.baseline import merge_groups, most_important, own_gaussians, view_shares
from gsmerge.gpu import choose_backend
from gsmerge.render import contributions, plan_view, prepare
from gsmerge.runtime.record import stage
from gsmerge.runtime.threads import parallel_map
from gsmerge.stages.fit import FitOptions, fit, fit_photos, record_fit, report_steps
from gsmerge.stages.prepare import PreparedScene
from gsmerge.stages.segment import grid_labels, superpixels
from gsmerge.types import Cameras, Gaussians, Groups

PAPER_SUPERPIXELS = "bass-st"  # BASS from seeds drawn by the Shi-Tomasi response
MAX_PLANNED = 2_000_000  # Gaussians in the plans of the views under way: each plan is as large as they are


def unmerged(prepared: PreparedScene, count: int) -> Gaussians:
    """All Gaussians, whatever the count."""
    return own_gaussians(prepared.scene)


def unmerged_color(prepared: PreparedScene, count: int) -> Gaussians:
    """The colour fit on all Gaussians, none left out; whatever the count."""
    return _fit_input(prepared, replace(prepared.options.fit, fit="color", min_contribution=0.0))


def unmerged_fit(prepared: PreparedScene, count: int) -> Gaussians:
    """The full fit, with as many steps or as much time as ours: what merging has to beat; whatever the count.

    Gaussians that no photo shows are replaced by others, so the number stays.
    """
    return _fit_input(prepared, replace(prepared.options.fit, fit="full"))


def _fit_input(prepared: PreparedScene, options: FitOptions) -> Gaussians:
    """All Gaussians, fitted to the photos."""
    gaussians = own_gaussians(prepared.scene)
    if prepared.scene.images is None:
        return gaussians
    with stage("fit"):
        photos = fit_photos(prepared.scene, options, prepared.photo_views)
        backend, _ = choose_backend(options.device, prepared.given.num_gaussians)
        gaussians, report = fit(
            gaussians, photos, options, len(gaussians), prepared.options.seed, report_steps, backend=backend
        )
    record_fit(report)
    return gaussians


def prune_by_opacity(prepared: PreparedScene, count: int) -> Gaussians:
    """The most opaque, unchanged and in their order; of equal ones the first of the file."""
    gaussians = own_gaussians(prepared.scene)
    with stage("reduce"):
        return gaussians[most_important(gaussians.opacities, count)]


def prune_by_contribution(prepared: PreparedScene, count: int) -> Gaussians:
    """Those that add most to the views (Mini-Splatting), unchanged and in their order; of equal ones the first."""
    gaussians = own_gaussians(prepared.scene)
    with stage("reduce"):
        return gaussians[most_important(summed_weights(gaussians, prepared.scene.cameras), count)]


def summed_weights(gaussians: Gaussians, cameras: Cameras) -> np.ndarray:
    """``[n]`` float64 blending weights summed over the pixels of all views; the same on any number of threads."""
    splats = prepare(gaussians)
    viewmats, Ks = cameras.viewmats.astype(np.float64), cameras.Ks.astype(np.float64)

    def one_view(view: int) -> np.ndarray:
        sums, _ = contributions(plan_view(splats, viewmats[view], Ks[view], cameras.width, cameras.height))
        return sums

    total, step = np.zeros(len(splats)), max(1, MAX_PLANNED // max(len(splats), 1))
    for first in range(0, len(cameras), step):
        for sums in parallel_map(one_view, range(first, min(first + step, len(cameras)))):
            total += sums
    return total


def prune_at_random(prepared: PreparedScene, count: int) -> Gaussians:
    """A random choice that depends only on the seed, unchanged and in their order."""
    gaussians = own_gaussians(prepared.scene)
    with stage("reduce"):
        rng = np.random.default_rng(prepared.options.seed)
        return gaussians[np.sort(rng.choice(len(gaussians), min(count, len(gaussians)), replace=False))]


def merge_blocks(prepared: PreparedScene, count: int) -> Gaussians:
    """As many blocks as Gaussians, the same number in every view; those without a valid pixel are left out."""
    scene = prepared.scene
    height, width = scene.cameras.height, scene.cameras.width
    with stage("segment"):
        counts = view_shares(count, len(scene), height * width)
        labels = np.stack([grid_labels(height, width, own) for own in counts])
    return merge_groups(prepared, Groups(labels, tuple(counts)))


def match_moments(prepared: PreparedScene, count: int) -> Gaussians:
    """The superpixel merging paper's moment matching: its baseline without a network ("Mom. Match.").

    One Gaussian for each superpixel: opacity-weighted mean and the spread of the members' means (eq. teacher_mean,
    teacher_cov). The paper states no opacity; the members' mean is taken. Superpixels are the paper's, as many as
    Gaussians, the same number in every view; those that hold nothing are left out.
    """
    scene = prepared.scene
    counts = view_shares(count, len(scene), scene.pixels_per_view)
    with stage("segment"):
        views = range(len(scene))
        labels = parallel_map(lambda view: superpixels(prepared.pictures[view], counts[view], PAPER_SUPERPIXELS), views)
    return merge_groups(prepared, Groups(np.stack(labels), tuple(counts)), rule="paper")
