"""Errors of levels of detail, leaf by leaf: what pictures lose where a leaf is shown at a coarser level.

PlayCanvas 2.22 begins with the coarsest level of every leaf and buys, while its budget lasts, the step that takes away
the most coverage times error for each Gaussian; coverage is the square of a leaf's radius over radius plus distance. So
the errors that serve it best are squared differences of pictures, in which other leaves hide what they hide, for each
unit of coverage. As shares of the pictures' energy they have the scale of splat-transform's, which draws leaves alone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from gsmerge.facts.views import pick_views
from gsmerge.geometry import camera_centres
from gsmerge.io.formats.streamed import Leaf
from gsmerge.kernels.raster.project import TILE
from gsmerge.measure.fog import outside_cameras
from gsmerge.measure.sizes import shrink_cameras
from gsmerge.raster import Splats, TiledView, prepare, tile_view
from gsmerge.raster.composite import blend, view_colors
from gsmerge.runtime.record import Progress
from gsmerge.runtime.threads import parallel_map, use_threads
from gsmerge.types import Cameras, Gaussians

VIEWS = 8  # of the scene, evenly spread; they and the pictures from outside weigh the same together
SIDE = 240  # pixels, at most, of the longer side of the pictures
USUAL_SLOPE = math.tan(math.radians(22.5))  # of half the field of view at which coverage is that of the distance alone


@dataclass(frozen=True, eq=False)
class LevelErrors:
    """Measure errors of leaves by pictures of some views, and from outside of them."""

    splats: Splats  # Gaussians of all levels, and those that are always shown
    levels: np.ndarray  # [n] level of each; -1 where it is always shown
    pictures: tuple[tuple[float, Cameras], ...]  # weight and camera of each
    near: float  # near plane, world units
    progress: Progress

    def __call__(self, leaves: Sequence[Leaf]) -> np.ndarray:
        """Return errors ``[leaves, levels]`` that never fall from one level to the next coarser one.

        They are 0 where no level is coarser.
        """
        num_levels = len(leaves[0].rows)
        starts = np.searchsorted(self.levels, range(num_levels))
        leaf_of = np.zeros(len(self.levels), np.int64)
        for number, leaf in enumerate(leaves):
            for start, rows in zip(starts, leaf.rows, strict=True):
                leaf_of[start + rows] = number
        drawn: list[int] = []

        def draw(picture: tuple[float, Cameras]) -> tuple[float, np.ndarray]:
            self.progress("levels: what each place loses", len(drawn), len(self.pictures))
            measured = self._lost(picture[1], leaf_of, leaves)
            drawn.append(1)
            return measured

        with use_threads():
            measured = parallel_map(draw, self.pictures)
        lost, covered, scale = np.zeros((len(leaves), num_levels)), np.zeros(len(leaves)), 0.0
        for (weight, camera), (energy, by_leaf) in zip(self.pictures, measured, strict=True):
            total = max(float(by_leaf.max(1).sum()), 1e-12)  # so that each picture has its say
            lost += weight / total * by_leaf
            covered += weight * coverage(leaves, camera)
            scale += weight * total / max(energy, 1e-12)
        return np.maximum.accumulate(scale * lost / np.maximum(covered, 1e-12)[:, None], axis=1)

    def _lost(self, camera: Cameras, leaf_of: np.ndarray, leaves: Sequence[Leaf]) -> tuple[float, np.ndarray]:
        """Return the energy per pixel of a picture, and the energy ``[leaves, levels]`` that it loses."""
        present = [[level for level, rows in enumerate(leaf.rows) if len(rows)] for leaf in leaves]
        always = self.levels < 0
        drawn = always | (self.levels == np.array([levels[0] for levels in present])[leaf_of])
        whole = self._draw(self._tile(camera, drawn))
        lost = np.zeros((len(leaves), len(leaves[0].rows)))
        for number, (_, *coarser) in enumerate(present):
            inside = (leaf_of == number) & ~always
            tiles = shown_tiles(self._tile(camera, inside))
            pixels = tiles.repeat(TILE, 0).repeat(TILE, 1)[: camera.height, : camera.width]
            for level in coarser if tiles.any() else ():
                picture = self._draw(self._tile(camera, np.where(inside, self.levels == level, drawn), tiles))
                lost[number, level] = np.square(picture[pixels] - whole[pixels], dtype=np.float64).sum()
        num_pixels = camera.width * camera.height
        return float(np.square(whole, dtype=np.float64).sum()) / num_pixels, lost / num_pixels

    def _tile(self, camera: Cameras, keep: np.ndarray, tiles: np.ndarray | None = None) -> TiledView:
        viewmat, K = camera.viewmats[0], camera.Ks[0]
        return tile_view(self.splats, viewmat, K, camera.width, camera.height, near=self.near, keep=keep, tiles=tiles)

    @staticmethod
    def _draw(tiled: TiledView) -> np.ndarray:
        """Draw colours and opacity ``[h,w,4]``, since the background of a viewer is unknown."""
        image, transmittance = blend(tiled, view_colors(tiled), np.zeros(3, np.float32))
        return np.concatenate([image, 1 - transmittance[..., None]], 2)


def level_errors(
    levels: Sequence[Gaussians],
    cameras: Cameras,
    near: float,
    environment: Gaussians | None = None,
    progress: Progress = lambda *_: None,
) -> LevelErrors | None:
    """Prepare to measure the errors of levels, the finest first; None without a choice or cameras.

    ``near`` is the near plane of the pictures, world units; the ``environment`` is shown with every level.
    """
    if len(levels) < 2 or len(cameras) == 0:
        return None
    small, shown = shrink_cameras(cameras, SIDE), [*levels] if environment is None else [environment, *levels]
    views = [small[[view]] for view in pick_views(len(small), VIEWS)]
    outside = [camera for _, camera in outside_cameras(levels[0], small)]
    pictures = [(0.5 / len(group), camera) for group in (views, outside) for camera in group]
    degree = max(part.shN.shape[1] for part in shown)
    padded = [replace(part, shN=np.pad(part.shN, ((0, 0), (0, degree - part.shN.shape[1]), (0, 0)))) for part in shown]
    numbers = np.repeat(np.arange(len(shown)) - (environment is not None), [len(part) for part in shown])
    return LevelErrors(prepare(Gaussians.concat(padded)), numbers, tuple(pictures), near, progress)


def shown_tiles(tiled: TiledView) -> np.ndarray:
    """Return a mask ``[tile_height, tile_width]`` of the tiles in which a view shows something."""
    return (np.diff(tiled.isect_offsets) > 0).reshape(-(-tiled.height // TILE), -1)


def coverage(leaves: Sequence[Leaf], camera: Cameras) -> np.ndarray:
    """Return the share ``[leaves]`` of a picture that each leaf covers, at most 1, in any viewing direction."""
    bounds = [leaf.node["bound"] for leaf in leaves]
    low, high = (np.array([bound[end] for bound in bounds], np.float64) for end in ("min", "max"))
    centre = camera_centres(camera.viewmats[0].astype(np.float64))
    radius = np.sqrt(np.square(high - low).sum(1)) / 2
    distance = np.sqrt(np.square(np.clip(centre, low, high) - centre).sum(1))
    slope = min(camera.width / camera.Ks[0, 0, 0], camera.height / camera.Ks[0, 1, 1]) / 2
    return np.square(radius / np.maximum(radius + distance * slope / USUAL_SLOPE, 1e-12))
