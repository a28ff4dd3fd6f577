"""What the other views' Gaussians say of a Feature Gaussian: no photo is looked at."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from gsmerge.kernels.gaussians.evidence import COLUMNS, look_around
from gsmerge.moments import Members
from gsmerge.runtime.threads import parallel_map
from gsmerge.types import SH_C0, Cameras

EVIDENCE = COLUMNS + 1
NEAR = 0.03  # relative difference of depths that still is the same surface
FAR = 0.3  # differences are held within
LEAST = 1 / 255  # opacity of a Gaussian that says anything
ROWS = 8192  # points per task


def evidence(means: Tensor, sh0: Tensor, views: Tensor, members: Members, cameras: Cameras) -> Tensor:
    """Agreement with the Gaussian of the pixel that each point falls on in every other view.

    Args:
        means: ``[g,3]``.
        sh0: ``[g,1,3]`` base colours.
        views: ``[g]`` view that each was seen in, which is not asked.
        members: The scene's Gaussians, one per pixel; in no order, nothing is known.
        cameras: All views.

    Returns:
        ``[g,7]``: logarithm of the number of views that see it; the shares of these that have a surface there, behind
        it, and before it; the difference of colours and the mean relative difference of depths; the logarithm of the
        number of views.
    """
    found = torch.zeros(len(means), EVIDENCE)
    found[:, 6] = float(np.log(len(cameras))) / 4
    if members.pixels is not None or len(means) == 0:
        return found
    points, colors = means.double().contiguous().numpy(), (SH_C0 * sh0[:, 0]).contiguous().numpy()
    viewmats, Ks = (tensor.double().contiguous().numpy() for tensor in (cameras.viewmats, cameras.Ks))
    size, limits = (cameras.width, cameras.height), (SH_C0, NEAR, FAR, LEAST)
    sums, m = np.zeros((len(points), COLUMNS)), members

    def some(first: int) -> None:
        last = min(first + ROWS, len(points))
        look_around(
            points, colors, views.numpy(), viewmats, Ks, *size, m.means, m.opacities, m.sh0, *limits, first, last, sums
        )  # fmt: skip

    parallel_map(some, range(0, len(points), ROWS))
    num_seen, num_same = np.maximum(sums[:, 0], 1), np.maximum(sums[:, 1], 1)
    shares = [sums[:, 1] / num_seen, sums[:, 2] / num_seen, sums[:, 3] / num_seen, sums[:, 4] / num_same]
    columns = np.stack([np.log1p(sums[:, 0]) / 3, *shares, sums[:, 5] / num_seen / FAR], 1)
    found[:, :6] = torch.from_numpy(columns).float()
    return found
