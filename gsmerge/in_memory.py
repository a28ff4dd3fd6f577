"""From arrays or tensors in memory to the compact Gaussians, as arrays or tensors of the same kind."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from gsmerge.geometry import sh0_to_rgb
from gsmerge.io import atomic_outputs, output_format, write_gaussians
from gsmerge.io.cameras.json_files import viewer_cameras_path, write_viewer_cameras
from gsmerge.io.tensors import TensorInput, read_tensors
from gsmerge.pipeline import compact
from gsmerge.report import CompactReport
from gsmerge.runtime.record import Progress
from gsmerge.types import Array, Cameras, Gaussians, as_array, like


@dataclass(frozen=True, eq=False)
class CompactTensors:
    """Compact Gaussians as arrays, or as tensors on the device of those that they were made from.

    Args:
        means: ``[n,3]`` centres, world units.
        quats: ``[n,4]`` unit quaternions wxyz, local to world.
        scales: ``[n,3]`` standard deviations, world units, linear.
        opacities: ``[n]`` in [0, 1].
        sh0: ``[n,1,3]`` harmonics of degree 0.
        shN: ``[n,k-1,3]`` higher harmonics, basis-major.
        report: What was done.
        cameras: The views that they were made from, NumPy arrays: moved where their poses were wrong.
        names: Of the views.
    """

    means: Array
    quats: Array
    scales: Array
    opacities: Array
    sh0: Array
    shN: Array
    report: CompactReport
    cameras: Cameras
    names: tuple[str, ...]

    def __len__(self) -> int:
        return self.means.shape[0]

    @property
    def gaussians(self) -> Gaussians:
        """The same as :class:`gsmerge.Gaussians`, for :func:`gsmerge.render` and others."""
        return Gaussians(self.means, self.quats, self.scales, self.opacities, self.sh0, self.shN)

    @property
    def colors(self) -> Array:
        """``[n,3]`` base colours, sRGB; harmonics may leave [0, 1] a little."""
        return like(sh0_to_rgb(as_array(self.sh0)[:, 0]), self.sh0)

    def save(self, path: str | os.PathLike[str], *, overwrite: bool = False, cameras: bool = True) -> None:
        """Write them in the format that the ending of the name says, see :func:`gsmerge.write_gaussians`.

        Args:
            path: The file; its folder must exist.
            overwrite: Replace files that are there.
            cameras: Write the views beside it, as ``NAME.cameras.json``, for viewers.

        Raises:
            UsageError: If the name has no known ending.
            SceneError: If a file exists or cannot be written.
        """
        out = Path(path)
        ending = output_format(out)
        with atomic_outputs(overwrite=overwrite) as add:
            write_gaussians(add(out), self.gaussians.numpy(), overwrite=True, ending=ending)
            if cameras and len(self.cameras):
                write_viewer_cameras(add(viewer_cameras_path(out)), self.cameras, self.names)


def compact_tensors(
    *,
    means: Array,
    quats: Array,
    scales: Array,
    opacities: Array,
    sh0: Array | None = None,
    colors: Array | None = None,
    shN: Array | None = None,
    images: Array | None = None,
    viewmats: Array | None = None,
    Ks: Array | None = None,
    shape: tuple[int, int, int] | None = None,
    names: Sequence[str] | None = None,
    order: str = "view-major",
    check_rotations: bool = True,
    progress: Progress | None = None,
    **settings: Any,
) -> CompactTensors:
    """Compact Gaussians that are in memory: :func:`gsmerge.compact` without files.

    Arrays are NumPy's or torch's, on any device; they are copied, without gradients. Further axes in front are taken
    apart, so ``[1,n,3]`` and ``[V,H,W,3]`` are ``[n,3]``. What is in another convention is refused in one line that
    says what was found and what to pass instead. Rows with NaN or infinities are set aside.

    Args:
        means: ``[n,3]`` centres, world units; row ``(v·H + y)·W + x`` belongs to pixel (x, y) of view v.
        quats: ``[n,4]`` unit quaternions wxyz that rotate local to world.
        scales: ``[n,3]`` standard deviations, world units, linear.
        opacities: ``[n]`` in [0, 1].
        sh0: ``[n,1,3]`` or ``[n,3]`` harmonics of degree 0; rgb = 0.5 + 0.2821 sh0.
        colors: ``[n,3]`` sRGB in [0, 1], in place of ``sh0``.
        shN: ``[n,k-1,3]`` higher harmonics, basis-major; None: none.
        images: ``[V,H,W,3]`` photos, sRGB in [0, 1]; None: nothing is fitted and no PSNR measured.
        viewmats: ``[V,4,4]`` or ``[V,3,4]`` world to camera, OpenCV axes.
        Ks: ``[V,3,3]`` intrinsics in pixels; the top-left pixel's centre is (0.5, 0.5).
        shape: Views, height and width; None: those of the images.
        names: Of the views; None numbers them.
        order: ``"view-major"``: one Gaussian per pixel, as above; ``"none"``: they belong to no pixels (trained scenes,
            voxels), and cameras may be missing.
        check_rotations: Refuse rotations that follow the surface far better in another convention; False for models
            whose own renderer takes them as they are.
        progress: As of :func:`gsmerge.compact`.
        **settings: Those of :func:`gsmerge.compact`: ``budget="4%"``, ``k=2``, ``effort="fast"``.

    Returns:
        The compact Gaussians: tensors on the device of ``means`` if these are a tensor, otherwise arrays.

    Raises:
        SceneError: If an array has another shape or convention.
        ValueError: If a setting is unknown or out of range.

    Example:
        >>> small = compact_tensors(means=m, quats=q, scales=s, opacities=o, colors=c, images=i, viewmats=w, Ks=K)
        ... # doctest: +SKIP
    """
    given = TensorInput(
        means, quats, scales, opacities, sh0, colors, shN, images, viewmats, Ks, shape, names, order, check_rotations
    )
    scene, notes = read_tensors(given)
    result = compact(scene, progress=progress, **settings)
    result.report.notes[:0] = notes
    rows = {field.name: like(getattr(result.gaussians, field.name), means) for field in fields(Gaussians)}
    return CompactTensors(**rows, report=result.report, cameras=result.cameras, names=scene.names)
