"""The core types: frozen dataclasses of arrays, which can be indexed, concatenated and moved to a device.

Arrays are NumPy's. Gaussians and cameras may hold torch tensors of one device instead, for :func:`gsmerge.render`,
networks and training. This module imports torch only when tensors are requested.

Arrays in memory follow one convention (docs/reference/conventions.md): linear scales, opacities in [0, 1], unit
quaternions wxyz that rotate local to world, world-to-camera matrices with OpenCV axes, pixel centres at +0.5, and sRGB
in [0, 1].
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from functools import cached_property
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

import numpy as np

from gsmerge.arrays import Array, ArrayFields, as_array, as_index, as_pictures, as_tensor, check_shape, concat_rows
from gsmerge.frozen import dataclass, field, fields, replace
from gsmerge.runtime.arguments import check_fields

if TYPE_CHECKING:
    import torch

SceneT = TypeVar("SceneT", bound="Scene")
StrPath = str | os.PathLike[str]

SH_C0 = 0.28209479177387814  # spherical harmonic of degree 0: rgb = 0.5 + SH_C0 * sh0


@dataclass(frozen=True, eq=False, repr=False)
class Gaussians(ArrayFields):
    """n Gaussians in the world frame.

    Args:
        means: ``[n,3]`` centres, world units.
        quats: ``[n,4]`` unit quaternions wxyz, local to world.
        scales: ``[n,3]`` standard deviations per local axis, world units, linear.
        opacities: ``[n]`` in [0, 1].
        sh0: ``[n,1,3]`` spherical harmonics of degree 0; rgb = 0.5 + 0.2821 sh0.
        shN: ``[n,k-1,3]`` higher spherical harmonics, basis-major; k = (degree + 1)^2.

    Raises:
        ValueError: If the shapes do not fit together.

    Example:
        >>> gaussians = gsmerge.read_ply("demo/scene.ply").gaussians
        >>> gaussians.means.shape, gaussians[gaussians.opacities > 0.9].sh_degree
        ((7680, 3), 0)
    """

    means: Array
    quats: Array
    scales: Array
    opacities: Array
    sh0: Array
    shN: Array

    def __post_init__(self) -> None:
        n = check_shape("means", self.means, ("n", 3))
        check_shape("quats", self.quats, (n, 4))
        check_shape("scales", self.scales, (n, 3))
        check_shape("opacities", self.opacities, (n,))
        check_shape("sh0", self.sh0, (n, 1, 3))
        check_shape("shN", self.shN, (n, "k-1", 3))
        if self.shN.shape[1] not in (0, 3, 8, 15, 24):
            raise ValueError(f"shN: expected 0, 3, 8, 15 or 24 coefficients, got {self.shN.shape[1]}")

    def __len__(self) -> int:
        return self.means.shape[0]

    def __repr__(self) -> str:
        device = "" if self.device is None else f", on {self.device}"
        return f"Gaussians({len(self):,}, SH degree {self.sh_degree}{device})"

    def __getitem__(self, index: Any) -> Gaussians:
        """Return the rows that ``index`` (slice, mask or integer array) selects."""
        index = as_index("gaussians", index)
        columns = [getattr(self, f.name) for f in fields(self)]
        if isinstance(index, np.ndarray) and index.dtype.kind == "i" and self.device is None:
            return Gaussians(*(column.take(index, axis=0) for column in columns))  # a quarter of the time of [index]
        return Gaussians(*(column[index] for column in columns))

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics, 0 to 4."""
        return round((self.shN.shape[1] + 1) ** 0.5) - 1

    @property
    def device(self) -> torch.device | None:
        """Device of the tensors; None for NumPy arrays."""
        return getattr(self.means, "device", None) if hasattr(self.means, "detach") else None

    def to(self, device: torch.device | str) -> Gaussians:
        """Return the same Gaussians as tensors on a device; gradients pass."""
        tensors: list[Any] = [as_tensor(getattr(self, f.name), device) for f in fields(self)]
        return Gaussians(*tensors)

    def numpy(self) -> Gaussians:
        """Return the same Gaussians as NumPy arrays."""
        return Gaussians(*(as_array(getattr(self, f.name)) for f in fields(self)))

    @staticmethod
    def concat(parts: Sequence[Gaussians]) -> Gaussians:
        """Concatenate the rows of all parts, which must have the same SH degree."""
        return Gaussians(*(concat_rows([getattr(p, f.name) for p in parts]) for f in fields(Gaussians)))


