"""Scene -> the same with photos that look as its Gaussians, without those that do not show it.

Photos with red and blue in the wrong order and of another tone (linear light, exposure, gamma: a curve for each
channel) are mended; those that do not show their views are left out. Where a photo then still differs from what the
Gaussians of its own pixels show, whatever their depths are, their colours count: something covers the scene there.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gsmerge.evidence.assign import Assigner, Candidates
from gsmerge.evidence.colors import (
    STEP,
    cut_blocks,
    explains,
    fit_map,
    fit_tones,
    is_visible,
    map_blocks,
    map_colors,
    map_tones,
    plain_blocks,
    tone_blocks,
)
from gsmerge.evidence.pictures import SIDE, Pairs, ViewPictures, pair_photos, show_views
from gsmerge.evidence.rays import find_on_rays
from gsmerge.evidence.scores import MARGIN, signed_ranks, stands_out
from gsmerge.facts.photo_change import PhotoChange, change_large
from gsmerge.facts.row_colors import RowPicture, fill_gaps, picture_rows
from gsmerge.facts.views import camera_kinds
from gsmerge.geometry import sh0_to_rgb
from gsmerge.kernels.pictures import convolve
from gsmerge.raster import render
from gsmerge.raster.photos import row_pictures
from gsmerge.runtime.record import choose, list_some, note
from gsmerge.runtime.threads import parallel_map
from gsmerge.settings.stages import Look
from gsmerge.types import PicturedScene

# Differences of single pixels are averaged over 5, with their signs. A blur of 1.5 pixels, as models have, then makes
# 0.5 % of the pixels differ by a step.
WINDOW = np.full(5, 1 / 5, np.float32)
TONE_SAMPLE = 1 << 16  # pixels and Gaussians whose colours are compared, about
FAINT = 0.05  # opacity below which a pixel's Gaussian is not compared
STRAY_PHOTOS = "photos do not show what the Gaussians show"  # in the note on photos that are not used


def compare_photos(scene: PicturedScene, look: Look = "auto") -> tuple[PicturedScene, tuple[int, ...]]:
    """Mend the photos of a canonical scene, and replace what does not show it.

    Returns the scene and the views whose photos show it; there are none if most photos do not, or have another look.
    With ``look`` "photos" all count as they are, with "scene" none. The record gets notes and the choices
    ``photos_changed`` and ``photos_left_out``.
    """
    given = scene.photo_views
    if look != "auto" or not given:
        return scene, tuple(given) if look != "scene" else ()
    pairs = pair_photos(scene, scene.images)
    order = find_orders(pairs, given)
    pairs = pairs.with_photos(np.where(order[:, None, None, None], pairs.photos[..., ::-1], pairs.photos))
    images = [photo[..., ::-1] if wrong else photo for photo, wrong in zip(scene.images, order, strict=True)]
    right = find_matching_views(scene, given, images, pairs.shown)
    if _has_other_look(scene, pairs, right or given, images):
        problem = "the scene has another look than its photos: its own colours are kept"
        note(f"{problem}; --set look=photos gives it that of the photos")
        return scene, ()
    odd = [view for view in given if view not in right]
    if odd and not _leave_out(scene, odd, given):
        return scene, ()
    _note_orders(scene, order, right)
    tones = find_tones(pairs, right)
    if pairs.shown.drawn and not have_other_tones(scene, images, right):
        tones = [None] * len(pairs)
    changes = [PhotoChange(bool(wrong), curve) for wrong, curve in zip(order, tones, strict=True)]
    _note_tones(scene, changes, right)
    hidden, pictures = np.zeros(scene.images.shape[:3], bool), None
    if scene.has_own_pixels:
        hidden, pictures = _find_hidden(scene, changes)
        _note_hidden(scene, hidden, right)
    changed = [view for view in right if hidden[view].any() or changes[view]]
    if changed:
        choose(photos_changed=[scene.names[view] for view in changed])
    return _replace_others(scene, changes, hidden, pictures, right), tuple(right)


def find_orders(pairs: Pairs, views: Sequence[int]) -> np.ndarray:
    """Find in which photos ``[v]`` of some views red and blue change places, whatever their tones are.

    Colours as they are and after tone curves have a say each: a change of tone hides in the ones, and curves of covered
    photos fit either order.
    """
    swapped, wrong = pairs.with_photos(np.ascontiguousarray(pairs.photos[..., ::-1])), np.zeros(len(pairs), bool)
    changes = [(cut_blocks(pairs), cut_blocks(swapped))]
    some = [[view] for view in views if is_visible(changes[0][0].errors([view]))]
    if some:  # else their order is right
        changes += [(tone_blocks(pairs, some), tone_blocks(swapped, some))]

    def score(ids: Sequence[int]) -> float:
        scores = [signed_ranks(before.errors(ids) - after.errors(ids)) for before, after in changes]
        return sum(scores) / math.sqrt(len(scores))  # Stouffer's sum, in standard deviations

    scores = {view: score([view]) for view in views}
    if max(score(views), *scores.values()) > MARGIN:
        wrong[[view for view in views if scores[view] > 0]] = True
    return wrong


def find_tones(pairs: Pairs, views: Sequence[int]) -> list[np.ndarray | None]:
    """Find the tone curves ``[3,256]`` from photos to their Gaussians; None for a photo whose tone is right.

    Drawings have one curve for all photos. Where none is changed by a step, no curve counts, since models have a tone
    of their own; nor does one with which Gaussians do not become more like their photos in turn: noise flattens what
    they show, and is no tone.
    """
    curves, clear = list[np.ndarray | None]([None] * len(pairs)), False
    stored, groups = cut_blocks(pairs), _group(pairs, views)
    groups = [group for group in groups if is_visible(stored.errors(group))]
    toned, back = tone_blocks(pairs, groups), tone_blocks(pairs.exchange(), groups)
    for group in groups:
        before = stored.errors(group)
        if explains(before, toned.errors(group)) and stands_out(before - back.errors(group)):
            clear |= bool(np.nanmedian(stored.distances(toned.photos, group)) > STEP)
            colors, targets = (each[group].reshape(-1, 3) for each in (pairs.photos, pairs.shown.pictures))
            curve = fit_tones(colors, targets, pairs.shown.weights[group].reshape(-1))
            for view in group:
                curves[view] = curve
    return curves if clear else [None] * len(pairs)


def have_other_tones(scene: PicturedScene, photos: Sequence[np.ndarray], views: Sequence[int]) -> bool:
    """Return whether the colours of Gaussians, seen from nowhere, have another tone than the ``photos`` of some views.

    Each has a colour of some photo, whatever hides it in drawings. So the tone of a drawing alone is that of what
    stands in front where depth is wrong.
    """
    solid = np.flatnonzero(scene.gaussians.opacities > FAINT)
    step = 1 + len(views) * scene.pixels_per_view // TONE_SAMPLE
    counting = [np.full(photo.shape[:2], True) for photo in photos] if scene.masks is None else scene.masks
    levels = np.concatenate([photos[view][counting[view]][::step] for view in views])
    if not (len(solid) and len(levels)):
        return True
    rows = solid[np.linspace(0, len(solid) - 1, len(levels)).astype(np.int64)]
    colors = sh0_to_rgb(scene.gaussians.sh0[rows, 0]).clip(0, 1)
    curve = fit_tones(levels, colors, np.ones(len(levels), np.float32))
    return bool(np.median(np.abs(map_tones(curve, levels) - levels).mean(1)) > STEP)


def _group(pairs: Pairs, views: Sequence[int]) -> list[list[int]]:
    """Group views whose photos have one tone: all those of drawings, which show it less exactly."""
    return [list(views)] if pairs.shown.drawn else [[view] for view in views]


def find_matching_views(
    scene: PicturedScene, views: Sequence[int], photos: Sequence[np.ndarray], shown: ViewPictures
) -> list[int]:
    """Find which of some views their ``photos [h,w,3]`` show; see :mod:`gsmerge.evidence.assign`.

    None where all together are no more alike than wrong pairs. Layers of one camera have one photo. ``shown``:
    small pictures of what the Gaussians show in all views; drawings serve again.
    """
    kinds = camera_kinds(scene.cameras)
    ids = sorted({kinds[view]: view for view in reversed(views)}.values())
    candidates = Candidates(lambda photo: photos[ids[photo]], len(ids), [0] * len(ids))

    def show(side: int) -> ViewPictures:
        return (shown.shrink(side) if shown.drawn and side <= SIDE else show_views(scene, side))[ids]

    assigner = Assigner(show, candidates)
    chosen, _ = assigner.confirm(range(len(ids)), exact=True)
    sure, on_rays = np.array([each is not None for each in chosen]), np.zeros(len(ids), bool)
    if not sure.all():
        on_rays = find_on_rays(scene, ids, [photos[view] for view in ids])
    if not (assigner.match_together(chosen) or on_rays.any()):
        return []
    sure |= on_rays
    decided = zip(ids, sure, assigner.has_contrast, strict=True)  # but for views that show nothing to go by
    right = {kinds[view] for view, stands, judged in decided if stands or not judged}
    return [view for view in views if kinds[view] in right]


def _has_other_look(scene: PicturedScene, pairs: Pairs, views: Sequence[int], photos: Sequence[np.ndarray]) -> bool:
    """Return whether a linear map of colours explains the Gaussians by their photos, or these by them: tones do not.

    Grey photos show no colours, but follow from them. Photos of another scene are explained no better than by one
    colour, or do not show their views even so.
    """
    part = pairs[views]
    if _is_mapped(part):
        blocks = cut_blocks(part)
        solid = blocks.solid
        matrix = fit_map(blocks.photos[solid], blocks.pictures[solid], np.ones(solid.sum()))
        mapped = [map_colors(matrix, photo).clip(0, 1) for photo in photos]
        return bool(find_matching_views(scene, views, mapped, pairs.shown))
    return _is_mapped(part.exchange()) and bool(find_matching_views(scene, views, photos, pairs.shown))


def _is_mapped(pairs: Pairs) -> bool:
    """Return whether a linear map of the photos' colours comes nearer to the pictures than tones and one colour."""
    stored = cut_blocks(pairs)
    if not is_visible(stored.errors()):
        return False
    toned, mapped = tone_blocks(pairs, _group(pairs, range(len(pairs)))), map_blocks(stored)
    others = toned, plain_blocks(stored)
    return is_visible(toned.errors()) and all(explains(other.errors(), mapped.errors()) for other in others)


