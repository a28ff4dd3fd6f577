"""Photos -> photos that look as their Gaussians: what was found in each is mended, at every size they are read in."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from gsmerge.facts.views import subset
from gsmerge.raster import render
from gsmerge.raster.photos import row_pictures
from gsmerge.runtime.record import choose, note
from gsmerge.types import LargePhotos, PicturedScene, Scene

CLIPPED = 0.985  # level from which on a pixel does not say how bright it is
NAMED = 4  # views that a note names


@dataclass(frozen=True, eq=False)
class PhotoChange:
    """Changes that mend one photo."""

    bars: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)  # top, bottom, left, right: shares of the sides
    reversed: bool = False  # whether red and blue change places
    tones: np.ndarray | None = None  # [3,256] float32: what each level of each channel becomes
    cover: np.ndarray | None = None  # [h,w] bool at a small size, what is replaced

    def __call__(self, photo: np.ndarray, fill: np.ndarray | None) -> np.ndarray:
        """Mend a photo ``[h,w,3]`` in [0, 1] of any size; ``fill [h,w,3]`` replaces covered pixels."""
        if any(self.bars):  # as whole numbers, which OpenCV resizes alike on every processor
            levels = np.rint(255 * photo.clip(0, 1)).astype(np.uint8)
            photo = self.without_bars(levels, cv2.INTER_LINEAR) / np.float32(255)
        if self.reversed:
            photo = photo[..., ::-1]
        if self.tones is not None:
            photo = look_up(self.tones, photo)
        if self.cover is not None and fill is not None:
            photo = np.where(_enlarge(self.cover, photo.shape)[..., None], fill, photo)
        return np.ascontiguousarray(photo, np.float32)

    def without_bars(self, picture: np.ndarray, interpolation: int) -> np.ndarray:
        """Cut the bars off a picture ``[h,w]`` or ``[h,w,c]`` uint8, and enlarge the rest to the original size."""
        height, width = picture.shape[:2]
        inner = picture[self.inside(height, width)]
        return np.asarray(cv2.resize(inner, (width, height), interpolation=interpolation))

    def inside(self, height: int, width: int) -> tuple[slice, slice]:
        """Return the slices of rows and columns between the bars, for a picture of ``height`` x ``width`` pixels."""
        top, bottom, left, right = self.bars
        rows = slice(round(top * height), height - round(bottom * height))
        return rows, slice(round(left * width), width - round(right * width))


UNCHANGED = PhotoChange()


def is_change(change: PhotoChange) -> bool:
    """Return whether a change alters the photo at all."""
    return any(change.bars) or change.reversed or change.tones is not None or change.cover is not None


def look_up(tones: np.ndarray, photo: np.ndarray) -> np.ndarray:
    """Map the colours of a photo ``[...,3]`` in [0, 1] by a tone curve ``[3,256]``, one row per channel."""
    places = photo.astype(np.float32) * np.float32(255)
    first = np.clip(places.astype(np.int64), 0, 254)
    part, channel = places - first, np.arange(3)
    return np.asarray(tones[channel, first] * (1 - part) + tones[channel, first + 1] * part)


def _enlarge(mask: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Resize a mask ``[h,w]`` to a larger picture; pixels that it covers in part belong to it."""
    large = cv2.resize(mask.astype(np.uint8) * 255, shape[1::-1], interpolation=cv2.INTER_LINEAR)
    return np.asarray(large > 0)


def mend_photos(scene: PicturedScene, changes: Sequence[PhotoChange]) -> PicturedScene:
    """Mend the photos at view size and at full size; masked pixels get the Gaussians' colours."""
    masks = scene.masks
    if masks is not None and any(changes[0].bars):  # which all photos have alike
        cut = [changes[0].without_bars(mask.astype(np.uint8), cv2.INTER_NEAREST) for mask in masks]
        masks = np.stack(cut) > 0
    inside = np.full(len(scene), True)[:, None, None] if masks is None else masks
    changed = [view for view, change in enumerate(changes) if is_change(change)]
    filled = [view for view in range(len(scene)) if changes[view].cover is not None or not inside[view].all()]
    if not changed and not filled:
        return scene
    _note_changes(changes, scene.names)
    fills = dict(zip(filled, own_pictures(scene, filled), strict=True)) if filled else {}
    images = scene.images.copy()
    for view in sorted({*changed, *filled}):
        images[view] = changes[view](images[view], fills.get(view))
        if not inside[view].all():
            images[view] = np.where(inside[view][..., None], images[view], fills[view])
    large = scene.large_photos
    if large is not None and changed:
        large = change_large(large, changes, fills)
    return replace(scene, images=images, large_photos=large, masks=masks)


