"""Images of Gaussians."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gsmerge.render.blend import background_color, blend, view_colors
from gsmerge.render.plan import plan_view, prepare
from gsmerge.threads import parallel_map
from gsmerge.types import Cameras, Gaussians


@dataclass(frozen=True, eq=False)
class Rendering:
    """Images of c views.

    Args:
        images: ``[c,h,w,3]`` float32 over the background, not clamped at 1.
        alphas: ``[c,h,w,1]`` float32, 1 less the remaining transmittance.
        depths: ``[c,h,w,1]`` float32 mean camera z of what was blended, 0 where nothing was; None if not asked for.
    """

    images: Tensor
    alphas: Tensor
    depths: Tensor | None


def render(
    gaussians: Gaussians,
    cameras: Cameras,
    background: float | Sequence[float] | Tensor = 0.0,
    *,
    antialiased: bool = False,
    near: float = 0.01,
    far: float = 1e10,
    with_depths: bool = False,
) -> Rendering:
    """Render Gaussians into every camera.

    Args:
        gaussians: n Gaussians, SH degrees 0 to 4.
        cameras: c cameras; their intrinsics' skew is ignored.
        background: What shines through, 1 or 3 numbers.
        antialiased: Lower the opacity of small Gaussians by what the dilation adds to them.
        near: Nearest depth drawn, world units, above 0.
        far: Farthest depth drawn.
        with_depths: Also render the mean depth.

    Returns:
        Images, alphas and, if asked for, depths.

    Raises:
        ValueError: If the background or the depth range makes no sense.
    """
    # Around the cameras' own centre, in float64, so that scenes in geographic coordinates keep their detail.
    origin = cameras.centres.double().mean(0).cpu().numpy() if len(cameras) else np.zeros(3)
    splats = prepare(gaussians, origin)
    viewmats, Ks = cameras.viewmats.double().cpu().numpy(), cameras.Ks.double().cpu().numpy()
    shape = (len(cameras), cameras.height, cameras.width)
    images, alphas = np.empty((*shape, 3), np.float32), np.empty((*shape, 1), np.float32)
    depths = np.zeros((*shape, 1), np.float32) if with_depths else None
    under = background_color(background)

    def one(view: int) -> None:
        plan = plan_view(
            splats, viewmats[view], Ks[view], cameras.width, cameras.height,
            antialiased=antialiased, near=near, far=far,
        )  # fmt: skip
        images[view], transmittance = blend(plan, view_colors(plan), under)
        alphas[view, ..., 0] = 1 - transmittance
        if depths is not None:
            colors = np.repeat(plan.depths[:, None], 3, 1)
            weighted = blend(plan, colors, np.zeros(3, np.float32))[0][..., :1]
            np.divide(weighted, alphas[view], out=depths[view], where=alphas[view] > 0)

    if len(cameras) == 1:
        one(0)  # not through the pool, so that the pieces of the one view can share it
    else:
        parallel_map(one, range(len(cameras)))
    return Rendering(
        torch.from_numpy(images), torch.from_numpy(alphas), None if depths is None else torch.from_numpy(depths)
    )