class HasGaussians(Protocol):
    """An object with Gaussians, such as the result of :func:`gsmerge.compact`."""

    @property
    def gaussians(self) -> Gaussians:
        """The Gaussians."""


def own_gaussians(value: HasGaussians | Gaussians) -> Gaussians:
    """Return Gaussians unchanged, or the Gaussians of a result."""
    return value if isinstance(value, Gaussians) else value.gaussians


@dataclass(frozen=True, eq=False, repr=False)
class Cameras(ArrayFields):
    """c pinhole cameras of one image size.

    Args:
        viewmats: ``[c,4,4]`` world to camera, OpenCV axes (x right, y down, z forward), float64.
        Ks: ``[c,3,3]`` intrinsics in pixels; the top-left pixel's centre is (0.5, 0.5).
        width: Image width, pixels.
        height: Image height, pixels.
        antialiased: Whether Gaussians are drawn as antialiased viewers draw them, see :func:`gsmerge.render`.

    Raises:
        ValueError: If the shapes do not fit together or the size is not positive.

    Example:
        >>> cameras = gsmerge.read_scene("demo").cameras
        >>> len(cameras), cameras.width, cameras.height
        (5, 48, 32)
        >>> cameras[[0, 2]].viewmats.shape
        (2, 4, 4)
    """

    viewmats: Array
    Ks: Array
    width: int
    height: int
    antialiased: bool = False

    def __post_init__(self) -> None:
        check_fields(self)
        c = check_shape("viewmats", self.viewmats, ("c", 4, 4))
        check_shape("Ks", self.Ks, (c, 3, 3))
        if self.width < 1 or self.height < 1:
            raise ValueError(f"expected a positive image size, got {self.width} x {self.height}")

    def __len__(self) -> int:
        return self.viewmats.shape[0]

    def __repr__(self) -> str:
        return f"Cameras({len(self)} of {self.width} x {self.height})"

    def __getitem__(self, index: Any) -> Cameras:
        """Return the cameras that ``index`` (slice, mask or integer array) selects."""
        index = as_index("cameras", index)
        return replace(self, viewmats=self.viewmats[index], Ks=self.Ks[index])

    def to(self, device: torch.device | str) -> Cameras:
        """Return the same cameras as tensors on a device; gradients pass."""
        tensors: dict[str, Any] = {name: as_tensor(getattr(self, name), device) for name in ("viewmats", "Ks")}
        return replace(self, **tensors)

    def numpy(self) -> Cameras:
        """Return the same cameras as NumPy arrays."""
        return replace(self, viewmats=as_array(self.viewmats), Ks=as_array(self.Ks))

    @property
    def centres(self) -> Array:
        """``[c,3]`` camera centres in the world."""
        return -(self.viewmats[:, :3, :3] * self.viewmats[:, :3, 3:]).sum(1)


NO_CAMERAS = Cameras(np.empty((0, 4, 4)), np.empty((0, 3, 3)), 1, 1)


@dataclass(frozen=True, eq=False, repr=False)
class LargePhotos(ArrayFields):
    """Photos larger than the scene's views, read one at a time; the photos have the poses of the scene's cameras."""

    Ks: np.ndarray  # [v,3,3] intrinsics at the size of the photos
    width: int
    height: int
    ids: tuple[int, ...]  # Number of each view's photo, for `read`
    # Number -> photo [h,w,3], uint8 sRGB; several threads may call it. Each scene that is read gets a new function
    read: Callable[[int], np.ndarray] = field(compare=False)

    def __getitem__(self, views: Sequence[int]) -> LargePhotos:
        """Return the photos of some views."""
        return replace(self, Ks=self.Ks[list(views)], ids=tuple(self.ids[view] for view in views))


