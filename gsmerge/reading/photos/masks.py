"""Read masks of photos from files and from transparency: which pixels count, and with which weight."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np

from gsmerge.errors import Doubt, SceneError
from gsmerge.frozen import dataclass
from gsmerge.io.cameras.camera_file import CameraFile
from gsmerge.io.image_names import find_image, match_masks
from gsmerge.io.photo_files import (
    WHOLE,
    Part,
    PhotoArrays,
    Size,
    cut_part,
    decode_alpha,
    decode_levels,
    decode_small,
    image_size,
    limit_size,
    reaches_beyond,
    same_shape,
)
from gsmerge.method.compare.offsets import OFFSET_PIXELS
from gsmerge.method.geometry.transforms import is_inside, project
from gsmerge.method.kernels.pictures import turn_picture
from gsmerge.reading.photos.scene_photos import ScenePhotos, is_grey
from gsmerge.reading.scene_files import SceneFiles
from gsmerge.runtime.record import list_some
from gsmerge.runtime.threads import parallel_map
from gsmerge.settings.reading import NONE
from gsmerge.types import PROTECTED, Cameras, Scene, StrPath

_WHITE = np.uint8(255)


class CameraMaskError(SceneError):
    """Raised if the camera file lists photos as masks."""


@dataclass(frozen=True, eq=False)
class Masks:
    """Masks and weights of the pixels of v views."""

    counts: np.ndarray | None = None  # [v,h,w] bool, True for a pixel that counts; None: all pixels count
    importance: np.ndarray | None = None  # [v,h,w] float32, weight of a pixel in a fit; None: all weights are 1
    num_files: int = 0  # number of photos that have a file of a mask


NO_MASKS = Masks()


@dataclass(frozen=True, eq=False)
class MaskFiles:
    """The mask files of v photos, and how a picture of the photo's size is cropped to the view."""

    photos: tuple[Path | None, ...]  # files of the photos; empty if the photos are inside another file
    turns: Sequence[int]  # orientation of each photo's file, 0 to 7; odd if the photo is stored on its side
    masks: Sequence[Path | None]  # dark where a photo does not count
    protecting: Sequence[Path | None]  # white where a photo counts more
    parts: Sequence[Part]  # the part of each upright photo that is used; what lies beyond the photo does not count
    is_canvas: bool  # True: the view, too, ends where the photo does, and what lies beyond has a weight of 0
    stored: Size  # size of these parts
    cut: Callable[[int, np.ndarray], np.ndarray]  # view, picture of the size ``stored`` -> what the view shows of it
    cameras: Cameras
    stored_counts: np.ndarray | None = None  # [v,h,w] bool, where photos inside another file count; None: everywhere
    is_plain: bool = False  # whether transparency leaves nothing out

    def read(self, view: int) -> tuple[np.ndarray | None, np.ndarray | None]:
        """Read which pixels ``[h,w]`` of a view count, and their weights ``[h,w]``; None: all count, with weight 1."""
        photo = self.photos[view] if self.photos else None
        part = self.parts[view]
        counts = None
        importance: np.ndarray | None = None
        alpha = None if self.stored_counts is None else self.stored_counts[view]  # only of photos without files
        if photo is not None and not self.is_plain:
            alpha = decode_alpha(photo)
        min_level = 191  # level of 255; a pixel counts if three quarters of the file's pixels in it count
        if photo is not None and reaches_beyond(part):
            whole = np.full(image_size(photo)[::-1], True)
            alpha = whole if alpha is None else alpha
            if self.is_canvas:
                inside = cut_part(turn_picture(whole, self.turns[view]), part)
                importance = (self._reduce(inside * _WHITE, view) > 0).astype(np.float32)
        if alpha is not None:
            opaque = cut_part(turn_picture(alpha, self.turns[view]), part)
            counts = self._reduce(opaque * _WHITE, view) > min_level
        if (mask := self.masks[view]) is not None:
            levels = self._read_levels(mask, view)
            is_light = levels > _WHITE // 2
            light = self._reduce(is_light * _WHITE, view)
            counts = (light > min_level) if counts is None else counts & (light > min_level)
            if (levels[is_light] < _WHITE).any():  # grey means a lower weight: the mean over the pixels that count
                shares = self._reduce(levels * is_light, view) / np.maximum(light, np.float32(1))
                importance = np.where(light > 0, shares, np.float32(1)) * (1 if importance is None else importance)
        if (mask := self.protecting[view]) is not None:
            share = self._reduce(self._read_levels(mask, view), view) / np.float32(_WHITE)
            importance = (1 if importance is None else importance) * (1 + (PROTECTED - 1) * share)
        return counts, importance

    def _read_levels(self, mask: Path, view: int) -> np.ndarray:
        """Read the brightness of a mask, and turn it upright if it has the orientation of the photo's file."""
        photo = self.photos[view] if self.photos else None
        opaque = _read_cutout(mask)
        whole = decode_levels(mask, photo) if opaque is None else opaque * _WHITE
        turns = self.turns[view]
        if photo is not None:
            size = image_size(photo)
            if turns % 2 and same_shape(size, whole.shape[1::-1]):
                whole = turn_picture(whole, turns)
            upright = size[::-1] if turns % 2 else size
            if same_shape(upright, whole.shape[1::-1]):
                whole = cut_part(whole, self.parts[view])
        if not same_shape(self.stored, whole.shape[1::-1]):
            width, height = self.stored
            columns, lines = whole.shape[1::-1]
            problem = (
                f"expected a mask with the aspect ratio of its photo, {width} x {height}, found {columns} x {lines}"
            )
            raise SceneError(mask, problem, "save it with the aspect ratio of the upright photo")
        return whole

    def _reduce(self, levels: np.ndarray, view: int) -> np.ndarray:
        """Reduce a mask to the size of the view, by the mean of its ``levels`` in each pixel."""
        whole = cv2.resize(levels, self.stored, interpolation=cv2.INTER_NEAREST)
        shown = self.cut(view, whole[..., None].repeat(3, -1))[..., 0]
        size = self.cameras.width, self.cameras.height
        return np.asarray(cv2.resize(shown, size, interpolation=cv2.INTER_AREA))


