"""Estimate the seconds and bytes of a run before it starts, within a factor of about two.

The costs are mean processor seconds of whole runs, on any settings. ``gsmerge/compaction/forecast.py`` forecasts a run
that has started, and has separate costs. It measures the seconds itself, and only needs the ratios of costs between the
parts of one run, but more exactly.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from gsmerge.runtime.memory import machine_memory

# Processor seconds, measured on 7 views of 480 x 352 and 12 of 480 x 256 pixels
IMPORT_SECONDS = 1.0  # imports, and the constant part of every run
# Per million pixels of all views together, or per million Gaussians if there are more of these:
COST_MERGE = 1.0  # reading, superpixels and merging
COST_SCORE = 0.3  # of input and result against the photos
COST_NETWORKS = 1.4
COST_PAPER = 4.5  # the paper's networks, which have more inputs and refine
COST_FIT = 0.5  # of a fit, without its steps
COST_COUNT = 0.4  # of each further count that a search builds
COST_SLOW = {"slic": 4.5, "greedy": 25.0, "splat-transform": 60.0}  # in addition
# For each step of the fit:
COST_STEP = 0.1  # per million pixels of its view
COST_DRAWN = 0.25  # per million Gaussians that it draws
THREAD_GAIN = 0.35  # speed of each thread after the first, relative to the first

# With placed views, per million Gaussians of the input:
COST_READ = 3.0  # of reading and scoring
COST_PLACED = 0.15  # of drawing a view
COST_PAIRS = 3.0  # of merging pairs, for each count that is tried
PLACED_PIXELS = 512 * 512  # largest number of pixels of a view
FITS = 2  # number of fits to placed views, for each count
TRIED = 5  # number of counts that are tried to keep the quality of the input
TRIED_BY_PHOTOS = 3  # number of counts that are tried if a quality decides on given views

# Memory, in bytes
BYTES_FIXED = 250_000_000  # interpreter and libraries
BYTES_PER_GAUSSIAN = 150
BYTES_PER_VALUE = 4.5  # for each value of higher harmonics: of the scene, and of some of its groups
BYTES_PER_PIXEL = 90  # the photo as floats, and arrays of segmentation and rendering
BYTES_ELSEWHERE = 40  # per Gaussian of the whole scene while a block of it is in memory


def work_seconds(
    pixels: int, view_pixels: float, options: Mapping[str, Any], *, fit_steps: int, num_drawn: float, tries: float = 1,
    short_steps: int = 0, short_drawn: Sequence[float] = (),
) -> float:  # fmt: skip
    """Estimate the processor seconds of compacting a scene, without imports.

    ``pixels``: pixels of all views together, or the number of Gaussians if that is larger. ``view_pixels``: pixels of
    one view. ``options``: all settings by flat name, with the checkpoint in use. ``num_drawn``: average number of
    Gaussians in a view of the fit. ``tries``: number of counts that are fitted. ``short_drawn``: average number of
    Gaussians in a view, for each count that a search fits to photos of half the size in ``short_steps``.
    """
    method, fits = options["method"], fit_of(options) == "full"
    work = COST_MERGE + COST_SCORE + COST_FIT * fits
    work += COST_SLOW.get(options["segmentation"] if method == "gsmerge" else method, 0.0)
    networks = COST_PAPER if "paper" in (options["recipe"], options["checkpoint"]) else COST_NETWORKS
    work += networks * (method == "gsmerge" and options["checkpoint"] != "none")
    work += COST_COUNT * (tries - 1 + len(short_drawn))
    step = COST_STEP * view_pixels + COST_DRAWN * num_drawn
    short = sum(COST_STEP * view_pixels / 4 + COST_DRAWN * drawn for drawn in short_drawn)
    return (pixels * work + tries * fit_steps * fits * step + short_steps * short) / 1e6


def wall_seconds(pixels: int, num_views: int, options: Mapping[str, Any], *, threads: int, **facts: Any) -> float:
    """Estimate the wall time of a run on ``threads`` threads with imports; further arguments: :func:`work_seconds`."""
    work = work_seconds(pixels, pixels / max(num_views, 1), options, **facts)
    return IMPORT_SECONDS + work / (1 + THREAD_GAIN * max(0, min(threads, num_views) - 1))


def placed_seconds(num_input: int, num_drawn: float, *, threads: int, fit_steps: int, views: int, tries: int) -> float:
    """Estimate the wall time, with imports, of merging pairs in a scene without views.

    ``num_drawn``: number of Gaussians in the result. ``fit_steps``: 0 without a fit. ``views``: number of placed views
    of the fit. ``tries``: number of counts that are tried.
    """
    step = COST_STEP * min(num_input, PLACED_PIXELS) + COST_DRAWN * num_drawn
    whole = num_input * (COST_READ + COST_PLACED * views * (fit_steps > 0))
    work = 1.0 + (whole + tries * (COST_PAIRS * num_input + FITS * fit_steps * step)) / 1e6
    return IMPORT_SECONDS + work / (1.0 if threads == 1 else 1.3)  # only a small part runs on several threads


def fit_of(options: Mapping[str, Any]) -> str:
    """Return the kind of fit that will run: ``"full"`` or ``"none"``."""
    return {"gsmerge": str(options["fit"]), "unmerged-fit": "full"}.get(options["method"], "none")


def memory_bytes(pixels: int, *, num_rest: int = 0, num_elsewhere: int = 0) -> int:
    """Estimate the memory of a run in bytes, imports included.

    ``pixels``: number of pixels or Gaussians of the scene, or of the block in memory. ``num_rest``: columns of higher
    harmonics. ``num_elsewhere``: number of Gaussians outside the block.
    """
    pixel_bytes = BYTES_PER_GAUSSIAN + BYTES_PER_VALUE * num_rest + BYTES_PER_PIXEL
    return BYTES_FIXED + round(pixel_bytes * pixels + BYTES_ELSEWHERE * num_elsewhere)


def memory_problem(needed: int) -> str | None:
    """Return why a run that needs ``needed`` bytes may not fit into this machine; None if it should fit."""
    available = machine_memory()
    if available is None or needed <= available:
        return None
    return (
        f"about {needed / 1e9:.1f} GB of memory are needed, and this machine has {available / 1e9:.1f} GB; use fewer"
        " views (gsmerge extend adds more later), export without higher harmonics, or try --effort draft"
    )