def _leave_out(scene: PicturedScene, odd: Sequence[int], given: Sequence[int]) -> bool:
    """Note which of the given photos do not show the scene; return whether the others are used."""
    names = [scene.names[view] for view in odd]
    choose(photos_left_out=names)
    few, which = 2 * len(odd) <= len(given), list_some(names)
    result = f" and are not used: {which}" if few else f", so none is used: {which}; check their names and order"
    note(f"{len(odd)} of {len(given)} {STRAY_PHOTOS}{result}")
    return few


def _note_orders(scene: PicturedScene, wrong: np.ndarray, views: Sequence[int]) -> None:
    """Note in which of some photos red and blue change places."""
    names = [scene.names[view] for view in views if wrong[view]]
    if len(names) == len(views):
        note("red and blue are in the wrong order in the photos (BGR): they change places")
    elif names:
        some = f"{len(names)} of {len(views)} photos: they change places: {list_some(names)}"
        note(f"red and blue are in another order in {some}")


def _note_tones(scene: PicturedScene, changes: Sequence[PhotoChange], views: Sequence[int]) -> None:
    """Note by how much the tones of photos change."""
    toned = {view: changes[view].tones for view in views if changes[view].tones is not None}
    if not toned:
        return
    middle = [float(curve[:, 128].mean()) / (128 / 255) for curve in toned.values() if curve is not None]
    least, most = min(middle), max(middle)
    factor = f"{least:.2f}" if most - least < 0.01 else f"{least:.2f} to {most:.2f}"
    note(
        f"{len(toned)} of {len(views)} photos have another tone than their Gaussians (exposure, gamma or linear"
        f" light): compensated, middle grey times {factor}: {list_some([scene.names[view] for view in toned])}"
    )