def read_masks(
    files: SceneFiles,
    camera_file: CameraFile,
    photos: ScenePhotos,
    stored: Size,
    cut: Callable[[int, np.ndarray], np.ndarray],
    cameras: Cameras,
    is_plain: bool,
) -> tuple[Masks, list[str]]:
    """Read the masks of a scene's photos; return them and notes. If ``is_plain``, transparency leaves nothing out.

    The masks that the camera file lists are used, or if it lists none, masks beside the scene. ``stored`` and ``cut``
    are fields of :class:`MaskFiles`. SceneError if masks are photos, or outside the folder of the cameras that name
    them.
    """
    paths = photos.paths
    views = [view for view in range(len(camera_file)) if not paths or paths[view] is not None]  # with a photo
    names = [path.as_posix() for path in paths if path is not None] or list(camera_file.names)
    # the mask of each view that the camera file names
    of_cameras = list[Path | None]()
    notes = list[str]()
    if "masks" not in files.named:
        path = Path(camera_file.path)
        listed = [camera_file.masks.get(image, "") for image in camera_file.names]
        of_cameras = [find_image(path.parent, name, path, option="--masks") if name else None for name in listed]
        missing = [name for name, mask in zip(listed, of_cameras, strict=True) if name and mask is None]
        if missing:
            problem = f"{len(missing)} of {len(listed)} masks that {path.name} names are not in its folder"
            remedy = f"correct these paths, or name the masks' folder with --masks: {list_some(missing)}"
            notes.append(Doubt(f"{problem}; {remedy}"))
    photo_masks = photo_protecting = list[Path | None]([None] * len(views))  # in the order of `names`
    if by_cameras := any(of_cameras):
        photo_masks = [of_cameras[view] for view in views]
    elif files.masks is not None:
        photo_masks, unused = match_masks(files.masks, names, named="masks" in files.named)
        notes += unused
    if files.protect is not None:
        photo_protecting, unused = match_masks(files.protect, names, "--protect")
        notes += unused

    def list_by_view(pictures: Sequence[Path | None]) -> list[Path | None]:
        """List the pictures, one for each photo that exists, by view; None for a view without a photo."""
        of_views = dict(zip(views, pictures, strict=True))
        return [of_views.get(view) for view in range(len(camera_file))]

    masks = list_by_view(photo_masks)
    protecting = list_by_view(photo_protecting)
    turns = photos.turns or (0,) * len(masks)
    parts = photos.parts or (WHOLE,) * len(masks)
    stored_counts = None if paths or is_plain else camera_file.counts
    mask_files = MaskFiles(
        tuple(paths), turns=turns, masks=masks, protecting=protecting, parts=parts, is_canvas=photos.canvas is not None,
        stored=stored, cut=cut, cameras=cameras, stored_counts=stored_counts, is_plain=is_plain,
    )  # fmt: skip
    counts, importance = zip(*parallel_map(mask_files.read, range(len(masks))), strict=True)
    error, place = (CameraMaskError, camera_file.path) if by_cameras else (SceneError, files.masks or "")
    _refuse_photos(error, place, "masks", masks, photos.pictures)
    _refuse_photos(SceneError, files.protect or "", "protect", protecting, photos.pictures)
    shape = cameras.height, cameras.width
    num_files = sum(mask is not None for mask in masks)
    result = Masks(_stack_views(counts, True, shape), _stack_views(importance, np.float32(1), shape), num_files)
    if files.protect is not None:
        notes.append(_describe_protected(result.importance, protecting))
    return result, notes