def change_large(large: LargePhotos, changes: Sequence[PhotoChange], fills: dict[int, np.ndarray]) -> LargePhotos:
    """Return larger photos that are mended whenever they are read.

    ``fills`` has by view the colours of covered pixels.
    """

    def read(view: int) -> np.ndarray:
        photo = large.read(large.ids[view])
        if not is_change(changes[view]):
            return photo
        cover = fills.get(view)
        if cover is not None:  # as whole numbers, which OpenCV resizes alike on every processor
            levels = np.rint(255 * cover.clip(0, 1)).astype(np.uint8)
            cover = cv2.resize(levels, photo.shape[1::-1], interpolation=cv2.INTER_LINEAR) / np.float32(255)
        mended = changes[view](photo / np.float32(255), cover)
        return np.asarray(np.rint(255 * mended.clip(0, 1)), np.uint8)

    return replace(large, ids=tuple(range(len(changes))), read=read)


def _note_changes(changes: Sequence[PhotoChange], names: Sequence[str]) -> None:
    """Note which photos have another tone, and which are covered in part."""
    toned = [view for view, change in enumerate(changes) if change.tones is not None]
    covered = [view for view, change in enumerate(changes) if change.cover is not None]
    choose(photos_changed=[names[view] for view, change in enumerate(changes) if is_change(change)])
    if toned:
        middle = [float(changes[view].tones[:, 128].mean()) / (128 / 255) for view in toned]  # type: ignore[index]
        least, most = min(middle), max(middle)
        factor = f"{least:.2f}" if most - least < 0.01 else f"{least:.2f} to {most:.2f}"
        note(
            f"{len(toned)} of {len(changes)} photos have another tone than their Gaussians (exposure, gamma or linear"
            f" light): compensated, middle grey times {factor}: {list_names(names, toned)}"
        )
    if covered:
        shares = [100 * float(changes[view].cover.mean()) for view in covered]  # type: ignore[union-attr]
        note(
            f"{len(covered)} of {len(changes)} photos show in part what the Gaussians do not (up to {max(shares):.0f} %"
            " of a photo: a mask, a mark, a finger?): the Gaussians' colours take its place:"
            f" {list_names(names, covered)}"
        )


def list_names(names: Sequence[str], views: Sequence[int]) -> str:
    """List the names of views for a message, shortened if there are many."""
    more = f" and {len(views) - NAMED} more" if len(views) > NAMED else ""
    return ", ".join(names[view] for view in views[:NAMED]) + more


def own_pictures(scene: Scene, views: list[int]) -> np.ndarray:
    """Draw pictures ``[n,h,w,3]`` of the given views in the colours of the scene's Gaussians."""
    if not scene.aligned:
        return np.asarray(render(scene.gaussians, scene.cameras[views]).images).clip(0, 1)
    part = subset(scene, views)
    pictures = row_pictures(part)
    valid = part.stored if part.missing is not None else part.valid
    return np.stack([fill_gaps(*pair) for pair in zip(pictures, valid, strict=True)])


def fill_gaps(picture: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Fill unknown pixels of a picture ``[h,w,c]`` with the values of the nearest known pixel."""
    if valid.all() or not valid.any():
        return picture
    _, labels = cv2.distanceTransformWithLabels(
        (~valid).astype(np.uint8), cv2.DIST_L1, 3, labelType=cv2.DIST_LABEL_PIXEL
    )
    nearest = np.zeros(int(labels.max()) + 1, np.int64)
    nearest[labels[valid]] = np.flatnonzero(valid)
    return np.asarray(picture.reshape(valid.size, -1)[nearest[labels]])
