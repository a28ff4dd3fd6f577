"""Uniform blocks of pixels in place of superpixels, merged by our moment rule."""

from __future__ import annotations

import numpy as np
import torch

from gsmerge.baselines.baseline import Baseline, view_shares
from gsmerge.runtime.run_log import RunLog
from gsmerge.stages.assign import assign_members
from gsmerge.stages.decode import DecodeOptions, decode
from gsmerge.stages.encode import EncodeOptions, encode
from gsmerge.stages.prepare import PreparedScene
from gsmerge.stages.segment import grid_labels
from gsmerge.types import Gaussians, Groups


def run(prepared: PreparedScene, count: int, log: RunLog) -> Gaussians:
    """As many blocks as Gaussians, the same number in every view; those without a valid pixel are left out."""
    scene = prepared.scene
    height, width = scene.cameras.height, scene.cameras.width
    with log.stage("segment"):
        counts = view_shares(count, len(scene), height * width)
        labels = np.stack([grid_labels(height, width, own) for own in counts])
        groups = Groups(torch.from_numpy(labels), tuple(counts))
    with log.stage("encode"):
        members = prepared.members or assign_members(scene, groups, prepared.options.contribution)
        features = encode(scene, members, groups, EncodeOptions())
    with log.stage("decode"):
        return decode(features, members, DecodeOptions(min_opacity=0.0))


BLOCKS = Baseline("blocks", "uniform pixel blocks, our moment rule", run, needs=("pixels",))