def _refuse_photos(
    error: type[SceneError], place: StrPath, option: str, masks: Sequence[Path | None], photos: PhotoArrays
) -> None:
    """Raise an ``error`` about ``place`` if some mask is a photo for certain, or if most masks may be photos.

    ``place`` is the folder of the masks, or the file that names them. ``option`` is the name of the option for these
    masks.
    """
    of_views = {view: mask for view, mask in enumerate(masks) if mask is not None}
    doubts = parallel_map(lambda view: _doubt_mask(of_views[view], photos, view), of_views)
    if 2 * sum(doubts) > len(of_views):  # one mask that is certainly a photo is enough
        doubtful = [of_views[view].name for view, doubt in zip(of_views, doubts, strict=True) if doubt]
        expected = f"expected black, white and grey pictures for --{option}, found {len(doubtful)} of {len(of_views)}"
        problem = f"{expected} that look like photos, {list_some(doubtful)}"
        raise error(place, problem, f"name another folder with --{option}, or pass --{option} {NONE}")


def _doubt_mask(mask: Path, photos: PhotoArrays, view: int) -> float:
    """Return infinity if a mask is a photo for certain, 1 if it may be a photo, and 0 otherwise.

    A photo with a transparent background is a mask, see :func:`_read_cutout`. Another picture of several colours is a
    photo for certain. A grey picture may be a photo if it changes from pixel to pixel as the photo of its view does. If
    most pixels of a picture have one of two levels, it is a mask with soft edges and no photo.
    """
    picture = np.rint(decode_small(mask, OFFSET_PIXELS) * _WHITE)
    spread = np.ptp(picture, axis=-1)
    if spread.mean() > 1 and decode_alpha(mask) is not None:
        return 0
    if spread.mean() > 1:
        colors = picture[spread >= spread.max() / 2]
        return np.inf if np.median(np.abs(colors - np.median(colors, 0)).max(1)) > 1 else 0
    grey = picture[..., 0]
    middle = (picture.min() + picture.max()) / 2
    black = np.median(grey[grey <= middle])
    white = np.median(grey[grey >= middle])
    if np.median(np.abs(grey - np.where(grey > middle, white, black))) <= 1:
        return 0
    photo = photos[view]
    small = cv2.resize(
        photo, limit_size((photo.shape[1], photo.shape[0]), 2 * OFFSET_PIXELS), interpolation=cv2.INTER_AREA
    )
    jpeg_texture = 0.2  # largest share of the pixels of a smooth mask that JPEG makes uneven
    return _texture(grey) > max(_texture(small.mean(-1)) / 2, jpeg_texture)


def _read_cutout(mask: Path) -> np.ndarray | None:
    """Return where a mask is opaque ``[h,w]`` if it is a photo with a transparent background; otherwise None."""
    opaque = decode_alpha(mask)
    return None if opaque is None or is_grey(mask) else opaque


