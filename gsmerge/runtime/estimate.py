"""What a run will take, in seconds and bytes, from a scene's number of pixels and the settings."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from gsmerge.runtime.memory import machine_memory

MAX_SCORED_VIEWS = 24  # views by which whole scenes are judged where something depends on it
REPORT_VIEWS = 4  # views that input and result are scored on for the report alone

# Time. Only right within a factor of two: measured on 12 and on 84 views of 480 pixels, with compiled kernels.
IMPORT_SECONDS = 0.8
# Processor seconds per million pixels of all views together, or per million Gaussians, which is the same number:
COST_READ = 0.7
COST_SEGMENT = {"rdseg": 0.5, "bass": 1.5, "bass-st": 1.5, "bass-adaptive": 6.0, "slic": 4.5, "grid": 0.0}
COST_MERGE = 0.5
COST_NETWORKS = 2.8  # at the default superpixels
COST_SCORE = 0.07  # for each scored view: rendering from input and output
COST_FIT_RENDERS = 1.5  # what the full fit renders of all views besides its steps
COST_BASELINES = {"moment-matching": 1.7, "voxel": 1.8, "contribution": 0.7, "greedy": 25.0, "splat-transform": 60.0}
COST_OTHER_BASELINE = 0.2
COST_UNMERGED_STEP = 0.15  # for each step of the full fit of an input that was not merged
# Processor seconds per step of the full fit and million pixels of one view:
COST_FULL_FIT = 0.2
COST_LARGE_PHOTOS = 0.2  # more for each pixel of a larger photo, as a share

# Memory, in bytes.
BYTES_FIXED = 250_000_000  # interpreter, numba and kernels
BYTES_PER_GAUSSIAN = 150
BYTES_PER_VALUE = 4.5  # of higher harmonics, per Gaussian: those of the scene, and of some of its groups
BYTES_PER_PIXEL = 90  # the photo as floats and what segmentation and rendering hold of it


def work_seconds(
    pixels: int,
    view_pixels: float,
    options: Mapping[str, Any],
    *,
    photos: bool,
    fit_steps: int,
    photo_scale: float = 1.0,
) -> float:
    """Processor seconds that a scene takes, without imports, within a factor of about two.

    Args:
        pixels: Of all views together, or Gaussians where they are more.
        options: All settings by flat name, with the checkpoint that is used.
        photo_scale: Times the views' size at which the full fit looks at larger photos.
    """
    method, fit, views = options["method"], fit_of(options, photos=photos), pixels / max(view_pixels, 1)
    if method == "gsmerge":
        work = COST_MERGE + COST_SEGMENT[options["segmentation"]]
        work += COST_NETWORKS * (options["checkpoint"] != "none")
    else:
        work = COST_BASELINES.get(method, COST_OTHER_BASELINE)
    work += COST_READ + score_cost(views) * photos
    work += COST_FIT_RENDERS * (fit == "full")
    steps = fit_steps if fit == "full" else 0
    step = COST_FULL_FIT * (1 + COST_LARGE_PHOTOS * (photo_scale**2 - 1))
    seconds = pixels / 1e6 * work + view_pixels / 1e6 * step * steps
    return seconds + pixels / 1e6 * COST_UNMERGED_STEP * steps * (method == "unmerged-fit")


def score_cost(views: float) -> float:
    """Processor seconds per million pixels for scoring input and result: every Gaussian in every scored view."""
    return COST_SCORE * min(views, REPORT_VIEWS)


def memory_bytes(pixels: int, *, photos: bool, num_rest: int = 0) -> int:
    """Memory that a scene takes, imports included, within a factor of about two.

    ``pixels`` as of :func:`work_seconds`; ``num_rest``: columns of higher harmonics.
    """
    return BYTES_FIXED + round((BYTES_PER_GAUSSIAN + BYTES_PER_VALUE * num_rest + BYTES_PER_PIXEL * photos) * pixels)


def memory_problem(needed: int, available: int | None) -> str | None:
    """A sentence where the bytes of :func:`memory_bytes` are not likely to fit into the machine; None if they do."""
    if available is None or needed <= available:
        return None
    return (
        f"about {needed / 1e9:.1f} GB of memory are needed and this machine has {available / 1e9:.1f} GB: use fewer"
        " views (gsmerge extend adds more later), export without higher harmonics, or try --effort draft"
    )


def fit_of(options: Mapping[str, Any], *, photos: bool) -> str:
    """What is fitted to the photos: full or none."""
    own = {"gsmerge": options["fit"], "unmerged-fit": "full"}
    return own.get(options["method"], "none") if photos else "none"


def estimate_run(
    grid: tuple[int, int, int],
    options: Mapping[str, Any],
    num_pixels: int,
    *,
    photos: bool,
    threads: int,
    fit_steps: int,
    num_rest: int = 0,
    photo_scale: float = 1.0,
) -> dict[str, Any]:
    """Seconds and bytes of a run, right within a factor of about two once the kernels are compiled.

    Args:
        grid: Views, height and width.
        options: As of :func:`work_seconds`, and so are ``num_pixels`` (its ``pixels``), ``photos``, ``fit_steps`` and
            ``photo_scale``.
        num_rest: Columns of higher harmonics.

    Returns:
        ``seconds``, ``memory_bytes``, and ``machine_memory_bytes``, None where the system does not report it.
    """
    views, height, width = grid
    seconds = work_seconds(
        num_pixels, height * width, options, photos=photos, fit_steps=fit_steps, photo_scale=photo_scale
    )
    return {
        "seconds": round(IMPORT_SECONDS + seconds / max(1, min(threads, views)), 1),
        "memory_bytes": memory_bytes(num_pixels, photos=photos, num_rest=num_rest),
        "machine_memory_bytes": machine_memory(),
    }


def memory_problems(estimate: Mapping[str, Any]) -> list[str]:
    """That an estimated run is not likely to fit into this machine's memory; nothing where it does."""
    problem = memory_problem(estimate["memory_bytes"], estimate["machine_memory_bytes"])
    return [] if problem is None else [problem]