@dataclass(frozen=True, eq=False, repr=False)
class Views(ArrayFields):
    """Cameras with their photos.

    Args:
        cameras: v cameras, in the world frame of the Gaussians that they see.
        images: ``[v,h,w,3]`` sRGB in [0, 1].
        names: One name for each view.

    Example:
        >>> scene = gsmerge.read_scene("demo")
        >>> gsmerge.Views(scene.cameras[[1]], scene.images[[1]], scene.names[1:2]).images.shape
        (1, 32, 48, 3)
    """

    cameras: Cameras
    images: Array
    names: tuple[str, ...]

    def __post_init__(self) -> None:
        check_fields(self)
        check_shape("images", self.images, (len(self), self.cameras.height, self.cameras.width, 3))
        _check_count("view names", self.names, len(self))

    def __len__(self) -> int:
        """Return v."""
        return len(self.cameras)

    def __repr__(self) -> str:
        return f"Views({len(self)} of {self.cameras.width} x {self.cameras.height}, images)"

    def __getitem__(self, index: Any) -> Views:
        """Return the views that ``index`` (slice, mask or integer array) selects."""
        ids = np.arange(len(self))[as_index("views", index)].tolist()
        return Views(self.cameras[ids], self.images[ids], tuple(self.names[i] for i in ids))


PROTECTED = np.float32(4)  # importance of a pixel that is white in a picture of --protect
PER_PIXEL = ("images", "masks", "importance", "depths")  # arrays of a scene with a value for each pixel of its views


@dataclass(frozen=True, eq=False, repr=False)
class Pixels(ArrayFields):
    """The pixel that each Gaussian belongs to, and the Gaussian that each pixel shows.

    Pixels are numbered over all views, ``(v·H + y)·W + x``.

    Args:
        homes: ``[n]`` int, the pixel in which each Gaussian is most visible; -1 if no view sees the Gaussian.
        fronts: ``[v,h,w]`` int32, the front Gaussian of each pixel; -1 for none.
        own: Each Gaussian comes from a pixel of one view, with the colours of the view's photo.
    """

    homes: np.ndarray
    fronts: np.ndarray
    own: bool

    @staticmethod
    def of_grid(has_gaussian: np.ndarray) -> Pixels:
        """Return the pixels of Gaussians that are stored one per pixel, in the order of the pixels.

        ``has_gaussian [v,h,w]`` is true where a pixel has one.
        """
        mask = np.asarray(has_gaussian, bool)
        homes = np.arange(mask.size, dtype=np.int32 if mask.size <= np.iinfo(np.int32).max else np.int64)
        if mask.all():
            return Pixels(homes, homes.astype(np.int32, copy=False).reshape(mask.shape), own=True)
        homes = homes[mask.reshape(-1)]
        fronts = np.full(mask.size, -1, np.int32)
        fronts[homes] = np.arange(len(homes), dtype=np.int32)
        return Pixels(homes, fronts.reshape(mask.shape), own=True)

    @property
    def shown(self) -> np.ndarray:
        """Mask ``[v,h,w]`` of the pixels that have a front Gaussian."""
        return np.asarray(self.fronts >= 0)

    @cached_property
    def rows_of_views(self) -> list[np.ndarray]:
        """For each view, the ascending rows ``[m]`` of its Gaussians."""
        views = self.homes // max(1, int(np.prod(self.fronts.shape[1:])))
        rows = np.arange(len(views))
        if (views[1:] < views[:-1]).any():
            rows = np.argsort(views, kind="stable")
            views = views[rows]
        starts = np.searchsorted(views, np.arange(len(self.fronts) + 1))
        return [rows[start:end] for start, end in pairwise(starts.tolist())]

    def select(self, views: Sequence[int]) -> tuple[np.ndarray, Pixels]:
        """Return the rows ``[m]`` of the Gaussians of some views, view by view, and the pixels of these Gaussians.

        The pixels are numbered over the selected views.
        """
        view_pixels = int(np.prod(self.fronts.shape[1:]))
        view_rows = [self.rows_of_views[view] for view in views]
        homes = [self.homes[:0]]
        fronts = list[np.ndarray]()
        num_selected = 0
        for new_view, (view, rows) in enumerate(zip(views, view_rows, strict=True)):
            homes.append(self.homes[rows] + self.homes.dtype.type((new_view - view) * view_pixels))
            view_fronts = self.fronts[view]
            positions = np.searchsorted(rows, self.fronts[view])
            fronts.append(np.where(view_fronts >= 0, num_selected + positions, -1).astype(np.int32))
            num_selected += len(rows)
        shape = len(view_rows), *self.fronts.shape[1:]
        rows = np.concatenate([np.zeros(0, np.int64), *view_rows])
        return rows, Pixels(np.concatenate(homes), np.array(fronts, np.int32).reshape(shape), own=self.own)


