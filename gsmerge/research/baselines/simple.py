"""Short baselines: the input unmerged or fitted, pruned, merged by superpixels, or merged by splat-transform."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from gsmerge.io import read_ply, write_ply
from gsmerge.io.formats.splat_transform import run_program
from gsmerge.method.fit import fit_scene
from gsmerge.method.stages.assign import assign
from gsmerge.method.stages.decode import decode
from gsmerge.method.stages.encode import encode
from gsmerge.method.stages.superpixels import superpixels
from gsmerge.plugin import Plan, Prepared, stage
from gsmerge.runtime.threads import parallel_map
from gsmerge.settings.stages import DecodeOptions
from gsmerge.types import Decoded, Gaussians, Groups


def unmerged(prepared: Prepared, plan: Plan, count: int) -> Gaussians:
    """Return all Gaussians; ``count`` is ignored."""
    return prepared.scene.file_gaussians


def unmerged_fit(prepared: Prepared, plan: Plan, count: int) -> Gaussians:
    """Run the full fit on the unmerged input, with the same number of steps, or the same time, as the fit of a gsmerge
    run.

    The result shows what the fit gains without a merge. The fit replaces Gaussians that no photo shows by new
    Gaussians, so their number stays. ``count`` is ignored.
    """
    gaussians = prepared.scene.file_gaussians
    start = Decoded(gaussians, len(gaussians), exact=False)
    options = replace(plan.fit, fit="full")
    return fit_scene(start, prepared.scene, options, plan.seed).gaussians


def prune_faintest(prepared: Prepared, plan: Plan, count: int) -> Gaussians:
    """Keep the ``count`` most opaque Gaussians, unchanged and in order.

    Of equally opaque Gaussians the first are kept.
    """
    gaussians = prepared.scene.file_gaussians
    with stage("reduce"):
        return gaussians[np.sort(np.argsort(-gaussians.opacities, kind="stable")[:count])]


def prune_at_random(prepared: Prepared, plan: Plan, count: int) -> Gaussians:
    """Keep ``count`` random Gaussians, chosen by the seed, unchanged and in order."""
    gaussians = prepared.scene.file_gaussians
    with stage("reduce"):
        rng = np.random.default_rng(plan.seed)
        return gaussians[np.sort(rng.choice(len(gaussians), min(count, len(gaussians)), replace=False))]


def match_moments(prepared: Prepared, plan: Plan, count: int) -> Gaussians:
    """Merge each superpixel into one Gaussian without matching across views: the paper's "Mom. Match.".

    Views differ by at most one in their number of superpixels. Empty superpixels are left out. A Gaussian has the
    opacity-weighted mean and covariance of the means of its members (eq. teacher_mean, teacher_cov). The paper states
    no opacity, so the members' mean opacity is used.
    """
    scene = prepared.scene
    quotient, remainder = divmod(count, len(scene))  # the first views have one superpixel more
    counts = [min(scene.pixels_per_view, quotient + (view < remainder)) for view in range(len(scene))]
    with stage("segment"):
        pictures, views = scene.images, range(len(scene))
        labels = parallel_map(lambda view: superpixels(pictures[view], counts[view], "bass-st"), views)
    groups = Groups(np.stack(labels), tuple(counts))
    members = assign(scene, groups)
    features = encode(scene, members, groups, rule="paper")
    with stage("decode"):
        return decode(features, members, DecodeOptions(min_opacity=0.0))


def splat_transform(prepared: Prepared, plan: Plan, count: int) -> Gaussians:
    """Merge with the program splat-transform of PlayCanvas, which must be installed.

    The program runs on the CPU, with the option ``-d COUNT`` and otherwise default options. The input is returned if it
    has at most ``count`` Gaussians. Nothing is downloaded. The measured time includes the start of the program, but not
    the transfer of Gaussians.
    """
    gaussians = prepared.scene.file_gaussians
    if len(gaussians) <= count:
        return gaussians
    with tempfile.TemporaryDirectory(prefix="gsmerge-") as folder:
        before = Path(folder) / "in.ply"
        after = Path(folder) / "out.ply"
        write_ply(before, gaussians)
        with stage("reduce"):
            run_program(before, "-d", count, after)
        return read_ply(after, opacity="logit").gaussians
