"""A batch of views beside a state: photos of one size, what of it is new, fit of colours, photos kept for later."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np

from gsmerge.facts.prepare import Prepared
from gsmerge.facts.views import in_float64, resize_cameras
from gsmerge.fit import FitReport
from gsmerge.fit.color import draw, fit_colors
from gsmerge.geometry import normalize
from gsmerge.kernels.matrices import matmul
from gsmerge.networks.corrector import Corrector
from gsmerge.plan import Plan
from gsmerge.pooling import Members, feature_to_gaussians
from gsmerge.raster.photos import Photos, photo_errors, photos_of
from gsmerge.raster.weights import apply_transposed
from gsmerge.runtime.threads import parallel_map
from gsmerge.settings.extend import ExtendOptions
from gsmerge.settings.fit import FitOptions
from gsmerge.stages.decode import group_saliency
from gsmerge.stages.superpixels import scene_saliency
from gsmerge.states.groups import replace_groups, select_groups
from gsmerge.states.state import Colors, DividedGroups, GroupSet, Replay, State, StateNetworks
from gsmerge.types import Cameras, FeatureGaussians, Gaussians, PicturedScene, Segmentation

REACH = 3.34  # standard deviations to where an opaque Gaussian adds 1/255
MARGIN = 2.0  # pixels that the rasterizer's low-pass adds to that


@dataclass(frozen=True, eq=False)
class BatchPhotos:
    """Photos ``images [v,h,w,3]`` float32, sRGB in [0, 1], and cameras of the same size, of one batch."""

    images: np.ndarray
    cameras: Cameras

    def __len__(self) -> int:
        return len(self.images)

    def photos(self, level: int = 1) -> Photos:
        """Return the photos for rendering, with sides divided by ``level``."""
        return photos_of(self.images, self.cameras, level)


def resize_photos(images: np.ndarray, cameras: Cameras, width: int, height: int) -> BatchPhotos:
    """Resize photos by area averaging, and their cameras to match."""
    size = width, height
    if size == (cameras.width, cameras.height):
        return BatchPhotos(images, cameras)
    small = parallel_map(lambda image: cv2.resize(image, size, interpolation=cv2.INTER_AREA), images)
    return BatchPhotos(np.stack(small), resize_cameras(in_float64(cameras), width, height))


@dataclass(frozen=True, eq=False)
class Batch:
    """A batch of views, prepared to enter a state."""

    prepared: Prepared
    plan: Plan
    extend_options: ExtendOptions
    photos: BatchPhotos  # At the size of the state's views; the colours of the Gaussians where there are no photos
    view_ids: np.ndarray  # [v] int64, which of all views each is
    is_new: np.ndarray  # [v] bool, which views the state does not have yet

    @property
    def scene(self) -> PicturedScene:
        """The canonical scene of the batch."""
        return self.prepared.scene

    @property
    def num_new(self) -> int:
        """Number of input Gaussians in new views, since a state counts the input of a view once."""
        return round(self.prepared.input_scene.num_gaussians * float(self.is_new.mean()))

    @property
    def min_contribution(self) -> float:
        """Least blending weight of a group, as the options ask, also in drafts."""
        return float(self.plan.settings["min_contribution"])


def make_batch(state: State | None, prepared: Prepared, plan: Plan, extend_options: ExtendOptions) -> Batch:
    """Make a batch: resize its photos to those of the state, and find the views that are new."""
    cameras = prepared.scene.cameras
    before = cameras[:0] if state is None else state.cameras
    photos = resize_photos(prepared.scene.images, cameras, before.width, before.height)
    ids = view_ids(before, photos.cameras)
    return Batch(prepared, plan, extend_options, photos, ids, ids >= len(before))


@dataclass(frozen=True, eq=False)
class BatchFeatures:
    """Feature Gaussians of a batch, with members and networks."""

    features: FeatureGaussians
    members: Members  # The batch's Gaussians, which `features.members` are rows of
    segmentation: Segmentation  # The superpixels, and the number of Gaussians to make
    context: Corrector  # What corrects their Gaussians
    networks: StateNetworks | None = None  # What the state keeps of them: None where groups are decoded as they enter


@dataclass(frozen=True)
class StateKind:
    """The functions and constants that differ between states of decoded groups and of latents."""

    reach: float  # Standard deviations of a group, to where a view touches it
    encode: Callable[[State | None, Batch, int | None], BatchFeatures]  # Make about so many Gaussians
    decode: Callable[[GroupSet, BatchFeatures], tuple[Gaussians, Gaussians]]  # One of each group, and of each feature
    divide: Callable[[BatchFeatures, Batch, int], DividedGroups]  # Make the groups of a first batch, up to `max_k` each
    # Merge a batch with the groups at some rows, those in reach, up to `max_k` each; return all groups, and counts by
    # key of the report
    join: Callable[[GroupSet, np.ndarray, BatchFeatures, Batch, int], tuple[GroupSet, dict[str, int]]]


def batch_saliency(features: FeatureGaussians, members: Members, batch: Batch) -> np.ndarray:
    """Return the mean corner response ``[g]`` of the pixels of a batch's Feature Gaussians."""
    return group_saliency(features, members, scene_saliency(batch.scene.images))


