"""What a rival method is: a name, what it needs, which settings it looks at, and a function."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from gsmerge.build import Source
from gsmerge.options import CompactOptions
from gsmerge.runtime.run_log import RunLog
from gsmerge.stages.group import Canvas
from gsmerge.types import Gaussians, PixelScene

Need = Literal["photos", "pixels", "node"]
Run = Callable[[Source, Canvas, CompactOptions, int, RunLog], Gaussians]

COUNTS = ("budget", "max_bytes", "preset", "superpixels", "density", "k")  # settings that decide how many


@dataclass(frozen=True)
class Baseline:
    """One rival method.

    Args:
        name: As on the command line.
        title: What it does, in a few words.
        run: Source, canvas, options, number of Gaussians, journal -> canonical Gaussians, at most that many unless
            the method keeps the input's. It times itself, by stages of the journal.
        needs: ``"photos"``; ``"pixels"``: one Gaussian per pixel; ``"node"``: a program that runs in Node.js.
        uses: Settings that it looks at, by flat name; seed and threads are everybody's.
    """

    name: str
    title: str
    run: Run
    needs: tuple[Need, ...] = ()
    uses: tuple[str, ...] = COUNTS


def own_gaussians(source: Source) -> Gaussians:
    """The Gaussians that the file has, without the rows that only stand in for missing or broken ones."""
    scene = source.scene
    if isinstance(scene, PixelScene) and not bool(scene.stored.all()):
        return scene.gaussians[scene.stored.reshape(-1)]
    return scene.gaussians


def view_shares(count: int, num_views: int, most: int) -> list[int]:
    """A number dealt out evenly over the views, at most ``most`` each; the first views get the rest."""
    return [min(most, count // num_views + (view < count % num_views)) for view in range(num_views)]
