"""Render Gaussians as their scene asks: with a near plane that follows its scale, and doubts about empty pictures."""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np

from gsmerge.arrays import Array, as_array
from gsmerge.errors import Doubt, DoubtWarning
from gsmerge.method.geometry.frame import FRAME_GAUSSIANS, seen_depth, unit_of
from gsmerge.method.geometry.transforms import is_inside, project
from gsmerge.method.raster import Rendering
from gsmerge.method.raster import render as render_at
from gsmerge.method.raster.photos import LEAST_OPACITY, NEAR_PLANE
from gsmerge.method.raster.tiled_view import FAR_PLANE
from gsmerge.runtime.arguments import check_arguments
from gsmerge.runtime.record import list_some
from gsmerge.types import Cameras, Gaussians


@check_arguments
def render(
    gaussians: Gaussians,
    cameras: Cameras,
    background: float | Sequence[float] | Array = 0.0,
    *,
    antialiased: bool | None = None,
    near: float | None = None,
    far: float = FAR_PLANE,
    with_depths: bool = False,
) -> Rendering:
    """Render Gaussians into every camera.

    Arrays give arrays, and tensors give tensors. Rendering runs on the CPU. Tensors on a GPU are copied to the CPU, and
    results and gradients are copied back.

    For tensors, images and alphas are differentiable with respect to the Gaussians and the view matrices. Depths and
    intrinsics have no gradient. No gradient passes where alpha is clamped at 0.99 or a colour at 0.

    Pictures in which no Gaussian is seen are named in a warning of the class :class:`gsmerge.DoubtWarning`.

    Args:
        gaussians: n Gaussians, SH degrees 0 to 4.
        cameras: c cameras, whose skew is ignored.
        background: Colour behind the Gaussians, 1 or 3 numbers.
        antialiased: Lower the opacity of small Gaussians to compensate for the dilation; None: as ``cameras`` say,
            which have the mark of a scene's file.
        near: Nearest depth drawn, world units, above 0; None: 0.01, or in a small scene about a hundredth of the median
            depth in the views.
        far: Farthest depth drawn.
        with_depths: Also render the mean depth.

    Returns:
        Images, alphas and, if requested, depths.

    Raises:
        ValueError: If the background has another number of values, or if ``near`` is not above 0 and below ``far``.

    Example:
        >>> scene = gsmerge.read_scene("demo")
        >>> gsmerge.render(scene.gaussians, scene.cameras, background=1.0).images.shape
        (5, 32, 48, 3)
    """
    near = min(NEAR_PLANE, near_plane(gaussians, cameras)) if near is None else near
    for doubt in doubt_empty(gaussians, cameras, near, [f"picture {view}" for view in range(len(cameras))]):
        warnings.warn(doubt, DoubtWarning, stacklevel=3)  # the caller: above this function and its decorator
    return render_at(
        gaussians, cameras, background, antialiased=antialiased, near=near, far=far, with_depths=with_depths
    )


def near_plane(gaussians: Gaussians, cameras: Cameras) -> float:
    """Choose the near plane, in world units, by the depth of the Gaussians in the cameras that see them."""
    means = as_array(gaussians.means)[:: max(1, len(gaussians) // FRAME_GAUSSIANS)]
    return NEAR_PLANE * unit_of(seen_depth(means, cameras.numpy()))


def doubt_empty(gaussians: Gaussians, cameras: Cameras, near: float, names: Sequence[str]) -> list[Doubt]:
    """Say in which pictures of the cameras no Gaussian is seen, by their ``names``, and why: a doubt for each reason.

    ``near`` is the depth of the near plane in world units.
    """
    gaussians = gaussians.numpy()
    cameras = cameras.numpy()
    sample = 1024  # a picture in which some of about so many are opaque shows something; all others are drawn
    few = gaussians[:: max(1, len(gaussians) // sample)]
    pixels, depths = project(few.means, cameras)
    is_shown = ((few.opacities > 0.5) & (depths > near) & is_inside(pixels, cameras)).any(1)
    empty: dict[str, list[str]] = {}
    for view in np.flatnonzero(~is_shown).tolist():
        camera = cameras[[view]]
        if render_at(gaussians, camera, near=near).alphas.any():
            continue
        pixels, depths = project(gaussians.means, camera)
        is_opaque = gaussians.opacities >= LEAST_OPACITY
        is_before = is_opaque & (depths > 0)
        is_in = is_before & is_inside(pixels, camera)
        reasons = {
            "it has none, or all are transparent": is_opaque,
            "all lie behind the camera": is_before,
            "all lie beside the picture, or behind the camera": is_in,
            f"those in the picture lie nearer than the near plane, {near:.3g}": is_in & (depths > near),
            "those in the picture are too faint and small": np.zeros(1),
        }
        reason = next(reason for reason, rest in reasons.items() if not rest.any())
        empty.setdefault(reason, []).append(names[view])
    return [
        Doubt(f"no Gaussian of the scene is seen in {list_some(pictures)}, because {reason}", "empty", pictures)
        for reason, pictures in empty.items()
    ]