def _note_hidden(scene: PicturedScene, hidden: np.ndarray, views: Sequence[int]) -> None:
    """Note in which of some photos something covers the scene, ``hidden [v,h,w]``."""
    with_hidden = [view for view in views if hidden[view].any()]
    if not with_hidden:
        return
    most = 100 * max(float(hidden[view].mean()) for view in with_hidden)
    note(
        f"{len(with_hidden)} of {len(views)} photos show in part what their Gaussians do not (up to {most:.0f} % of a"
        " photo: a mask, a mark, a finger, another look or camera?): the Gaussians' colours take its place,"
        f" --set look=scene everywhere: {list_some([scene.names[view] for view in with_hidden])}"
    )


def _find_hidden(scene: PicturedScene, changes: Sequence[PhotoChange]) -> tuple[np.ndarray, np.ndarray]:
    """Find the pixels ``[v,h,w]`` where changed photos differ from their own rows, and what these show ``[v,h,w,3]``.

    Pixels without a row are as the nearest with one. Only where the rows' base colours differ are each view's own
    Gaussians drawn from its camera, which takes longer; a photo that looks as the drawing does not differ.
    """

    def differ(view: int, picture: np.ndarray, known: np.ndarray) -> np.ndarray:
        weights = known.astype(np.float32)
        away = (changes[view](scene.images[view]) - picture) * weights[..., None]
        red, green, blue = np.moveaxis(np.abs(convolve(away, WINDOW, WINDOW)), -1, 0)
        far = known & ((red + green + blue) / 3 > STEP * convolve(weights, WINDOW, WINDOW))
        return fill_gaps(far[..., None], known)[..., 0]

    def differ_drawn(views: np.ndarray, rows: RowPicture) -> None:
        for view in views:
            known = shown[view] & inside[view] & rows.known  # what spills over from beside says nothing
            pictures[view] = rows.picture
            hidden[view] = differ(view, rows.picture, known) & differ(view, rows.drawing, known)

    inside = np.full(scene.images.shape[:3], True) if scene.masks is None else scene.masks
    pictures, pixels = row_pictures(scene), scene.get_pixels()
    shown = pixels.shown
    known = shown & (scene.gaussians.opacities[pixels.fronts] > FAINT) & inside
    hidden = np.stack(parallel_map(lambda view: differ(view, pictures[view], known[view]), range(len(scene))))
    picture_rows(scene, differ_drawn, np.asarray((hidden | ~inside).any((1, 2))))
    return hidden, pictures


