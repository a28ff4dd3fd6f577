"""Scene without photos -> the scene with the colours of its rows as photos, if each Gaussian belongs to one view.

Feed-forward models take the colour of a pixel's Gaussian from the photo. The Gaussians' colours are compared with a
drawing of the view's own Gaussians from its own camera, after both are blurred. A pixel shows an opaque drawing instead
of its Gaussians' colour if both differ, or if its Gaussians are so faint that their colours mean little. Pixels with
neither a colour nor an opaque drawing do not count.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numpy as np

from gsmerge.frozen import dataclass
from gsmerge.method.facts.pictures import ROW_COLORS
from gsmerge.method.geometry.gaps import fill_gaps
from gsmerge.method.geometry.transforms import camera_depths, sh0_to_rgb
from gsmerge.method.geometry.views import camera_kinds, subset
from gsmerge.method.kernels.pictures import blur
from gsmerge.method.raster import make_splats, tile_view
from gsmerge.method.raster.composite import blend, view_colors
from gsmerge.method.raster.photos import COVERED_TRANSMITTANCE, WHOLE_SHARE, blank_photos
from gsmerge.runtime.record import note
from gsmerge.runtime.threads import in_turn
from gsmerge.types import PicturedScene, Scene

NO_PHOTOS = f"no photos: {ROW_COLORS} are used instead; name photos with --images"
FAINT_OPACITY = 0.1  # opacity of a pixel's Gaussians below which their colours mean little
# Standard deviation in pixels. After this blur, colours from photos differ from drawings by at most .18 of [0, 1] in
# the exports of nine captures. After a blur of only 2 pixels, they differ by .39 where Gaussians of wrong depth hide
# others
ROW_BLUR_PIXELS = 8.0
T = TypeVar("T")


def add_row_colors(scene: Scene, *, has_photos: bool = False) -> tuple[PicturedScene, str]:
    """Use the colours of each view's own Gaussians as the photos of a canonical scene.

    With ``has_photos``, the scene has photos that do not count, and the sentence that is also returned says what is
    used in their place. Without photos, a note says it.
    """
    shape = len(scene), scene.cameras.height, scene.cameras.width
    images, masks = np.zeros((*shape, 3), np.float32), np.full(shape, False)

    def store(views: np.ndarray, picture: RowPicture) -> int:
        """Store the picture of a camera for its views; return at how many pixels of the views it is a drawing."""
        images[views], masks[views] = picture.picture, picture.known
        return len(views) * int(picture.by_drawing.sum())

    num_drawn = sum(picture_rows(scene, store))
    share = num_drawn / masks.size
    detail = f"; drawings of the Gaussians on {100 * share:.0f} % of the pixels" if share > 1 - WHOLE_SHARE else ""
    change = f"photos do not count: {ROW_COLORS} are used instead{detail}" if has_photos else ""
    if not has_photos:
        note(NO_PHOTOS + detail)
    return PicturedScene.with_pictures(scene, images, None if masks.all() else masks), change


@dataclass(frozen=True, eq=False)
class RowPicture:
    """Colours of the pixels of a camera, from the Gaussians of these pixels."""

    picture: np.ndarray  # [h,w,3] colours of the Gaussians, or those of the drawing at the pixels `by_drawing`
    known: np.ndarray  # [h,w] bool, pixels with a colour or a drawing
    by_drawing: np.ndarray  # [h,w] bool, pixels at which the drawing is used
    drawing: np.ndarray  # [h,w,3] the Gaussians drawn over black


def picture_rows(scene: Scene, use: Callable[[np.ndarray, RowPicture], T], mask: np.ndarray | None = None) -> list[T]:
    """Draw the picture of every camera, and return the results of ``use(views, picture)``.

    ``views`` are the views of the camera. A camera has several views if its pixels have several layers of Gaussians.
    With ``mask [v]``, only cameras with a view in the mask are drawn.
    """
    kinds = camera_kinds(scene.cameras)
    groups = [np.flatnonzero(kinds == kind) for kind in range(kinds.max() + 1)]
    groups = [views for views in groups if mask is None or mask[views].any()]
    return list(in_turn(lambda views: use(views, _picture_camera(scene, views)), groups))


def _picture_camera(scene: Scene, views: np.ndarray) -> RowPicture:
    """Draw the Gaussians of all ``views`` of one camera, and choose their colours or the drawing for each pixel."""
    layers = subset(scene, views.tolist())
    if len(layers.gaussians) == 0:
        no_pixel = np.zeros((scene.cameras.height, scene.cameras.width), bool)
        black = np.zeros((*no_pixel.shape, 3), np.float32)
        return RowPicture(black, no_pixel, no_pixel, black)
    tiled = tile_view(make_splats(layers.gaussians), **blank_photos(layers.cameras).camera(0))
    tiled_colors = view_colors(tiled)
    drawing, transmittance = blend(tiled, tiled_colors, np.zeros(3, np.float32))
    colors = sh0_to_rgb(layers.gaussians.sh0[:, 0])
    colors[tiled.ids] = tiled_colors
    row_picture, opacity = _blend_layers(layers, colors.clip(0, 1))
    drawn_opacity = 1 - transmittance
    drawn_colors = (drawing / np.maximum(drawn_opacity, np.float32(1e-3))[..., None]).clip(0, 1)
    weights = np.minimum(opacity, drawn_opacity)  # pixels that are faint in one of the two pictures count less
    differences = (row_picture - drawn_colors) * weights[..., None]
    red, green, blue = np.moveaxis(np.abs(blur(differences, ROW_BLUR_PIXELS)), -1, 0)
    disagreement = 0.2  # largest mean difference over the channels (sRGB) at which blurred colours agree
    agree = (red + green + blue) / (3 * np.maximum(blur(weights, ROW_BLUR_PIXELS), np.float32(1e-6))) < disagreement
    is_solid = transmittance < COVERED_TRANSMITTANCE
    by_row = (opacity > 0) & ~(is_solid & ((opacity < FAINT_OPACITY) | ~agree))  # pixels with the Gaussians' colours
    known = by_row | is_solid
    picture = fill_gaps(np.where(by_row[..., None], row_picture, drawn_colors), known)
    return RowPicture(picture, known, by_drawing=known & ~by_row, drawing=drawing.clip(0, 1))


def _blend_layers(layers: Scene, colors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Blend the layers of one camera, the nearest first; return colours ``[h,w,3]`` and opacities ``[h,w]``."""
    rows = layers.get_pixels().fronts
    opacities = np.where(rows >= 0, layers.gaussians.opacities[rows], 0).astype(np.float32)
    layer_colors = colors[rows].astype(np.float32)
    if len(layers) == 1:
        return layer_colors[0], opacities[0]
    means = layers.gaussians.means[rows].astype(np.float64)
    shape = rows.shape
    order = np.argsort(camera_depths(means, layers.cameras.viewmats[0]), axis=0, kind="stable")
    transmittance = np.ones(shape[1:], np.float32)
    total = np.zeros((*shape[1:], 3), np.float32)
    for layer in order:
        weight = transmittance * np.take_along_axis(opacities, layer[None], 0)[0]
        total += weight[..., None] * np.take_along_axis(layer_colors, layer[None, ..., None], 0)[0]
        transmittance -= weight
    opacity = 1 - transmittance
    return total / np.maximum(opacity, np.float32(1e-6))[..., None], opacity