@dataclass(frozen=True, eq=False, repr=False)
class Region(ArrayFields):
    """A box, which may be rotated, or a sphere. Regions are convex: the mean of points inside is also inside."""

    middle: np.ndarray  # [3]
    half: np.ndarray  # [3] half of each side of a box; three times the same radius for a sphere
    axes: np.ndarray  # [3,3] rotation into the directions of the sides
    is_sphere: bool
    rounding: float = 0.0  # Error of rounded positions in files; moved positions keep this distance from the border


def number_views(count: int) -> tuple[str, ...]:
    """Name views by their numbers."""
    return tuple(f"view {view}" for view in range(count))


def _check_count(what: str, values: Sequence[Any], count: int) -> None:
    """Raise ValueError unless there are ``count`` values; ``what`` names the values in the message."""
    if len(values) != count:
        raise ValueError(f"expected {count} {what}, got {len(values)}")


@dataclass(frozen=True, eq=False, repr=False)
class Scene(ArrayFields):
    """Gaussians, and the views from which they were made or in which they are seen.

    The Gaussians are the rows of a file that are finite and not empty. If reading finds the pixel of each row, the
    scene has ``pixels``; otherwise :func:`gsmerge.prepare.true_pixels.find_pixels` finds them later.

    Args:
        gaussians: n Gaussians, in the frame of the cameras.
        cameras: The v views; None, or no cameras, if none are known.
        images: ``[v,h,w,3]`` photos, sRGB in [0, 1], float32; None: no photos. A run also accepts uint8.
        pixels: The pixel of each Gaussian, and the Gaussian in front of each pixel; None: not known yet.
        names: The views' names, which are the image file names if these are known; None: numbers.
        large_photos: The photos at a size with more pixels than the views; None: the photos have no more pixels.
        masks: ``[v,h,w]`` bool, True where a photo counts; None: everywhere. All False for a view without a photo.
        importance: ``[v,h,w]`` float32, how many pixels each pixel counts for in a fit; None: one each.
        filled: ``[n]`` bool, True for Gaussians that are not in the file, and were added to fill holes; None: no
            Gaussians were added.
        depths: ``[v,h,w]`` depth maps of the views, in any unit, which fill holes; None: none are known.
        region: The scene has no Gaussians outside of this region, as after a crop; None: no limit.
        notes: Notes from reading the files, for the report of a run; some are doubts.

    Raises:
        ValueError: If the sizes do not fit together.

    Example:
        >>> scene = gsmerge.read_scene("demo")
        >>> scene.pixels.own, len(scene), scene.images.shape
        (True, 5, (5, 32, 48, 3))
    """

    gaussians: Gaussians
    cameras: Cameras
    images: np.ndarray | None
    pixels: Pixels | None
    names: tuple[str, ...]
    large_photos: LargePhotos | None = None
    masks: np.ndarray | None = None
    importance: np.ndarray | None = None
    filled: np.ndarray | None = None
    region: Region | None = None
    notes: tuple[str, ...] = ()
    depths: np.ndarray | None = None

    def __post_init__(self) -> None:
        if self.cameras is None:
            object.__setattr__(self, "cameras", NO_CAMERAS)
        if self.names is None:
            object.__setattr__(self, "names", number_views(len(self.cameras)))
        check_fields(self)
        v = len(self.cameras)
        h = self.cameras.height
        w = self.cameras.width
        if self.pixels is not None:
            check_shape("homes", self.pixels.homes, (len(self.gaussians),))
            check_shape("fronts", self.pixels.fronts, (v, h, w))
        for name in PER_PIXEL:
            if getattr(self, name) is not None:
                check_shape(name, getattr(self, name), (v, h, w, 3) if name == "images" else (v, h, w))
        _check_count("view names", self.names, v)
        if self.large_photos is not None:
            _check_count("large photos", self.large_photos.ids, v)

    def __len__(self) -> int:
        return len(self.cameras)

    def __repr__(self) -> str:
        views = f"{len(self)} views of {self.cameras.width} x {self.cameras.height}" if len(self) else "no views"
        images = ", images" if self.images is not None else ""
        own = ", of pixels" if self.has_own_pixels else ""
        return f"Scene({len(self.gaussians):,} Gaussians, {views}{images}{own})"

    def numpy(self) -> Scene:
        """Return the same scene with NumPy arrays and images in [0, 1]; ValueError for images of another range."""
        names = [name for name in PER_PIXEL if getattr(self, name) is not None]
        arrays: dict[str, Any] = {name: as_array(getattr(self, name)) for name in names}
        if self.images is not None:
            arrays["images"] = as_pictures(self.images)
        return replace(self, gaussians=self.gaussians.numpy(), cameras=self.cameras.numpy(), **arrays)

    @property
    def has_own_pixels(self) -> bool:
        """Return whether each Gaussian is known to come from one view, with the colours of this view's photo."""
        return self.pixels is not None and self.pixels.own

    def get_pixels(self) -> Pixels:
        """Return the pixels, which every prepared scene has; AssertionError for a scene without pixels."""
        assert self.pixels is not None, "pixels are known"
        return self.pixels

    @property
    def covered(self) -> np.ndarray | None:
        """Mask ``[v,h,w]`` of the pixels for which the file has a Gaussian.

        None if the file has a Gaussian for every pixel, or if Gaussians do not come from single views.
        """
        if self.pixels is None or not self.pixels.own or (self.filled is None and self.pixels.shown.all()):
            return None
        shown = self.pixels.shown
        return shown if self.filled is None else shown & ~self.filled[self.pixels.fronts]

    @property
    def is_shown(self) -> bool:
        """Return whether the views have pictures, which are photos or the colours of the pixels' Gaussians."""
        return self.has_own_pixels or self.images is not None

    @property
    def photo_views(self) -> list[int]:
        """Views with a photo that counts in some pixel; empty without photos."""
        if self.images is None or self.masks is None:
            return [] if self.images is None else list(range(len(self)))
        return [view for view, mask in enumerate(self.masks) if mask.any()]

    @property
    def beyond(self) -> np.ndarray | None:
        """Mask ``[v,h,w]`` of pixels without importance, beyond photos or at edges that a photo mixes; None if none."""
        return None if self.importance is None else self.importance == 0

    @property
    def protected(self) -> np.ndarray | None:
        """Mask ``[v,h,w]`` of the protected pixels, by their importance; None if no pixel is protected."""
        if self.images is None or self.importance is None:
            return None
        mask = self.importance >= PROTECTED / 2
        return mask if mask.any() else None

    @property
    def num_gaussians(self) -> int:
        """Number of Gaussians in the file; budgets and ratios refer to this number."""
        return len(self.gaussians) - (0 if self.filled is None else int(self.filled.sum()))

    @property
    def file_gaussians(self) -> Gaussians:
        """The Gaussians of the file, without the Gaussians that were added to fill holes."""
        if self.filled is None:
            return self.gaussians
        count = self.num_gaussians
        are_last = not self.filled[:count].any()  # usually the added rows are the last ones, and a slice copies nothing
        return self.gaussians[slice(count) if are_last else ~self.filled]

    @property
    def pixels_per_view(self) -> int:
        """Number of pixels of a view, H·W."""
        return self.cameras.height * self.cameras.width