def _replace_others(
    scene: PicturedScene,
    changes: Sequence[PhotoChange],
    hidden: np.ndarray,
    pictures: np.ndarray | None,
    views: Sequence[int],
) -> PicturedScene:
    """Change photos at both sizes; where ``hidden [v,h,w]`` and but in ``views`` they become what Gaussians show.

    That is ``pictures [v,h,w,3]``; None: drawings. What stands in for photos that do not exist counts.
    """
    others = sorted({*range(len(scene))} - {*views})
    hidden[others] = True
    if scene.masks is not None:
        hidden |= ~scene.masks
        absent = sorted({*others} - {*scene.photo_views})
        if absent:
            masks = scene.masks.copy()
            masks[absent] = True
            scene = replace(scene, masks=None if masks.all() else masks)
    with_hidden = np.flatnonzero(hidden.any((1, 2)))
    if len(with_hidden) == 0 and not any(changes):
        return scene
    changes = list(changes)
    if len(with_hidden):
        drawn = (
            render(scene.gaussians, scene.cameras[with_hidden]).images.clip(0, 1)
            if pictures is None
            else pictures[with_hidden]
        )
        for view, colors in zip(with_hidden, drawn, strict=True):
            changes[view] = replace(changes[view], cover=hidden[view], colors=colors)
    images = np.stack([change(photo) for change, photo in zip(changes, scene.images, strict=True)])
    large = None if scene.large_photos is None else change_large(scene.large_photos, changes)
    return replace(scene, images=images, large_photos=large)
