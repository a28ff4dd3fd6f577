"""Scene -> the scene with photos that look like its Gaussians, without photos that do not show it.

Photos with another tone (linear light, exposure or gamma) are corrected by a curve for each channel. Photos that do not
show their views are left out. All photos are left out if their colours have another look, such as exchanged red and
blue. If a pixel of a photo still differs from the colour of its own Gaussian and from a drawing of its view's
Gaussians, something covers the scene there, and the Gaussians' colours are used at this pixel.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from gsmerge.arrays import mean_columns
from gsmerge.errors import Doubt
from gsmerge.method.compare.assign_photos import Assigner, Candidates
from gsmerge.method.compare.colors import (
    EXPOSURE_STEP,
    VISIBLE,
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
    vary_in_hue,
)
from gsmerge.method.compare.similarity import stands_out
from gsmerge.method.compare.view_pictures import (
    PICTURE_PIXELS,
    Pairs,
    ViewPictures,
    draw_canonical,
    pair_photos,
    show_views,
)
from gsmerge.method.geometry.gaps import fill_gaps
from gsmerge.method.geometry.transforms import sh0_to_rgb
from gsmerge.method.geometry.views import camera_kinds
from gsmerge.method.kernels.pictures import convolve
from gsmerge.method.raster import render
from gsmerge.method.raster.photos import counting_pixels, row_pictures, row_shares
from gsmerge.prepare.photo_change import PhotoChange, change_large
from gsmerge.prepare.row_colors import RowPicture, picture_rows
from gsmerge.runtime.memory import human_share
from gsmerge.runtime.record import list_some, note, record_choices
from gsmerge.runtime.threads import parallel_map
from gsmerge.settings.stages import Look
from gsmerge.types import PicturedScene

# Signed differences of pixels are averaged over MEAN_PIXELS x MEAN_PIXELS pixels of the photos that a model saw. If it
# blurs a photo by 1.5 pixels, only 0.5 % of the averages differ by EXPOSURE_STEP
MEAN_PIXELS = 5
LEAST_JUDGED = 0.25  # share of a photo's, or of a window's, pixels that count from which it is judged as a whole
TONE_SAMPLE = 1 << 16  # approximate number of pixels and of Gaussians whose colours are compared
COMPARED_OPACITY = 0.05  # opacity below which a pixel's Gaussian is not compared
GREY_VARIATION = 0.25  # a photo is grey if its hues vary by less than this share of the Gaussians' variation
STRAY_PHOTOS = "do not show what the Gaussians show"  # in notes, of photos that are not used


def compare_photos(scene: PicturedScene, look: Look = "auto") -> tuple[PicturedScene, tuple[int, ...], list[str]]:
    """Correct the photos of a canonical scene, and replace photos, or parts of them, that do not show it.

    Returns the scene, the views whose photos show it, and a sentence for each kind of change. No view is returned if
    most photos do not show the scene, or if the photos have another look, such as exchanged red and blue. With ``look``
    "photos", all photos count unchanged. With ``look`` "scene", no photo counts. The record gets notes and the choices
    ``photos_changed`` and ``photos_left_out``.
    """
    photo_views = scene.photo_views
    if look != "auto" or not photo_views:
        return scene, tuple(photo_views) if look != "scene" else (), []
    pairs = pair_photos(scene, scene.images)
    # what is left of a photo of which most does not count, as of a blurred one, is too little to judge it, and so is a
    # view that has lost most of the rows that views usually have
    shares = counting_pixels(scene).mean((1, 2))
    if scene.has_own_pixels:
        shares = np.minimum(shares, row_shares(scene))
    judged = [view for view in photo_views if shares[view] >= LEAST_JUDGED] or photo_views
    grey = find_grey(pairs, judged)
    if grey:
        scene = _color_photos(scene, grey)
        pairs = pair_photos(scene, scene.images)
    matching = find_matching_views(scene, judged, list(scene.images), pairs.shown)
    if matching:
        matching = [view for view in photo_views if view in matching or view not in judged]
    compared_views = matching or photo_views
    if _has_other_look(scene, pairs, compared_views):
        problem = "the scene has another look than its photos, so it keeps its own colours"
        if are_exchanged(pairs[compared_views]):
            problem = "red and blue are exchanged between Gaussians and photos: either f_dc_0 and f_dc_2 of the file or"
            problem += " the photos are in the order blue, green, red; the scene keeps its own colours"
        note(Doubt(f"{problem}; --set look=photos gives it the look of the photos"))
        return scene, (), []
    stray = [view for view in photo_views if view not in matching]
    if stray:
        names = [scene.names[view] for view in stray]
        record_choices(photos_left_out=names)
        are_few = 2 * len(stray) <= len(photo_views)
        listed = list_some(names)
        result = f" and are not used: {listed}"
        if not are_few:
            result = f", so no photo is used: {listed}; check their names and order"
        note(Doubt(f"{len(stray)} of {len(photo_views)} photos {STRAY_PHOTOS}{result}"))
        if not are_few:
            return scene, (), []
    changes, toned = correct_tones(scene, pairs, matching)
    hidden = np.zeros(scene.images.shape[:3], bool)
    pictures = None
    if scene.has_own_pixels:
        hidden, pictures = _find_hidden(scene, changes)
    changed = [view for view in matching if hidden[view].any() or changes[view] or view in grey]
    if changed:
        record_choices(photos_changed=[scene.names[view] for view in changed])
    said = [_describe_grey(scene, grey) if grey else "", toned, _describe_hidden(scene, hidden, matching)]
    return _change_photos(scene, changes, hidden, pictures, matching), tuple(matching), said


def correct_tones(scene: PicturedScene, pairs: Pairs, views: Sequence[int]) -> tuple[list[PhotoChange], str]:
    """Find, for each of ``views``, the tone curve ``[3,256]`` from its photo to its Gaussians.

    Returns the change of each photo of the scene, and a sentence about tones that differ. If the pictures of the
    Gaussians are drawings, all photos share a curve. If no photo changes by more than :data:`EXPOSURE_STEP`, no curve
    counts, because models themselves change tones slightly. A curve counts only if the inverse curve, from Gaussians to
    photos, reduces errors, too. The inverse curve reduces no errors if photos and Gaussians differ by noise, which
    flattens the colours of Gaussians.
    """
    curves = dict[int, np.ndarray]()
    is_large = False
    stored = cut_blocks(pairs)
    groups = [group for group in _group_by_curve(pairs, views) if is_visible(stored.errors(group))]
    toned = tone_blocks(pairs, groups)
    inverse = tone_blocks(pairs.exchange(), groups)
    for group in groups:
        errors = stored.errors(group)
        if explains(errors, toned.errors(group)) and stands_out(errors - inverse.errors(group)):
            is_large |= bool(np.nanmedian(stored.distances(toned.photos, group)) > EXPOSURE_STEP)
            colors, targets = (images[group].reshape(-1, 3) for images in (pairs.photos, pairs.shown.pictures))
            curve = fit_tones(colors, targets, pairs.shown.weights[group].reshape(-1))
            curves |= dict.fromkeys(group, curve)
    if not is_large or (pairs.shown.drawn and not have_other_tones(scene, views)):
        return [PhotoChange()] * len(pairs), ""
    middle_grey = 128  # level of 255 at which notes report the change of tone
    factors = [float(curve[:, middle_grey].mean()) / (middle_grey / 255) for curve in curves.values()]
    low = min(factors)
    high = max(factors)
    factor = f"{low:.2f}" if high - low < 0.01 else f"{low:.2f} to {high:.2f}"
    change = (
        f"{len(curves)} of {len(views)} photos have another tone than their Gaussians (exposure, gamma or linear"
        f" light), which is corrected; middle grey times {factor}: {list_some([scene.names[view] for view in curves])}"
    )
    return [PhotoChange(curves.get(view)) for view in range(len(pairs))], change


def find_grey(pairs: Pairs, views: Sequence[int]) -> dict[int, float]:
    """Find the ``views`` whose photos have no hues although their Gaussians have.

    Returns for each such view the variation of the hues in its photo, divided by that of the Gaussians' hues.
    """
    hue_sample = 2_000  # approximate number of pixels of a photo whose hues are compared, if it has as many
    shares = dict[int, float]()
    step = 1 + pairs.photos[0].size // (3 * hue_sample)
    for view in views:
        weights = pairs.shown.weights[view].reshape(-1)[::step]
        photo, shown = (images[view].reshape(-1, 3)[::step] for images in (pairs.photos, pairs.shown.pictures))
        hues = vary_in_hue(photo, weights)
        if hues >= VISIBLE or photo.std() <= VISIBLE:  # as in nearly all photos
            continue
        shown_hues = vary_in_hue(shown, weights)
        if hues < GREY_VARIATION * shown_hues and shown_hues > VISIBLE:
            shares[view] = hues / shown_hues
    return shares


def _color_photos(scene: PicturedScene, grey: Mapping[int, float]) -> PicturedScene:
    """Give grey photos the hues of the Gaussians, but keep the photos' brightness.

    ``grey`` is the result of :func:`find_grey`.
    """
    changes = [PhotoChange()] * len(scene)
    views = list(grey)
    if scene.has_own_pixels:
        colors = row_pictures(scene)[views]
    else:
        colors = draw_canonical(scene.gaussians, scene.cameras[views], max(scene.images.shape[1:3])).pictures
    for view, picture in zip(views, colors, strict=True):
        changes[view] = PhotoChange(cover=np.full(picture.shape[:2], True), colors=picture, keeps_brightness=True)
    return _apply_changes(scene, changes)


def _describe_grey(scene: PicturedScene, grey: Mapping[int, float]) -> str:
    """Say which photos are grey; ``grey`` is the result of :func:`find_grey`."""
    names = list_some([scene.names[view] for view in grey])
    return (
        f"{len(grey)} of {len(scene.photo_views)} photos are grey or of one tint (their hues vary by"
        f" {100 * max(grey.values()):.0f} % of the Gaussians' at most): only their brightness counts, and the Gaussians"
        f" keep their hues ({names}; --set look=photos makes them grey)"
    )


def have_other_tones(scene: PicturedScene, views: Sequence[int]) -> bool:
    """Return whether the base colours of all Gaussians have another tone than the photos of ``views``.

    Models take the base colours from the photos, even the colours of hidden Gaussians. Drawings are a weaker test than
    base colours: if depth is wrong, the Gaussians that hide others can give a drawing another tone.
    """
    solid = np.flatnonzero(scene.gaussians.opacities > COMPARED_OPACITY)
    step = 1 + len(views) * scene.pixels_per_view // TONE_SAMPLE
    counting = counting_pixels(scene)
    levels = np.concatenate([scene.images[view][counting[view]][::step] for view in views])
    if not (len(solid) and len(levels)):
        return True
    rows = solid[np.linspace(0, len(solid) - 1, len(levels)).astype(np.int64)]
    colors = sh0_to_rgb(scene.gaussians.sh0[rows, 0]).clip(0, 1)
    curve = fit_tones(levels, colors, np.ones(len(levels), np.float32))
    return bool(np.median(np.abs(map_tones(curve, levels) - levels).mean(1)) > EXPOSURE_STEP)


def _group_by_curve(pairs: Pairs, views: Sequence[int]) -> list[list[int]]:
    """Group the views whose photos share a tone curve.

    If the pictures of the Gaussians are drawings, all views are one group, because drawings show tones less exactly.
    Otherwise each view is a separate group.
    """
    return [list(views)] if pairs.shown.drawn else [[view] for view in views]


def find_matching_views(
    scene: PicturedScene, views: Sequence[int], photos: Sequence[np.ndarray], shown: ViewPictures
) -> list[int]:
    """Find which of ``views`` are shown by their ``photos [h,w,3]``; see :mod:`gsmerge.method.compare.assign_photos`.

    No view is returned if all photos together match their views no better than photos match other views. Views of one
    camera share one photo. ``shown`` are small pictures of the Gaussians in all views, which are reused if they are
    drawings.
    """
    camera_ids = camera_kinds(scene.cameras)
    ids = sorted({camera_ids[view]: view for view in reversed(views)}.values())  # the first view of each camera
    candidates = Candidates(read=lambda photo: photos[ids[photo]], count=len(ids), tag=lambda _: 0)

    def show(side: int) -> ViewPictures:
        """Make pictures of the views ``ids`` with up to ``side`` pixels on the longer side."""
        return (shown.shrink(side) if shown.drawn and side <= PICTURE_PIXELS else show_views(scene, side))[ids]

    assigner = Assigner(show, candidates)
    confirmed_photos, _ = assigner.confirm(range(len(ids)), exact=True)
    if not assigner.match_together(confirmed_photos):
        return []
    # views without contrast count as matching, because they cannot be compared
    results = zip(ids, confirmed_photos, assigner.has_contrast, strict=True)
    matching = {camera_ids[view] for view, photo, has_contrast in results if photo is not None or not has_contrast}
    return [view for view in views if camera_ids[view] in matching]


def _has_other_look(scene: PicturedScene, pairs: Pairs, views: Sequence[int]) -> bool:
    """Return whether a linear map of colours, but no tone curve, explains how the photos differ from the Gaussians.

    The map may lead from photos to Gaussians, or from Gaussians to photos, for example to grey photos. Photos of
    another scene do not count as another look, because photos must match their views after the map, and because the map
    must explain more than a single colour does. Only ``views`` are compared.
    """
    view_pairs = pairs[views]
    if _is_mapped(view_pairs):
        blocks = cut_blocks(view_pairs)
        solid = blocks.solid
        matrix = fit_map(blocks.photos[solid], blocks.pictures[solid], np.ones(solid.sum()))
        mapped = [map_colors(matrix, photo).clip(0, 1) for photo in scene.images]
        return bool(find_matching_views(scene, views, mapped, pairs.shown))
    return _is_mapped(view_pairs.exchange()) and bool(
        find_matching_views(scene, views, list(scene.images), pairs.shown)
    )


def are_exchanged(pairs: Pairs) -> bool:
    """Return True if photos with red and blue exchanged match the pictures, and a linear map matches no better."""
    stored = cut_blocks(pairs)
    exchanged = cut_blocks(pairs.with_photos(pairs.photos[..., ::-1]))
    before = stored.errors()
    after = exchanged.errors()
    return explains(before, after) and not explains(after, map_blocks(stored).errors())


def _is_mapped(pairs: Pairs) -> bool:
    """Return whether a linear map of the photos' colours explains the pictures better than tone curves or a colour."""
    stored = cut_blocks(pairs)
    if not is_visible(stored.errors()):
        return False
    toned = tone_blocks(pairs, _group_by_curve(pairs, range(len(pairs))))
    mapped = map_blocks(stored)
    return is_visible(toned.errors()) and all(
        explains(blocks.errors(), mapped.errors()) for blocks in (toned, plain_blocks(stored))
    )