def view_ids(known_cameras: Cameras, cameras: Cameras) -> np.ndarray:
    """Return the index ``[v]`` of each view: that of a known view with the same camera, or a new index."""
    known_ids = {row: i for i, row in reversed(list(enumerate(_rows(known_cameras))))}
    ids = np.array([known_ids.get(row, -1) for row in _rows(cameras)], np.int64)
    ids[ids < 0] = len(known_cameras) + np.arange(np.count_nonzero(ids < 0))
    return ids


def _rows(cameras: Cameras) -> list[bytes]:
    """Return every camera as bytes."""
    both = zip(cameras.viewmats.astype(np.float64), cameras.Ks.astype(np.float64), strict=True)
    return [viewmat.tobytes() + K.tobytes() for viewmat, K in both]


def update_replay(
    replay: Replay, batch_photos: BatchPhotos, view_ids: np.ndarray, num_views: int, max_photos: int
) -> Replay:
    """Add photos of the views ``view_ids [s]`` to the stored ones, then keep every n-th of all views.

    n is a power of two.
    """
    ids, rows = np.unique(view_ids, return_index=True)
    new = ~np.isin(ids, replay.views)
    views, step = np.concatenate([replay.views, ids[new]]), 1
    while max_photos and -(-num_views // step) > max_photos:  # of all views, so that the batches' sizes do not matter
        step *= 2
    stays = (views % step == 0) & (max_photos > 0)
    if max_photos and not stays.any():  # earlier views came without photos
        stays[np.argmax(views)] = True
    old_stays, new_stays = stays[: len(replay)], stays[len(replay) :]
    images = np.rint(batch_photos.images[rows[new][new_stays]] * 255).astype(np.uint8)
    order = np.argsort(views[stays])
    return Replay(np.concatenate([replay.images[old_stays], images])[order], views[stays][order])


def fit_batch_colors(
    groups: GroupSet, batch_photos: BatchPhotos, options: FitOptions, seed: int = 0
) -> tuple[GroupSet, FitReport]:
    """Fit base colours to new photos; earlier photos enter as a prior.

    The normal equations of earlier photos are stored as their diagonal (``Colors.precision``) about the colours
    that solve them. The new photos' equations get ``precision |colour - fitted colour|^2`` added, so earlier
    photos are not needed again.
    """
    rows = rows_in_view(groups.features, batch_photos.cameras)
    in_view, photos = select_groups(groups, rows), batch_photos.photos(2)
    before = replace(feature_to_gaussians(in_view.features), sh0=in_view.colors.sh0)
    drawn = draw(before, photos)
    after, report = fit_colors(before, drawn, photos, options, seed, in_view.colors.precision)
    all_pixels = np.ones((photos.height, photos.width, 1), np.float32)
    precision = in_view.colors.precision.astype(np.float64)
    for view in drawn.views:
        precision[view.ids] += apply_transposed(replace(view, weights=view.weights**2), all_pixels)[:, 0]
    refitted = replace(in_view, colors=Colors(after.sh0, precision.astype(np.float32)))
    return replace_groups(groups, rows, refitted), report


def groups_in_view(features: FeatureGaussians, cameras: Cameras, reach: float = REACH) -> np.ndarray:
    """Return a mask ``[v,g]`` of groups that may be visible in each view, by position and size.

    ``reach``: distance at which a group is visible, in standard deviations of all its axes together. This is the only
    step that goes through all groups; the time of later steps depends only on what the views see.
    """
    means = features.means.astype(np.float64)
    radii = reach * np.sqrt(np.trace(features.covars, axis1=1, axis2=2, dtype=np.float64))
    viewmats, Ks = cameras.viewmats.astype(np.float64), cameras.Ks.astype(np.float64)

    def one_view(view: int) -> np.ndarray:
        viewmat, K = viewmats[view], Ks[view]
        points = matmul(means, viewmat[:3, :3].T) + viewmat[:3, 3]
        inside: np.ndarray = points[:, 2] > -radii
        for axis, size in ((0, cameras.width), (1, cameras.height)):
            for edge, sign in ((-MARGIN, 1), (size + MARGIN, -1)):
                normal = np.zeros(3)  # of the plane through the camera and an edge of the image, inward
                normal[axis], normal[2] = sign * K[axis, axis], sign * (K[axis, 2] - edge)
                inside &= matmul(points, normalize(normal)) > -radii
        return inside

    return np.stack(parallel_map(one_view, range(len(cameras))))


def rows_in_view(features: FeatureGaussians, cameras: Cameras, reach: float = REACH) -> np.ndarray:
    """Return the rising rows of groups that may be visible in some view; see :func:`groups_in_view`."""
    return np.flatnonzero(groups_in_view(features, cameras, reach).any(0))


def pixel_errors(gaussians: Gaussians, photos: Photos, height: int, width: int) -> np.ndarray:
    """Return squared colour errors ``[v,h,w]`` plus squared transmittance, so that holes count in black photos too."""

    def score(view: int, image: np.ndarray, transmittance: np.ndarray) -> np.ndarray:
        errors = ((np.clip(image, 0, 1) - photos.images[view]) ** 2).mean(-1) + transmittance**2
        return cv2.resize(errors.astype(np.float32), (width, height), interpolation=cv2.INTER_NEAREST)

    return np.stack(photo_errors(gaussians, photos, score))


def group_errors(features: FeatureGaussians, members: Members, errors: np.ndarray) -> np.ndarray:
    """Average pixel errors ``[v,h,w]`` over each group's members, ``[g]``; a member without a pixel counts as 1."""
    starts, rows = features.starts, features.members
    pixels = members.pixels_of(rows)
    each = np.where(pixels >= 0, errors.reshape(-1)[pixels], 1.0)
    return np.add.reduceat(each, starts[:-1]) / np.diff(starts)


def novel_rows(new: BatchFeatures, batch: Batch, state_gaussians: Gaussians, batch_gaussians: Gaussians) -> np.ndarray:
    """Return the rows of a batch's Feature Gaussians that explain the photos clearly better than the state does."""
    photos, cameras, options = batch.photos.photos(2), batch.scene.cameras, batch.extend_options
    state_errors, batch_errors = (
        group_errors(new.features, new.members, pixel_errors(gaussians, photos, cameras.height, cameras.width))
        for gaussians in (state_gaussians, batch_gaussians)
    )
    return np.flatnonzero(state_errors > np.maximum(options.tolerance**2, options.margin**2 * batch_errors))