def _texture(grey: np.ndarray) -> float:
    """Return the share of pixels that differ by more than a level of 255 from the mean of their two neighbours.

    The neighbours of a pixel are the pixels to its left and right.
    """
    bends = np.diff(grey, 2, prepend=grey[:, :1], append=grey[:, -1:])
    return float((np.abs(bends) > 2).mean())


def _stack_views(
    values: Sequence[np.ndarray | None], default: bool | np.float32, shape: tuple[int, int]
) -> np.ndarray | None:
    """Stack the values ``[h,w]`` of views to ``[v,h,w]``, with ``default`` in place of None.

    None if all values are the default.
    """
    if all(view_values is None or (view_values == default).all() for view_values in values):
        return None
    return np.stack([np.full(shape, default) if view_values is None else view_values for view_values in values])


def _describe_protected(importance: np.ndarray | None, masks: Sequence[Path | None]) -> str:
    """Describe what share of the pixels is protected, and how many photos have a picture that protects pixels."""
    count = sum(mask is not None for mask in masks)
    max_weight = 1.0 if importance is None else float(importance.max())
    photos = f"{count} photo{'' if count == 1 else 's'} of {len(masks)}"
    if importance is None or max_weight <= 1:
        return f"protect: the pictures of {photos} have no white pixel, so no pixel gets a higher weight"
    share = 100 * float((importance >= (1 + max_weight) / 2).mean())
    weight = f"a weight of {max_weight:.2g}"
    return f"protect: {share:.1f} % of the photos' pixels have {weight}, by the pictures of {photos}"


def check_masks(masks: Masks, files: SceneFiles, scene: Scene) -> tuple[Masks, str, list[str]]:
    """Return the masks that are used, a reason, and notes on the share of the photos that masks leave out.

    Masks that leave out nearly everything, or most of what the Gaussians show, are not used, unless the user named
    them: a photo's alpha may be a confidence or a depth, and masks may be inverted. Named masks that leave out nearly
    everything raise a SceneError.
    """
    counts = masks.counts
    if counts is None:
        return masks, "leave nothing out", []
    share = float(1 - counts.mean())  # share of the pixels that masks leave out
    max_share = 0.98  # masks that leave out more are not used
    is_named = "masks" in files.named and files.masks is not None
    where = files.masks or "transparency, or masks that the cameras' file names"
    reason = f"leave out {100 * share:.0f} % of the photos' pixels"
    if share >= max_share:
        problem = f"expected masks that are bright where photos count, found {100 * share:.0f} % of their pixels dark"
        if is_named:
            raise SceneError(where, problem, "invert them, or name another folder with --masks")
        return NO_MASKS, reason, [Doubt(f"masks are not used: {where}: {problem}; name them with --masks")]
    if 2 * _share_of_gaussians(scene, counts) < 1:
        reason += ", and most of what the Gaussians show"
        invert = "if they are bright where photos do not count, invert them"
        if is_named:
            return masks, reason, [f"masks {where}: they {reason}; {invert}"]
        remedy = f"{invert}; if they are right, name them with --masks, transparency saved as grey pictures"
        remedy += f"; or pass --masks {NONE}"
        return NO_MASKS, reason, [Doubt(f"masks are not used: {where}: they {reason}; {remedy}")]
    count = int((~counts.all((1, 2))).sum())
    kind = "transparency, masks or crops" if files.masks is None else "masks"
    return masks, reason, [f"{kind} {reason}, in {count} of {len(counts)} photos"]


def _share_of_gaussians(scene: Scene, counts: np.ndarray) -> float:
    """Return the share of what the Gaussians show in the views that lies at pixels that count, ``counts [v,h,w]``.

    These are the pixels with Gaussians of their own, or the centres of Gaussians that views share.
    """
    if scene.pixels is not None:
        shown = scene.pixels.shown
        return float((counts & shown).sum() / max(1, int(shown.sum())))
    sample = 1 << 14  # Gaussians whose centres are looked up
    means = scene.gaussians.means[:: 1 + len(scene.gaussians) // sample]
    pixels, depths = project(means, scene.cameras)
    views, rows = np.nonzero(is_inside(pixels, scene.cameras) & (depths > 0))
    columns, lines = pixels[views, rows].astype(int).T
    return float(counts[views, lines, columns].mean()) if len(views) else 1.0