def make_scene(gaussians: Gaussians, cameras: Cameras) -> Scene:
    """Make a scene of Gaussians and cameras, without photos and pixels; the views are named by their numbers."""
    return Scene(gaussians, cameras, None, None, number_views(len(cameras)))


@dataclass(frozen=True, eq=False, repr=False)
class PicturedScene(Scene):
    """A scene in which every view has a picture: its photo or, without photos, colours or renders of its Gaussians.

    ``empty [v,h,w]`` is the share of each pixel in which the scene shows nothing, its transmittance; None: 0. It is
    above 0 only in pixels of renders, and in pixels that masks leave out, whose pictures are multiplied by 1 - empty.
    """

    images: np.ndarray
    empty: np.ndarray | None = None

    @staticmethod
    def with_pictures(scene: Scene, images: np.ndarray, masks: np.ndarray | None) -> PicturedScene:
        """Return a scene with pictures ``[v,h,w,3]``, sRGB in [0, 1], and masks of the pixels that count."""
        columns = {field.name: getattr(scene, field.name) for field in fields(Scene)}
        return PicturedScene(**columns | {"images": images, "masks": masks})

    def without_pictures(self) -> Scene:
        """Return the scene without its pictures."""
        return Scene(**{field.name: getattr(self, field.name) for field in fields(Scene)} | {"images": None})


