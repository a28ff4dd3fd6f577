"""Start a block of views: merge its views, and keep the Gaussians that belong to the block."""

from __future__ import annotations

import numpy as np

from gsmerge.blocks.partition import Block, Covisibility, owning_views
from gsmerge.frozen import dataclass, replace
from gsmerge.method.facts.prepared import Prepared
from gsmerge.method.geometry.frame import Frame
from gsmerge.method.pipelines.pixel_rows import merge_views
from gsmerge.method.pipelines.plan import Plan
from gsmerge.plan.make_plan import make_plan
from gsmerge.prepare.prepare_scene import prepare
from gsmerge.results.scores import measure_input
from gsmerge.runtime.memory import free_pages, make_array
from gsmerge.runtime.record import begin_part
from gsmerge.settings.compact import CompactOptions
from gsmerge.types import Gaussians, Scene, SceneT

IN_FILE = 1 << 24  # photos of a block with at least this many bytes are kept in a file


@dataclass(frozen=True, eq=False)
class BlockStart:
    """A block whose views are merged but whose Gaussians are not fitted yet."""

    block: Block
    gaussians: Gaussians  # Canonical Gaussians that belong to the block
    count: int  # Gaussians that the block is to have in the end
    prepared: Prepared  # The block's views, without Gaussians
    plan: Plan
    psnr_before: float | None  # PSNR (dB) of the input on the scored photos; None without photos


def start_block(
    piece: Scene, block: Block, covisibility: Covisibility, options: CompactOptions, frame: Frame
) -> BlockStart:
    """Merge the views of a block, and keep the merged Gaussians that belong to the block.

    ``piece`` is the scene of the block's views. ``frame`` is the canonical frame of all blocks.
    """
    begin_part("merge")
    prepared = prepare(piece, options.prepare, frame)
    plan = make_plan(prepared, options)
    decoded = merge_views(prepared, plan, plan.count.limits.count)
    # The owner of a Gaussian is searched among the views that share surfaces with the block, because other views do not
    # see the Gaussian
    is_candidate = covisibility.weights[list(block.own)].sum(0) > 0
    is_candidate[list(block.own)] = True
    means = frame.leave(decoded.gaussians).means
    candidates = np.flatnonzero(is_candidate).tolist()
    keep = np.isin(owning_views(means, covisibility, candidates), block.own)
    before = measure_input(prepared, plan.score)
    return BlockStart(
        block=block,
        gaussians=decoded.gaussians[keep],
        count=round(keep.sum() / max(1, len(keep)) * decoded.count),
        prepared=without_gaussians(prepared),
        plan=plan,
        psnr_before=None if before is None else before.psnr,
    )


def without_gaussians(prepared: Prepared) -> Prepared:
    """Return a prepared scene without Gaussians, to free memory; large photos are copied into a file."""
    copies: dict[int, np.ndarray] = {}  # by the id of the photos, because both scenes may have the same photos

    def empty(scene: SceneT) -> SceneT:
        """Return a scene without its Gaussians and their pixels, and with a copy of its photos."""
        images = np.asarray(scene.images)  # views with Gaussians of their own always have pictures
        if id(images) not in copies:
            copies[id(images)] = photos = make_array(images.shape, images.dtype.type, IN_FILE)
            photos[:] = images
            free_pages([photos])
        return replace(scene, gaussians=scene.gaussians[np.zeros(0, int)], images=copies[id(images)], pixels=None)

    reference = replace(prepared.reference, photo_files=None)
    scene, input_scene = empty(prepared.scene), empty(prepared.input_scene)
    return replace(prepared, reference=reference, scene=scene, input_scene=input_scene)
