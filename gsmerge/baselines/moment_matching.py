"""The superpixel merging paper's moment matching: its baseline without a network ("Mom. Match.").

One Gaussian for each superpixel: opacity-weighted mean and the spread of the members' means (eq. teacher_mean,
teacher_cov). The paper states no opacity; the members' mean is taken. Superpixels are the paper's, BASS from seeds
drawn by the Shi-Tomasi response.
"""

from __future__ import annotations

import torch

from gsmerge.baselines.baseline import Baseline, merge_groups, view_shares
from gsmerge.runtime.run_log import RunLog
from gsmerge.runtime.threads import parallel_map
from gsmerge.stages.prepare import PreparedScene
from gsmerge.stages.segment import superpixels
from gsmerge.types import Gaussians, Groups

SEGMENTATION = "bass-st"


def run(prepared: PreparedScene, count: int, log: RunLog) -> Gaussians:
    """As many superpixels as Gaussians, the same number in every view; those that hold nothing are left out."""
    scene = prepared.scene
    counts = view_shares(count, len(scene), scene.pixels_per_view)
    with log.stage("segment"):
        views = range(len(scene))
        labels = parallel_map(lambda view: superpixels(prepared.pictures[view], counts[view], SEGMENTATION), views)
        groups = Groups(torch.stack(labels), tuple(counts))
    return merge_groups(prepared, groups, log, rule="paper")


MOMENT_MATCHING = Baseline("moment-matching", "the superpixel merging paper's moment matching", run)
