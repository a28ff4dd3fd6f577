"""State -> gaussians: decoded at any K or number, and fitted to the photos that the state has kept."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from gsmerge.encoded.decode import decode_scene, plan_decode
from gsmerge.encoded.encoded import Encoded
from gsmerge.errors import UsageError
from gsmerge.online.pictures import Shots
from gsmerge.online.state import OnlineState, as_encoded
from gsmerge.runtime.run_log import Progress, RunLog
from gsmerge.runtime.threads import use_threads
from gsmerge.stages.fit import FitOptions, FitReport, fit, start_share
from gsmerge.stages.prepare import Frame
from gsmerge.types import Gaussians


@dataclass(frozen=True)
class Decoded:
    """Gaussians of a state in the world frame, what the fit did (None without one), and sentences for the user."""

    gaussians: Gaussians
    fit: FitReport | None
    notes: tuple[str, ...]


def as_decoded(stored: Encoded | OnlineState, *, solved: bool = True) -> Encoded:
    """What is decoded: an encoded scene, which a state is turned into, see :func:`gsmerge.online.state.as_encoded`."""
    return stored if isinstance(stored, Encoded) else as_encoded(stored, solved=solved)


def num_photos(stored: Encoded | OnlineState) -> int:
    """Photos that a fit can look at."""
    return 0 if isinstance(stored, Encoded) else len(stored.replay)


def usual_fit(stored: Encoded | OnlineState) -> FitOptions:
    """The full fit where there are photos, otherwise none."""
    return FitOptions(fit="full" if num_photos(stored) else "none")


def check_fit(stored: Encoded | OnlineState, options: FitOptions) -> None:
    """Refuse a fit where no photos are.

    Raises:
        UsageError: If there are none and one is asked for.
    """
    if options.fit != "none" and not num_photos(stored):
        raise UsageError(f"fit {options.fit}: expected a state with photos, found none; extend one with photos")


def decode_stored(
    stored: Encoded | OnlineState,
    *,
    k: int | str | None = None,
    budget: int | str | None = None,
    options: FitOptions | None = None,
    seed: int = 0,
    threads: int | None = None,
    progress: Progress | None = None,
) -> Decoded:
    """A state as Gaussians in the world frame, fitted to the photos that it has kept; or an encoded scene.

    Args:
        stored: A state of one or more batches, or an encoded scene, which has no photos.
        k: As of :func:`gsmerge.decode_scene`.
        budget: As there. A full fit begins with fewer and grows to the number.
        options: Of the fit; None: the full one at its defaults where there are photos, otherwise none.
        seed: Everything random in the fit.
        threads: Threads to use; None: all processors.
        progress: As of :func:`gsmerge.compact`.

    Raises:
        UsageError: If a fit is asked for and no photos were kept, or K or the budget cannot be had.
    """
    options = options or usual_fit(stored)
    check_fit(stored, options)
    encoded = as_decoded(stored, solved=options.fit == "none")
    if options.fit == "none":
        notes = plan_decode(encoded, k=k, budget=budget).notes
        return Decoded(decode_scene(encoded, k=k, budget=budget, threads=threads), None, notes)
    assert isinstance(stored, OnlineState)
    log = RunLog(progress)
    plan = plan_decode(encoded, k=k, budget=budget)
    wanted = int(plan.counts.sum())
    begun = max(len(encoded), int(start_share(options) * wanted)) + encoded.num_kept
    plain = replace(encoded, frame=Frame(torch.zeros(3, dtype=torch.float64), 1.0))
    with use_threads(threads), torch.no_grad():
        gaussians = decode_scene(plain, budget=begun, threads=threads)
        images = stored.replay.images.astype(np.float32) / np.float32(255)
        shots = Shots(images, stored.cameras[torch.from_numpy(stored.replay.views)])
        with log.stage("fit"):
            fitted, report = fit(gaussians, (shots.photos(), shots.photos(2)), options, wanted, seed, log.fit_progress)
    if report is not None and not report.accepted:  # the colours that were solved batch by batch are better than none
        held = "the fit was not accepted: held-out parts of the photos did not get better"
        plain_colors = decode_scene(as_encoded(stored), k=k, budget=budget, threads=threads)
        return Decoded(plain_colors, report, (*plan.notes, held))
    return Decoded(stored.frame.leave(fitted), report, plan.notes)
