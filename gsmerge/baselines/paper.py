"""The superpixel merging paper's moment matching: its baseline without a network ("Mom. Match.").

One Gaussian for each superpixel: opacity-weighted mean and the spread of the members' means (eq. teacher_mean,
teacher_cov). The paper states no opacity; the members' mean is taken. Superpixels are the paper's, BASS from seeds
drawn by the Shi-Tomasi response.
"""

from __future__ import annotations

import torch

from gsmerge.baselines.baseline import Baseline, merge_groups, view_shares
from gsmerge.build import Source
from gsmerge.options import CompactOptions
from gsmerge.runtime.run_log import RunLog
from gsmerge.runtime.threads import parallel_map
from gsmerge.stages.group import Canvas
from gsmerge.stages.segment import superpixels
from gsmerge.types import Gaussians, Groups

SEGMENTATION = "bass-st"


def run(source: Source, canvas: Canvas, options: CompactOptions, count: int, log: RunLog) -> Gaussians:
    """As many superpixels as Gaussians, the same number in every view; those that hold nothing are left out."""
    scene = source.scene
    counts = view_shares(count, len(scene), scene.pixels_per_view)
    with log.stage("segment"):
        views = range(len(scene))
        labels = parallel_map(lambda view: superpixels(canvas.pictures[view], counts[view], SEGMENTATION), views)
        groups = Groups(torch.stack(labels), tuple(counts))
    return merge_groups(source, groups, options, log, rule="paper")


PAPER = Baseline("paper", "the superpixel merging paper's moment matching", run)
