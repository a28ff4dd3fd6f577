"""Fit the seams between blocks: Gaussians that views of several blocks show are fitted again, to all these views."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import fields, replace

import numpy as np

from gsmerge.cameras.registration.join import concat_scenes
from gsmerge.compaction.block_start import BlockStart
from gsmerge.fit import fit_scene, peak_weights
from gsmerge.photos.views import in_float64, subset
from gsmerge.raster import make_splats, tile_view
from gsmerge.raster.composite import list_contributions
from gsmerge.raster.photos import Photos, blank_photos
from gsmerge.raster.tiled_view import Splats
from gsmerge.runtime.memory import free_pages, make_array
from gsmerge.runtime.record import add_seconds, begin_part, record_choices, record_part, stage
from gsmerge.runtime.threads import in_turn
from gsmerge.types import Decoded, Gaussians, PicturedScene

FOREIGN_SHARE = 0.1  # a Gaussian is at a seam if other blocks' views have more than this share of its blending weights
SEAM_VIEW_STEPS = 2  # steps for each view
# If at least the share ROOM_SHARE of the Gaussians is at seams, the blocks are parts of one room. Then each view gets
# ROOM_VIEW_STEPS steps
ROOM_SHARE, ROOM_VIEW_STEPS = 0.5, 4
# Step sizes relative to those of other fits. They are smaller, because the Gaussians have been fitted before, though
# beside other neighbours
SEAM_RATE = 0.6


def fit_seams(joined: Gaussians, owners: np.ndarray, starts: Sequence[BlockStart], seed: int) -> Gaussians:
    """Fit the Gaussians at seams again, to the photos of all blocks that show them.

    All other Gaussians stay unchanged. ``owners [n]`` is the block of each Gaussian. Before, each block fitted its
    Gaussians beside its own version of the neighbouring blocks' Gaussians. Here they are fitted beside the final ones.
    """
    plan = next((start.plan for start in starts if start.plan.fit.fit != "none"), None)
    if plan is None:
        return joined
    begin_part()
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
    moved = at_seam[rows]  # the fit also returns the fixed Gaussians, but rounded
    for name, column in columns.items():
        column[rows[moved]] = getattr(fitted.gaussians, name)[moved]
    return Gaussians(**columns)


def find_seams(
    joined: Gaussians, owners: np.ndarray, starts: Sequence[BlockStart]
) -> tuple[np.ndarray, list[list[int]]]:
    """Return a mask ``[n]`` of Gaussians at seams and, for each block, its own views that show many of them."""
    total, foreign, splats = np.zeros(len(joined)), np.zeros(len(joined)), make_splats(joined)
    views: list[list[int]] = [[] for _ in starts]
    for number, _, ids, weights in _view_weights(splats, starts):
        total[ids] += weights
        foreign[ids] += np.where(owners[ids] == number, 0, weights)
    at_seam = foreign > FOREIGN_SHARE * total
    seam_share = 0.1  # seams are fitted to a view if more than this share of its weights is on Gaussians at seams
    # measured a second time, because the weights of all views would not fit into memory
    for number, view, ids, weights in _view_weights(splats, starts):
        seam_weight, view_weight = (float(values.sum(dtype=np.float64)) for values in (weights[at_seam[ids]], weights))
        if seam_weight > seam_share * view_weight:
            views[number].append(view)
    return at_seam, views


def join_views(scene_views: Sequence[tuple[PicturedScene, list[int]]]) -> PicturedScene:
    """Join views of several scenes without Gaussians into one scene; its photos are kept in a file if they are many.

    ``scene_views`` has pairs of a scene and the ids of its views to join.
    """
    total, cameras = sum(len(ids) for _, ids in scene_views), scene_views[0][0].cameras
    images, count = make_array((total, cameras.height, cameras.width, 3), np.float32), 0
    for scene, ids in scene_views:
        for view in ids:
            images[count] = scene.images[view]
            count += 1
        free_pages([scene.images, images])
    joined = concat_scenes([subset(scene.without_pictures(), ids) for scene, ids in scene_views], images)
    return PicturedScene.with_pictures(replace(joined, cameras=in_float64(joined.cameras)), images, joined.masks)


def _view_weights(splats: Splats, starts: Sequence[BlockStart]) -> Iterator[tuple[int, int, np.ndarray, np.ndarray]]:
    """Yield four values for each block's own views: the block, the view, and rows and weights ``[m]``.

    The rows are those of the Gaussians that the view draws; the weights are the sums of their blending weights there.
    Views are numbered within the prepared scene of their block.
    """
    for number, start in enumerate(starts):
        own_views, repeated = set(start.block.own), start.prepared.repeated
        views = sorted({repeated[i] for i, view in enumerate(start.block.views) if view in own_views})
        photos = blank_photos(start.prepared.scene.cameras[views], 2)

        def list_weights(view: int, photos: Photos = photos) -> tuple[np.ndarray, np.ndarray]:
            """Return the rows and weights of a view of ``photos``."""
            tiled = tile_view(splats, **photos.camera(view))
            return tiled.ids, list_contributions(tiled)[0]

        for view, (ids, weights) in zip(views, in_turn(list_weights, range(len(photos))), strict=True):
            yield number, view, ids, weights
