"""Baselines: other methods behind one interface, run by ``compact(scene, method=NAME)``."""

from __future__ import annotations

from gsmerge.baselines import greedy, simple, voxel
from gsmerge.baselines.baseline import Baseline
from gsmerge.errors import UsageError
from gsmerge.options import CompactOptions, setting_names
from gsmerge.runtime.record import note
from gsmerge.search import Build
from gsmerge.stages.fit import FitOptions
from gsmerge.types import Scene

FULL_FIT_SETTINGS = ("effort", "device", "poses", *(name for name in setting_names(FitOptions) if name != "fit"))
_ALL = (
    Baseline("unmerged", simple.unmerged, uses=()),
    Baseline("unmerged-fit", simple.unmerged_fit, needs=("photos",), uses=FULL_FIT_SETTINGS),
    Baseline("moment-matching", simple.match_moments),
    Baseline("voxel", voxel.run),
    Baseline("opacity", simple.prune_by_opacity),
    Baseline("contribution", simple.prune_by_contribution),
    Baseline("random", simple.prune_at_random),
    Baseline("blocks", simple.merge_blocks, needs=("pixels",)),
    Baseline("greedy", greedy.run),
    Baseline("splat-transform", simple.splat_transform, needs=("node",)),
)
BASELINES = {baseline.name: baseline for baseline in _ALL}
COMMON_SETTINGS = {"method", "seed", "threads", "crop", "drop_floaters", "drop_sky"}  # that every method uses


def find_baseline(name: str) -> Baseline | None:
    """Find a baseline by name; None for our own method, "gsmerge". A ValueError if there is none of that name."""
    if name == "gsmerge":
        return None
    if name not in BASELINES:
        raise ValueError(f"method: expected gsmerge or one of {', '.join(BASELINES)}, got {name!r}")
    return BASELINES[name]


def choose_method(options: CompactOptions, scene: Scene, ours: Build) -> Build:
    """Choose the builder of the Gaussians: ``ours`` or a baseline, with a note on settings that it does not use.

    A UsageError if the scene does not have what a baseline needs, or its program is missing.
    """
    baseline, notes = choose_baseline(options, scene)
    for text in notes:
        note(text)
    return ours if baseline is None else baseline.build


def choose_baseline(options: CompactOptions, scene: Scene) -> tuple[Baseline | None, list[str]]:
    """Find the baseline of the options, and a note on changed settings that it does not use.

    A UsageError if the scene does not have what it needs, or a program is missing.
    """
    baseline = find_baseline(options.method)
    if baseline is None:
        return None, []
    method = f"method {baseline.name}"
    if "photos" in baseline.needs and scene.images is None:
        raise UsageError(f"{method}: expected photos, found none; give --images, or another --method")
    if "pixels" in baseline.needs and not scene.aligned:
        raise UsageError(f"{method}: expected one Gaussian per pixel, found an unaligned scene; give another --method")
    check_program(baseline)
    default, used = CompactOptions().to_dict(), {*baseline.uses, *COMMON_SETTINGS}
    unused = [name for name, value in options.to_dict().items() if name not in used and value != default[name]]
    return baseline, [f"{method} does not use {', '.join(unused)}"] if unused else []


def check_program(baseline: Baseline) -> None:
    """Raise a UsageError if a method's program is missing."""
    if "node" in baseline.needs:
        simple.find_program()
