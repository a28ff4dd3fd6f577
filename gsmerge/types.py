"""The core types: frozen dataclasses of tensors, and nothing but indexing and moving.

One convention in memory (docs/reference/conventions.md): linear scales, opacities in [0, 1], unit quaternions wxyz that
rotate local to world, world-to-camera matrices with OpenCV axes, pixel centres at +0.5, sRGB in [0, 1].
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from torch import Tensor

SH_C0 = 0.28209479177387814  # spherical harmonic of degree 0: rgb = 0.5 + SH_C0 * sh0


def _expect(name: str, tensor: Tensor, shape: tuple[int | str, ...]) -> None:
    ok = tensor.ndim == len(shape) and all(
        isinstance(want, str) or want == have for want, have in zip(shape, tensor.shape, strict=True)
    )
    if not ok:
        raise ValueError(f"{name}: expected shape {list(shape)}, got {list(tensor.shape)}")


@dataclass(frozen=True)
class Gaussians:
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
    """

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    sh0: Tensor
    shN: Tensor

    def __post_init__(self) -> None:
        n = self.means.shape[0]
        _expect("means", self.means, (n, 3))
        _expect("quats", self.quats, (n, 4))
        _expect("scales", self.scales, (n, 3))
        _expect("opacities", self.opacities, (n,))
        _expect("sh0", self.sh0, (n, 1, 3))
        _expect("shN", self.shN, (n, "k-1", 3))
        if self.shN.shape[1] not in (0, 3, 8, 15, 24):
            raise ValueError(f"shN: expected 0, 3, 8, 15 or 24 coefficients, got {self.shN.shape[1]}")

    def __len__(self) -> int:
        return self.means.shape[0]

    def __getitem__(self, index: Any) -> Gaussians:
        """The rows that ``index`` (slice, mask or integer tensor) selects."""
        return Gaussians(*(getattr(self, f.name)[index] for f in fields(self)))

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics, 0 to 4."""
        return round((self.shN.shape[1] + 1) ** 0.5) - 1

    def to(self, device: torch.device | str) -> Gaussians:
        """The same Gaussians on another device."""
        return Gaussians(*(getattr(self, f.name).to(device) for f in fields(self)))

    @staticmethod
    def concat(parts: Sequence[Gaussians]) -> Gaussians:
        """Rows of all parts, one part after the other; all must have the same SH degree."""
        return Gaussians(*(torch.cat([getattr(p, f.name) for p in parts]) for f in fields(Gaussians)))


@dataclass(frozen=True)
class Cameras:
    """c pinhole cameras of one image size.

    Args:
        viewmats: ``[c,4,4]`` world to camera, OpenCV axes (x right, y down, z forward), float64.
        Ks: ``[c,3,3]`` intrinsics in pixels; the top-left pixel's centre is (0.5, 0.5).
        width: Image width, pixels.
        height: Image height, pixels.

    Raises:
        ValueError: If the shapes do not fit together or the size is not positive.
    """

    viewmats: Tensor
    Ks: Tensor
    width: int
    height: int

    def __post_init__(self) -> None:
        c = self.viewmats.shape[0]
        _expect("viewmats", self.viewmats, (c, 4, 4))
        _expect("Ks", self.Ks, (c, 3, 3))
        if self.width < 1 or self.height < 1:
            raise ValueError(f"expected a positive image size, got {self.width} x {self.height}")

    def __len__(self) -> int:
        return self.viewmats.shape[0]

    def __getitem__(self, index: Any) -> Cameras:
        """The cameras that ``index`` (slice, mask or integer tensor) selects."""
        return replace(self, viewmats=self.viewmats[index], Ks=self.Ks[index])

    def to(self, device: torch.device | str) -> Cameras:
        """The same cameras on another device."""
        return replace(self, viewmats=self.viewmats.to(device), Ks=self.Ks.to(device))

    @property
    def centres(self) -> Tensor:
        """``[c,3]`` camera centres in the world."""
        rotation, shift = self.viewmats[:, :3, :3], self.viewmats[:, :3, 3]
        return -(rotation.transpose(1, 2) @ shift[:, :, None])[:, :, 0]


def _expect_views(cameras: Cameras, images: Tensor | None, names: tuple[str, ...]) -> None:
    if images is not None:
        _expect("images", images, (len(cameras), cameras.height, cameras.width, 3))
    if len(names) != len(cameras):
        raise ValueError(f"expected {len(cameras)} view names, got {len(names)}")


@dataclass(frozen=True)
class PixelScene:
    """A scene with one Gaussian per pixel and view, in view-major, row-major order.

    Args:
        gaussians: V·H·W rows; row ``(v·H + y)·W + x`` belongs to pixel (x, y) of view v. Rows that were not
            finite in the file are kept, as fully transparent ones, so that the order survives; pixels that the
            file has no row for are filled up with such ones, or with what a depth map says.
        cameras: The V views; width and height are the grid's.
        images: ``[v,h,w,3]`` photos, sRGB in [0, 1], float32; None where there are none.
        valid: ``[v,h,w]`` bool, False where there is no finite Gaussian.
        names: The views' names (image file names where known).
        missing: ``[v,h,w]`` bool, True where the file has no row for the pixel; None: nowhere.

    Raises:
        ValueError: If the sizes do not fit together.
    """

    gaussians: Gaussians
    cameras: Cameras
    images: Tensor | None
    valid: Tensor
    names: tuple[str, ...]
    missing: Tensor | None = None

    def __post_init__(self) -> None:
        v, h, w = len(self.cameras), self.cameras.height, self.cameras.width
        if len(self.gaussians) != v * h * w:
            raise ValueError(f"expected {v} x {h} x {w} = {v * h * w} Gaussians, got {len(self.gaussians)}")
        _expect("valid", self.valid, (v, h, w))
        if self.missing is not None:
            _expect("missing", self.missing, (v, h, w))
        _expect_views(self.cameras, self.images, self.names)

    def __len__(self) -> int:
        return len(self.cameras)

    @property
    def num_missing(self) -> int:
        """Pixels that the file has no row for."""
        return 0 if self.missing is None else int(self.missing.sum())

    @property
    def num_gaussians(self) -> int:
        """Gaussians of the file: what budgets and ratios count."""
        return len(self.gaussians) - self.num_missing

    @property
    def stored(self) -> Tensor:
        """``[v,h,w]`` bool: pixels whose Gaussian is a finite one of the file."""
        return self.valid if self.missing is None else self.valid & ~self.missing

    @property
    def file_gaussians(self) -> Gaussians:
        """The Gaussians of the file, without those that fill it up."""
        return self.gaussians if self.missing is None else self.gaussians[~self.missing.reshape(-1)]

    @property
    def pixels_per_view(self) -> int:
        """H·W."""
        return self.cameras.height * self.cameras.width


@dataclass(frozen=True)
class UnalignedScene:
    """Gaussians that belong to no pixels, with views that see them.

    Args:
        gaussians: Any number of rows, in the frame of the cameras.
        cameras: The V views; none where none are known.
        images: ``[v,h,w,3]`` photos, sRGB in [0, 1], float32; None where there are none.
        names: The views' names (image file names where known).

    Raises:
        ValueError: If the sizes do not fit together.
    """

    gaussians: Gaussians
    cameras: Cameras
    images: Tensor | None
    names: tuple[str, ...]

    def __post_init__(self) -> None:
        _expect_views(self.cameras, self.images, self.names)

    def __len__(self) -> int:
        return len(self.cameras)

    @property
    def num_gaussians(self) -> int:
        """Gaussians of the file."""
        return len(self.gaussians)

    @property
    def file_gaussians(self) -> Gaussians:
        """All of them."""
        return self.gaussians

    @property
    def pixels_per_view(self) -> int:
        """H·W."""
        return self.cameras.height * self.cameras.width


@dataclass(frozen=True)
class Groups:
    """A partition of the pixels of every view into superpixels."""

    labels: Tensor  # [v,h,w] int32, the superpixel of each pixel, 0 to `counts[v] - 1` within its view
    counts: tuple[int, ...]  # Superpixels of each view

    def __post_init__(self) -> None:
        _expect("labels", self.labels, (len(self.counts), "h", "w"))

    def __len__(self) -> int:
        return sum(self.counts)


@dataclass(frozen=True)
class Segmentation:
    """The superpixels of a scene and the number of Gaussians that they become."""

    groups: Groups  # Superpixels of every view
    coarse: Groups | None  # Coarse ones for the backing layer; None: no such layer
    count: int  # Gaussians in the end; never more
    exact: bool  # Whether that number was asked for as such, and is to be met


@dataclass(frozen=True)
class Matches:
    """Clusters of Feature Gaussians that show the same piece of surface."""

    clusters: Tensor  # [g] int64, the cluster of each Feature Gaussian, dense from 0
    count: int  # Number of clusters


@dataclass(frozen=True)
class FeatureGaussians:
    """g Gaussians that each stand for a group of members, with what later stages need to know of the group.

    Everything that describes the group adds up over its members (weights, masses, extinctions) or is an average
    with the weights, so merging Feature Gaussians is pooling again. Opacity is derived when decoding:
    ``1 - exp(-gain * extinction / disc area)`` (integrated optical depth is what blending conserves).
    """

    means: Tensor  # [g,3] float32
    covars: Tensor  # [g,3,3] float32: spread of the members' means plus their own covariances
    weights: Tensor  # [g] sum of the members' opacities
    masses: Tensor  # [g] opacity-weighted volume (paper eq. mass)
    extinctions: Tensor  # [g] optical depth integrated over the members' discs, world units squared
    gains: Tensor  # [g] factor on the optical depth: 1, or what the other views' photos say
    spreads: Tensor  # [g] factor on the standard deviations at decoding
    sh0: Tensor  # [g,1,3] base colour
    shN: Tensor  # [g,k-1,3]
    footprints: Tensor  # [g] size of one pixel at the group's depth, world units
    views: Tensor  # [g] int64, the view of the group, -1 when it was merged from several
    backing: Tensor  # [g] bool: belongs to the coarse layer behind the surfaces
    starts: Tensor  # [g+1] int64 into `members`
    members: Tensor  # [m] int64 rows of the scene's Gaussians, group by group
    latents: Tensor  # [g,d] what the networks remember of the group (paper section 4.2); d = 0 without networks

    def __post_init__(self) -> None:
        g = self.means.shape[0]
        for name in ("weights", "masses", "extinctions", "gains", "spreads", "footprints", "views", "backing"):
            _expect(name, getattr(self, name), (g,))
        _expect("covars", self.covars, (g, 3, 3))
        _expect("starts", self.starts, (g + 1,))
        _expect("latents", self.latents, (g, "d"))

    def __len__(self) -> int:
        return self.means.shape[0]

    @staticmethod
    def concat(parts: Sequence[FeatureGaussians]) -> FeatureGaussians:
        """All groups, one part after the other."""
        names = [f.name for f in fields(FeatureGaussians) if f.name != "starts"]
        columns = {name: torch.cat([getattr(p, name) for p in parts]) for name in names}
        sizes = torch.cat([p.starts[1:] - p.starts[:-1] for p in parts])
        starts = torch.cat([torch.zeros(1, dtype=torch.int64), sizes.cumsum(0)])
        return FeatureGaussians(starts=starts, **columns)