@dataclass(frozen=True, eq=False)
class Groups:
    """The superpixels of all views, as a label for each pixel."""

    labels: np.ndarray  # [v,h,w] int32, the superpixel of each pixel, 0 to `counts[v] - 1` within its view
    counts: tuple[int, ...]  # Superpixels of each view

    def __post_init__(self) -> None:
        check_shape("labels", self.labels, (len(self.counts), "h", "w"))

    def __len__(self) -> int:
        return sum(self.counts)


@dataclass(frozen=True, eq=False)
class Segmentation:
    """The superpixels of a scene, and the number of Gaussians that the result may have."""

    groups: Groups  # Superpixels of every view
    count: int  # Largest number of Gaussians in the result
    exact: bool  # True if exactly ``count`` Gaussians were requested


@dataclass(frozen=True, eq=False)
class Matches:
    """Clusters of Feature Gaussians that show the same surface."""

    clusters: np.ndarray  # [g] int64, the cluster of each Feature Gaussian, dense from 0
    count: int  # Number of clusters


@dataclass(frozen=True, eq=False)
class FeatureGaussians:
    """g Gaussians that each represent a group of members, with facts about the group for later stages.

    Columns that describe a group are sums over its members (weights, masses, extinctions), or means weighted by one of
    these. Feature Gaussians are merged by the same sums and means. The opacity is computed when Feature Gaussians are
    decoded, as ``1 - exp(-gain * extinction / disc area)``, because blending conserves the integrated optical depth. In
    training, columns that networks change are tensors.
    """

    means: Array  # [g,3] float32
    covars: Array  # [g,3,3] float32: spread of the members' means plus their own covariances
    weights: np.ndarray  # [g] sum of the members' opacities
    masses: Array  # [g] opacity-weighted volume (paper eq. mass)
    extinctions: Array  # [g] optical depth integrated over the members' discs, world units squared
    gains: np.ndarray  # [g] factor on the optical depth; less than 1 for groups that other views see through
    sh0: Array  # [g,1,3] base colour
    shN: np.ndarray  # [g,k-1,3]
    footprints: np.ndarray  # [g] size of one pixel at the group's depth, world units
    views: np.ndarray  # [g] int64, view of the group; -1 if it was merged from several views
    starts: np.ndarray  # [g+1] int64, first member of each group in `members`
    members: np.ndarray  # [m] int32, rows of the scene's Gaussians, group by group
    latents: Array  # [g,d] latents of the networks (paper section 4.2), a tensor in training; d = 0 without networks

    def __post_init__(self) -> None:
        g = len(self)
        for name in ("weights", "masses", "extinctions", "gains", "footprints", "views"):
            check_shape(name, getattr(self, name), (g,))
        check_shape("covars", self.covars, (g, 3, 3))
        check_shape("starts", self.starts, (g + 1,))
        check_shape("latents", self.latents, (g, "d"))

    def __len__(self) -> int:
        return self.means.shape[0]

    @staticmethod
    def concat(parts: Sequence[FeatureGaussians]) -> FeatureGaussians:
        """Concatenate the groups of all parts."""
        names = [f.name for f in fields(FeatureGaussians) if f.name != "starts"]
        columns = {name: concat_rows([getattr(p, name) for p in parts]) for name in names}
        sizes = np.concatenate([np.diff(p.starts) for p in parts])
        starts = np.concatenate([np.zeros(1, np.int64), sizes.cumsum()])
        return FeatureGaussians(starts=starts, **columns)


@dataclass(frozen=True, eq=False)
class Decoded:
    """Canonical Gaussians with which a fit starts."""

    gaussians: Gaussians  # Canonical Gaussians
    count: int  # Number of Gaussians that the fit may reach by adding some
    exact: bool  # True if the result must have exactly ``count`` Gaussians
    fixed: np.ndarray | None = None  # [n] bool, Gaussians that the fit does not change; None: none
    is_input: bool = False  # True if the scene's Gaussians are all here, unchanged
