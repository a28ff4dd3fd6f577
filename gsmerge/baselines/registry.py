"""All rival methods, and whether one goes with a scene and its settings."""

from __future__ import annotations

from gsmerge.baselines.baseline import Baseline
from gsmerge.baselines.blocks import BLOCKS
from gsmerge.baselines.contribution import CONTRIBUTION
from gsmerge.baselines.greedy import GREEDY
from gsmerge.baselines.opacity import OPACITY
from gsmerge.baselines.paper import PAPER
from gsmerge.baselines.random import RANDOM
from gsmerge.baselines.splat_transform import SPLAT_TRANSFORM, find_program
from gsmerge.baselines.unmerged import UNMERGED
from gsmerge.baselines.unmerged_color import UNMERGED_COLOR
from gsmerge.baselines.unmerged_fit import UNMERGED_FIT
from gsmerge.baselines.voxel import VOXEL
from gsmerge.errors import UsageError
from gsmerge.options import CompactOptions
from gsmerge.types import PixelScene, UnalignedScene

_ALL = (
    UNMERGED, UNMERGED_COLOR, UNMERGED_FIT, PAPER, VOXEL, OPACITY, CONTRIBUTION, RANDOM, BLOCKS, GREEDY,
    SPLAT_TRANSFORM,
)  # fmt: skip
BASELINES = {baseline.name: baseline for baseline in _ALL}
EVERYBODY_S = {"method", "seed", "threads"}


def find_baseline(name: str) -> Baseline | None:
    """The rival method of that name; None for our own, "gsmerge".

    Raises:
        ValueError: If there is none of that name.
    """
    if name == "gsmerge":
        return None
    if name not in BASELINES:
        raise ValueError(f"method: expected gsmerge or one of {', '.join(BASELINES)}, got {name!r}")
    return BASELINES[name]


def choose_baseline(options: CompactOptions, scene: PixelScene | UnalignedScene) -> tuple[Baseline | None, list[str]]:
    """The baseline that is asked for, fit for the scene, and a note on settings that it does not use.

    Raises:
        UsageError: If the scene does not have what it needs, or a program is missing.
    """
    baseline = find_baseline(options.method)
    if baseline is None:
        return None, []
    check_scene(baseline, scene)
    return baseline, unused_notes(baseline, options)


def check_scene(baseline: Baseline, scene: PixelScene | UnalignedScene) -> None:
    """Whether a scene has what a method needs.

    Raises:
        UsageError: If it has not, or a program is missing.
    """
    if "photos" in baseline.needs and scene.images is None:
        raise UsageError(f"method {baseline.name}: expected photos, found none; give --images, or another --method")
    if "pixels" in baseline.needs and isinstance(scene, UnalignedScene):
        raise UsageError(
            f"method {baseline.name}: expected one Gaussian per pixel, found them in no order; give another --method"
        )
    check_program(baseline)


def check_program(baseline: Baseline) -> None:
    """Whether the program that a method runs is there, if it runs one.

    Raises:
        UsageError: If it is missing.
    """
    if "node" in baseline.needs:
        find_program()


def unused_notes(baseline: Baseline, options: CompactOptions) -> list[str]:
    """A sentence that names the settings that were changed and that a method does not look at, if there are any."""
    usual, own = CompactOptions().to_dict(), {*baseline.uses, *EVERYBODY_S}
    unused = [name for name, value in options.to_dict().items() if name not in own and value != usual[name]]
    return [f"method {baseline.name} does not look at {', '.join(unused)}"] if unused else []
