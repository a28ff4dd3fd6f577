"""State -> Gaussians: decoded at any K or number, and fitted to the stored photos."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gsmerge.encoded.encoded import Encoded
from gsmerge.encoded.to_gaussians import decode_scene, plan_decode
from gsmerge.errors import UsageError
from gsmerge.facts.prepare import Frame
from gsmerge.fit import FitJob, FitOptions, FitReport, fit, report_steps, start_share
from gsmerge.fit.gpu import choose_backend
from gsmerge.online.batch_photos import BatchPhotos
from gsmerge.online.state import OnlineState, to_encoded
from gsmerge.runtime.record import Progress, record_run, stage
from gsmerge.runtime.threads import use_threads
from gsmerge.types import Gaussians


@dataclass(frozen=True)
class DecodeResult:
    """Gaussians of a state in the world frame, a report of the fit (None without one), and notes."""

    gaussians: Gaussians
    fit: FitReport | None
    notes: tuple[str, ...]


def decodable(stored: Encoded | OnlineState, *, fitted_colors: bool = True) -> Encoded:
    """What is decoded: the encoded scene, or the state as one, see :func:`gsmerge.online.state.to_encoded`."""
    return stored if isinstance(stored, Encoded) else to_encoded(stored, fitted_colors=fitted_colors)


def num_photos(stored: Encoded | OnlineState) -> int:
    """Return the number of photos that a fit can use."""
    return 0 if isinstance(stored, Encoded) else len(stored.replay)


def default_fit(stored: Encoded | OnlineState) -> FitOptions:
    """Return the options of the full fit where there are photos, otherwise of none."""
    return FitOptions(fit="full" if num_photos(stored) else "none")


def check_fit(stored: Encoded | OnlineState, options: FitOptions) -> None:
    """Refuse a fit without photos."""
    if options.fit != "none" and not num_photos(stored):
        raise UsageError(f"fit {options.fit}: expected a state with photos, found none; extend one with photos")


def decode_stored(
    stored: Encoded | OnlineState,
    *,
    k: int | None = None,
    budget: int | str | None = None,
    options: FitOptions | None = None,
    seed: int = 0,
    threads: int | None = None,
    device: str = "cpu",
    progress: Progress | None = None,
) -> DecodeResult:
    """Decode a state, fitted to its photos, or an encoded scene, into Gaussians in the world frame.

    ``k`` and ``budget`` are those of :func:`gsmerge.decode_scene`; a full fit begins with fewer
    Gaussians and grows to the number. ``options`` of the fit: None: the full one at its defaults
    where there are photos, otherwise none. Raises UsageError if a fit is asked for and there are no
    photos, or K or the budget is out of range.
    """
    options = options or default_fit(stored)
    check_fit(stored, options)
    encoded = decodable(stored, fitted_colors=options.fit == "none")
    plan = plan_decode(encoded, k=k, budget=budget)
    if options.fit == "none":
        return DecodeResult(decode_scene(encoded, k=k, budget=budget, threads=threads), None, plan.notes)
    assert isinstance(stored, OnlineState)
    notes = plan.notes
    if options.photo_scale not in ("auto", 1):
        notes = *notes, f"photo_scale {options.photo_scale:g} is 1: a state stores its photos at the size of its views"
    max_count = int(plan.counts.sum())
    start_count = max(len(encoded), int(start_share(options) * max_count)) + encoded.num_kept
    canonical = replace(encoded, frame=Frame(np.zeros(3), 1.0))
    with use_threads(threads), record_run(progress) as record:
        gaussians = decode_scene(canonical, budget=start_count, threads=threads)
        images = stored.replay.images.astype(np.float32) / np.float32(255)
        replay = BatchPhotos(images, stored.cameras[stored.replay.views])
        photos = replay.photos(), replay.photos(2)
        num_pixels = len(photos[0]) * photos[0].height * photos[0].width
        backend, problem = choose_backend(device, num_pixels)
        with stage("fit"):
            job = FitJob(photos, options, max_count, seed, report_steps)
            gaussians, report = fit(gaussians, job, backend)
    notes = *notes, *([] if problem is None else [problem]), *record.notes
    if report is not None and not report.accepted:  # then the colours that were fitted batch by batch are better
        note = "the fit was not accepted: held-out parts of the photos did not get better"
        gaussians = decode_scene(to_encoded(stored), k=k, budget=budget, threads=threads)
        return DecodeResult(gaussians, report, (*notes, note))
    return DecodeResult(stored.frame.leave(gaussians), report, notes)
