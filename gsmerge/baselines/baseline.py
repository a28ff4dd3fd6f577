"""What a rival method is: a name, what it needs, which settings it looks at, and a function."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from gsmerge.runtime.run_log import RunLog
from gsmerge.stages.prepare import PreparedScene
from gsmerge.types import Gaussians, PixelScene, UnalignedScene

Need = Literal["photos", "pixels", "node"]
Run = Callable[[PreparedScene, int, RunLog], Gaussians]

COUNTS = ("budget", "max_bytes", "preset", "superpixels", "density", "k")  # settings that decide how many


@dataclass(frozen=True)
class Baseline:
    """One rival method.

    Args:
        name: As on the command line.
        title: What it does, in a few words.
        run: Prepared scene, number of Gaussians, log -> canonical Gaussians, at most that many unless the method keeps
            the input's. It times itself, by stages of the log.
        needs: ``"photos"``; ``"pixels"``: one Gaussian per pixel; ``"node"``: a program that runs in Node.js.
        uses: Settings that it looks at, by flat name; seed and threads are everybody's.
    """

    name: str
    title: str
    run: Run
    needs: tuple[Need, ...] = ()
    uses: tuple[str, ...] = COUNTS

    def build(self, prepared: PreparedScene, count: int | None, log: RunLog) -> Gaussians:
        """Canonical Gaussians: ``count``, or None for as many as ``superpixels`` and K give."""
        return self.run(prepared, prepared.limits.default if count is None else count, log)


def own_gaussians(scene: PixelScene | UnalignedScene) -> Gaussians:
    """The Gaussians that the file has, without the rows that only stand in for missing or broken ones."""
    if isinstance(scene, PixelScene) and not bool(scene.stored.all()):
        return scene.gaussians[scene.stored.reshape(-1)]
    return scene.gaussians


def view_shares(count: int, num_views: int, most: int) -> list[int]:
    """A number dealt out evenly over the views, at most ``most`` each; the first views get the rest."""
    return [min(most, count // num_views + (view < count % num_views)) for view in range(num_views)]


def most_important(importance: Tensor | np.ndarray, count: int) -> Tensor:
    """Indices, rising, of the ``count`` most important Gaussians; of equal ones the first are kept.

    Args:
        importance: ``[n]``, for instance the summed blending weight over all photos.
        count: How many to keep; all if there are fewer.

    Raises:
        ValueError: If ``count`` is negative.
    """
    if count < 0:
        raise ValueError(f"count: expected at least 0, got {count}")
    values = torch.as_tensor(importance).double().nan_to_num(nan=-torch.inf, neginf=-torch.inf)
    return torch.sort(torch.argsort(values, descending=True, stable=True)[:count]).values
