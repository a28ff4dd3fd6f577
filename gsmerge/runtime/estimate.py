"""What a scene costs before it is worked on: seconds and bytes, from its number of pixels and the settings."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

# Processor seconds per million pixels of all views together (or Gaussians, which is the same number), kernels compiled.
# Measured on 12 and on 84 views of 480 pixels; they only have to be right within a factor of two.
COST_FIXED = 1.5  # imports
MAX_SCORED_VIEWS = 24  # views that whole scenes are scored by
COST_READ = 0.7
COST_SEGMENT = {"rdseg": 0.5, "bass": 1.5, "bass-st": 1.5, "slic": 4.5, "grid": 0.0}
COST_MERGE = 0.5
COST_NETWORKS = 2.8  # at the usual density
COST_SCORE = 0.07  # rendering from input and output, per view that is scored
COST_ROBUST = 1.6
COST_COLOR_FIT = 0.9
COST_FULL_FIT = 0.2  # per step and million pixels of one view
COST_FIT_LOOKS = 1.5  # what the full fit looks at in all views
COST_RIVALS = {"paper": 1.7, "voxel": 1.8, "contribution": 0.7, "greedy": 25.0, "splat-transform": 60.0}
COST_RIVAL = 0.2  # of the others
COST_RIVAL_STEP = 0.15  # per step of the full fit, for each million Gaussians of an input that was not merged
BYTES_FIXED = 450_000_000  # interpreter, torch and numba
BYTES_PER_GAUSSIAN = 150
BYTES_PER_VALUE = 4.5  # of higher harmonics: of the scene, and some of its groups
BYTES_PER_PIXEL = 90  # the photo as floats and what segmentation and rendering keep of it


def work_seconds(pixels: int, view_pixels: float, options: Mapping[str, Any], *, photos: bool, fit_steps: int) -> float:
    """Processor seconds that a scene takes, without imports, within a factor of about two.

    Args:
        pixels: Of all views together, or Gaussians where they are more.
        view_pixels: Of one view.
        options: All settings by flat name, with the checkpoint that is used.
        photos: Whether the scene has photos.
        fit_steps: Steps of the full fit.
    """
    method, fit, views = options["method"], fit_of(options, photos=photos), pixels / max(view_pixels, 1)
    if method == "gsmerge":
        work = COST_MERGE + COST_SEGMENT[options["segmentation"]] + COST_ROBUST * is_robust(options, photos=photos)
        work += COST_NETWORKS * (options["checkpoint"] != "none")
    else:
        work = COST_RIVALS.get(method, COST_RIVAL)
    work += COST_READ + score_cost(views) * photos
    work += COST_COLOR_FIT * (fit == "color") + COST_FIT_LOOKS * (fit == "full")
    steps = fit_steps if fit == "full" else 0
    seconds = pixels / 1e6 * work + view_pixels / 1e6 * COST_FULL_FIT * steps
    return seconds + pixels / 1e6 * COST_RIVAL_STEP * steps * (method == "unmerged-fit")


def score_cost(views: float) -> float:
    """Processor seconds per million pixels that scoring input and result takes: every Gaussian in every scored view."""
    return COST_SCORE * min(views, MAX_SCORED_VIEWS)


def memory_bytes(pixels: int, *, photos: bool, num_rest: int = 0) -> int:
    """Memory that a scene takes, imports included, within a factor of about two.

    Args:
        pixels: As of :func:`work_seconds`.
        photos: Whether the scene has photos.
        num_rest: Columns of higher harmonics.
    """
    return BYTES_FIXED + round((BYTES_PER_GAUSSIAN + BYTES_PER_VALUE * num_rest + BYTES_PER_PIXEL * photos) * pixels)


def memory_problem(needed: int, there: int | None) -> str | None:
    """A sentence where a scene is not likely to fit into the memory that there is; None where it does.

    Args:
        needed: By :func:`memory_bytes`.
        there: Of the machine; None: not known.
    """
    if there is None or needed <= there:
        return None
    return (
        f"about {needed / 1e9:.1f} GB of memory are needed and this machine has {there / 1e9:.1f} GB: use fewer views"
        " (gsmerge extend adds more later), export without higher harmonics, or try --effort draft"
    )


def fit_of(options: Mapping[str, Any], *, photos: bool) -> str:
    """What is fitted to the photos: full, color or none."""
    own = {"gsmerge": options["fit"], "unmerged-fit": "full", "unmerged-color": "color"}
    return own.get(options["method"], "none") if photos else "none"


def is_robust(options: Mapping[str, Any], *, photos: bool) -> bool:
    """Whether merges are chosen among by the photos."""
    return photos and options["method"] == "gsmerge" and bool(options["robust"])
