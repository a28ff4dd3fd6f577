"""Fit the seams between blocks: Gaussians in views of several blocks are fitted again, to all these views."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import fields, replace

import numpy as np

from gsmerge.blocks.start_block import BlockStart
from gsmerge.method.fit import fit_scene, peak_weights
from gsmerge.method.geometry.views import in_float64, subset
from gsmerge.method.raster import make_splats, tile_view
from gsmerge.method.raster.composite import list_contributions
from gsmerge.method.raster.photos import Photos, blank_photos
from gsmerge.method.raster.tiled_view import Splats
from gsmerge.reading.alignment.registration.join import concat_scenes, concat_values
from gsmerge.runtime.memory import free_pages, make_array
from gsmerge.runtime.record import add_seconds, begin_part, record_choices, record_part, stage
from gsmerge.runtime.threads import in_turn
from gsmerge.types import Decoded, Gaussians, PicturedScene

FOREIGN_SHARE = 0.1  # a Gaussian is at a seam if other blocks' views have more than this share of its blending weights
SEAM_VIEW_STEPS = 2  # steps for each view
# If at least ROOM_SHARE of all Gaussians are at seams, the blocks show the same room from all sides, and the fit of the
# seams takes ROOM_VIEW_STEPS steps for each view
ROOM_SHARE = 0.5
ROOM_VIEW_STEPS = 4
# Step sizes in the fit of the seams, relative to the step sizes in other fits. They are smaller, because the Gaussians
# at seams are already fitted, though beside Gaussians that are not in the result
SEAM_RATE = 0.6


def fit_seams(joined: Gaussians, owners: np.ndarray, starts: Sequence[BlockStart], seed: int) -> Gaussians:
    """Fit the Gaussians at seams again, to the photos of all blocks that show them; other Gaussians stay unchanged.

    The fit of a block also changed copies of Gaussians that belong to neighbouring blocks. These copies are not in the
    result. At the seams, the Gaussians of neighbouring blocks therefore do not fit each other. ``owners [n]`` is the
    block of each Gaussian.
    """
    plan = next((start.plan for start in starts if start.plan.fit.fit != "none"), None)
    if plan is None:
        return joined
    begin_part("seams")
    with stage("join"):
        at_seam, views = find_seams(joined, owners, starts)
        if not any(views):
            return joined
        scene = join_views([(start.prepared.scene, ids) for start, ids in zip(starts, views, strict=True) if ids])
    rows = np.flatnonzero(peak_weights(joined, blank_photos(scene.cameras, 2))[0] >= plan.fit.min_contribution)
    seam_decay = 0.1  # step sizes at the end, relative to those at the start
    tuning = replace(plan.fit.tuning.scaled(SEAM_RATE), decay=seam_decay)
    view_steps = SEAM_VIEW_STEPS if at_seam.mean() < ROOM_SHARE else ROOM_VIEW_STEPS
    seam_steps = 100  # fewest steps of the fit
    options = replace(
        plan.fit, fit_steps=max(seam_steps, view_steps * len(scene)), photo_scale=1.0, scored=False, dropout=0.0,
        half_res_share=0.0, min_contribution=0.0, beyond=True, tuning=tuning,
    )  # fmt: skip
    decoded = Decoded(joined[rows], len(rows), exact=True, fixed=~at_seam[rows])
    with record_part(title="seams") as record:
        fitted = fit_scene(decoded, scene, options, seed)
    add_seconds(record.seconds)
    record_choices(seams={"views": len(scene), "num_gaussians": int(at_seam.sum()), "steps": options.steps})
    columns = {f.name: np.array(getattr(joined, f.name)) for f in fields(Gaussians)}
    was_fitted = at_seam[rows]  # the others were fixed, and the fit returns them rounded
    for name, column in columns.items():
        column[rows[was_fitted]] = getattr(fitted.gaussians, name)[was_fitted]
    return Gaussians(**columns)


def find_seams(
    joined: Gaussians, owners: np.ndarray, starts: Sequence[BlockStart]
) -> tuple[np.ndarray, list[list[int]]]:
    """Return a mask ``[n]`` of Gaussians at seams and, for each block, its own views that show many of these Gaussians.

    A Gaussian is at a seam if views of other blocks show it, too.
    """
    total = np.zeros(len(joined))
    foreign = np.zeros(len(joined))
    splats = make_splats(joined)
    seam_views: list[list[int]] = [[] for _ in starts]
    for block, _, rows, weights in _view_weights(splats, starts):
        total[rows] += weights
        foreign[rows] += np.where(owners[rows] == block, 0, weights)
    at_seam = foreign > FOREIGN_SHARE * total
    seam_share = 0.1  # seams are fitted to a view if more than this share of its weights is on Gaussians at seams
    # The weights are measured a second time, because the weights of all views would not fit into memory
    for block, view, rows, weights in _view_weights(splats, starts):
        seam_weight, view_weight = (float(values.sum(dtype=np.float64)) for values in (weights[at_seam[rows]], weights))
        if seam_weight > seam_share * view_weight:
            seam_views[block].append(view)
    return at_seam, seam_views


def join_views(scene_views: Sequence[tuple[PicturedScene, list[int]]]) -> PicturedScene:
    """Join views of several scenes, which have no Gaussians, into one scene; many photos are kept in a file.

    ``scene_views`` has pairs of a scene and the ids of its views to join.
    """
    num_views = sum(len(ids) for _, ids in scene_views)
    cameras = scene_views[0][0].cameras
    images = make_array((num_views, cameras.height, cameras.width, 3), np.float32)
    num_copied = 0
    for scene, ids in scene_views:
        for view in ids:
            images[num_copied] = scene.images[view]
            num_copied += 1
        free_pages([scene.images, images])
    joined = concat_scenes([subset(scene.without_pictures(), ids) for scene, ids in scene_views], images)
    pictured = PicturedScene.with_pictures(replace(joined, cameras=in_float64(joined.cameras)), images, joined.masks)
    shares = [None if scene.empty is None else scene.empty[ids] for scene, ids in scene_views]
    shapes = [(len(ids), *images.shape[1:3]) for _, ids in scene_views]
    return replace(pictured, empty=concat_values(shares, shapes, usual=np.float32(0)))


def _view_weights(splats: Splats, starts: Sequence[BlockStart]) -> Iterator[tuple[int, int, np.ndarray, np.ndarray]]:
    """Yield, for each view that belongs to a block: the block, the view, and rows and weights ``[m]`` of Gaussians.

    The rows name the Gaussians that the view draws. A weight is the sum of the blending weights of a Gaussian
    in the view. Views are numbered within the prepared scene of their block.
    """
    for block, start in enumerate(starts):
        block_views = set(start.block.own)
        repeated = start.prepared.repeated
        views = sorted({repeated[i] for i, view in enumerate(start.block.views) if view in block_views})
        photos = blank_photos(start.prepared.scene.cameras[views], 2)

        def list_weights(view: int, photos: Photos = photos) -> tuple[np.ndarray, np.ndarray]:
            """Return the rows and weights of a view of ``photos``."""
            tiled = tile_view(splats, **photos.camera(view))
            return tiled.ids, list_contributions(tiled)[0]

        for view, (ids, weights) in zip(views, in_turn(list_weights, range(len(photos))), strict=True):
            yield block, view, ids, weights