def _describe_hidden(scene: PicturedScene, hidden: np.ndarray, views: Sequence[int]) -> str:
    """Say in which photos of ``views`` something covers the scene, at the pixels ``hidden [v,h,w]``; "" for none."""
    with_hidden = [view for view in views if hidden[view].any()]
    if not with_hidden:
        return ""
    most = human_share(float(hidden[with_hidden].mean((1, 2)).max()), 0)
    return (
        f"{len(with_hidden)} of {len(views)} photos differ in part from their Gaussians"
        f" (up to {most} of a photo; perhaps a mask, a mark, a finger, another look or camera):"
        f" the Gaussians' colours are used there ({list_some([scene.names[view] for view in with_hidden])};"
        " --set look=scene uses them everywhere)"
    )


def row_spacing(with_row: np.ndarray) -> int:
    """Return the distance in pixels of the pixels ``[v,h,w]`` that have a row.

    Beside photos that are larger than those a model saw, only some pixels have a row, with the mean colour of the
    pixels around it.
    """
    beside = (with_row[..., 1:] & with_row[..., :-1]).sum()
    return round(float(np.sqrt(with_row.size / max(1, with_row.sum())))) if 2 * beside < with_row.sum() else 1


def _find_hidden(scene: PicturedScene, changes: Sequence[PhotoChange]) -> tuple[np.ndarray, np.ndarray]:
    """Find the pixels ``[v,h,w]`` at which something covers the scene in its changed photos.

    Also returns pictures ``[v,h,w,3]`` of the colours of the views' own Gaussians. A photo is compared with the base
    colours of its view's Gaussians. A photo that differs somewhere is also compared with a drawing of these Gaussians,
    which takes longer. Something covers the scene where the photo differs from base colours and drawing. A pixel
    without a Gaussian takes the result of the nearest pixel with a Gaussian.
    """

    def differ(view: int, picture: np.ndarray, known: np.ndarray) -> np.ndarray:
        """Return a mask of the pixels at which a view's photo differs from ``picture``, in its ``known`` part."""
        around = convolve(known.astype(np.float32), window, window)
        # what is left of a view that has lost its rows is too little to judge the pixels around it
        is_sparse = known & (around <= LEAST_JUDGED / spacing**2)
        if is_sparse.any():
            known = known & ~is_sparse
            around = convolve(known.astype(np.float32), window, window)
        photo = changes[view](scene.images[view])
        if spacing > 1:
            photo = convolve(photo, footprint, footprint)
        difference = (photo - picture) * known[..., None]
        differs = known & (mean_columns(np.abs(convolve(difference, window, window))) > EXPOSURE_STEP * around)
        return fill_gaps(differs[..., None], known)[..., 0] if differs.any() else differs

    def compare_drawn(views: np.ndarray, drawn: RowPicture) -> None:
        """Compare the photos of ``views`` with a drawing, and update ``hidden`` and ``pictures`` of these views."""
        for view in views:
            known = shown[view] & inside[view] & drawn.known  # a pixel needs a Gaussian
            pictures[view] = drawn.picture
            hidden[view] = differ(view, drawn.picture, known) & differ(view, drawn.drawing, known)

    inside = counting_pixels(scene)
    pictures, pixels = row_pictures(scene), scene.get_pixels()
    shown = pixels.shown
    with_row = shown & (scene.gaussians.opacities[pixels.fronts] > COMPARED_OPACITY) & inside
    spacing = row_spacing(with_row)
    footprint, window = (np.full(side | 1, 1 / (side | 1), np.float32) for side in (spacing, MEAN_PIXELS * spacing))
    hidden = np.stack(parallel_map(lambda view: differ(view, pictures[view], with_row[view]), range(len(scene))))
    picture_rows(scene, compare_drawn, np.asarray((hidden | ~inside).any((1, 2))))
    return hidden, pictures


def _change_photos(
    scene: PicturedScene,
    changes: Sequence[PhotoChange],
    hidden: np.ndarray,
    pictures: np.ndarray | None,
    views: Sequence[int],
) -> PicturedScene:
    """Change the photos of ``views``, and use the Gaussians' colours at ``hidden [v,h,w]`` pixels and in other views.

    Small and large photos are changed alike. The Gaussians' colours are ``pictures [v,h,w,3]``, or renders if
    ``pictures`` is None. The pixels of other views count only if each Gaussian belongs to one view. ``hidden`` is
    changed in place: all pixels of other views, and pixels outside masks, become hidden.
    """
    other_views = sorted({*range(len(scene))} - {*views})
    hidden[other_views] = True
    if scene.masks is not None:
        hidden |= ~scene.masks
    if other_views:
        masks = np.full(hidden.shape, True) if scene.masks is None else scene.masks.copy()
        masks[other_views] = scene.has_own_pixels
        scene = replace(scene, masks=None if masks.all() else masks)
    with_hidden = np.flatnonzero(hidden.any((1, 2)))
    if len(with_hidden) == 0 and not any(changes):
        return scene
    changes = list(changes)
    if len(with_hidden):
        if pictures is None:
            covers = render(scene.gaussians, scene.cameras[with_hidden]).images.clip(0, 1)
        else:
            covers = pictures[with_hidden]
        for view, colors in zip(with_hidden, covers, strict=True):
            changes[view] = replace(changes[view], cover=hidden[view], colors=colors)
    return _apply_changes(scene, changes)


def _apply_changes(scene: PicturedScene, changes: Sequence[PhotoChange]) -> PicturedScene:
    """Apply a change to each view's photo, small and large."""
    images = np.stack([change(photo) for change, photo in zip(changes, scene.images, strict=True)])
    large = None if scene.large_photos is None else change_large(scene.large_photos, changes)
    return replace(scene, images=images, large_photos=large)
