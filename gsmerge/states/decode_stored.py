"""State -> Gaussians, or a file of them: decoded at any K or number, and fitted to the stored photos."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from gsmerge.budget import FileSize, file_size
from gsmerge.compaction.file_size import drop_to_bytes
from gsmerge.errors import SceneError, UsageError
from gsmerge.facts.prepare import Frame
from gsmerge.fit import FitJob, FitOptions, FitReport, fit, report_steps, start_share
from gsmerge.fit.gpu import choose_backend
from gsmerge.io import atomic_output, lost_harmonics, output_format, write_gaussians
from gsmerge.io.formats.arrays import RESULT_COMMENT, copied_comments
from gsmerge.io.formats.table import PLY, count_for_bytes
from gsmerge.plan import resolve_fit
from gsmerge.report import document_head, human_bytes, seconds_document, seconds_line
from gsmerge.runtime.record import Progress, record_run, stage
from gsmerge.runtime.threads import use_threads
from gsmerge.settings.budget import BudgetOptions
from gsmerge.settings.compact import CompactOptions
from gsmerge.states.batch import BatchPhotos
from gsmerge.states.encoded import Encoded
from gsmerge.states.file import load_stored
from gsmerge.states.state import OnlineState, to_encoded
from gsmerge.states.to_gaussians import decode_scene, plan_decode
from gsmerge.types import Gaussians


@dataclass(frozen=True)
class DecodeResult:
    """Result of decoding: Gaussians in the world frame, report of the fit (None without a fit), and notes."""

    gaussians: Gaussians
    fit: FitReport | None
    notes: tuple[str, ...]


def decodable(stored: Encoded | OnlineState, *, fitted_colors: bool = True) -> Encoded:
    """Return an encoded scene unchanged, and a state converted to one; see :func:`gsmerge.states.state.to_encoded`."""
    return stored if isinstance(stored, Encoded) else to_encoded(stored, fitted_colors=fitted_colors)


def num_photos(stored: Encoded | OnlineState) -> int:
    """Return the number of stored photos, to which a fit is possible."""
    return 0 if isinstance(stored, Encoded) else len(stored.replay)


def check_fit(stored: Encoded | OnlineState, options: FitOptions) -> None:
    """Raise UsageError if a fit is asked for and no photos are stored."""
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
    """Decode an encoded scene, or a state, into Gaussians in the world frame; fit them to stored photos, if any.

    ``k`` and ``budget`` are those of :func:`gsmerge.decode_scene`; a full fit begins with fewer
    Gaussians and grows to the number. ``options`` of the fit: None: the full one at its defaults
    where there are photos, otherwise none. Raises UsageError if a fit is asked for and there are no
    photos, or K or the budget is out of range.
    """
    options = options or FitOptions(fit="full" if num_photos(stored) else "none")
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


def decode_file(
    path: Path,
    out: Path,
    settings: CompactOptions,
    *,
    k: int | None = None,
    budget: int | str | None = None,
    always_fit: bool = False,
    normals: bool = True,
    spz_version: int = 3,
    overwrite: bool = False,
    dry_run: bool = False,
    progress: Progress | None = None,
    seconds_before: Mapping[str, float] | None = None,
) -> dict[str, Any]:
    """Decode a ``.gsm`` file, write the Gaussians to a file, and return the report as plain JSON types.

    ``settings``: of the fit and the run; ``always_fit``: refuse a file without photos, which otherwise is not fitted.
    ``dry_run``: write nothing. Other arguments and errors are those of :func:`decode_stored` and
    :func:`gsmerge.compaction.files.compact_files`.
    """
    start, stored = perf_counter(), load_stored(path)
    lost, read = lost_harmonics(out, stored.sh_degree, spz_version), perf_counter()
    notes = [lost] if lost else []
    fit_options = resolve_fit(settings) if always_fit or num_photos(stored) else FitOptions(fit="none")
    check_fit(stored, fit_options)
    size = _file_size(budget, out, spz_version)
    count = budget if size is None else count_for_bytes(size.file, size.num_bytes, stored.sh_degree)
    document: dict[str, Any] = {
        **document_head(),
        "input": {
            "path": str(path), "bytes": path.stat().st_size, "num_groups": len(stored),
            "num_gaussians_encoded": stored.settings.num_input, "encoding": dict(stored.about),
        },
        "k": k,
        "budget": budget,
    }  # fmt: skip
    if dry_run:
        encoded = decodable(stored)
        plan = plan_decode(encoded, k=k, budget=count)
        most = int(plan.counts.sum()) + encoded.num_kept
        output = {"dry_run": True, "output": {"path": str(out), "num_gaussians_at_most": most}}
        return document | output | {"notes": [*plan.notes, *notes]}
    with atomic_output(out, overwrite=overwrite) as temporary:
        decoded = decode_stored(
            stored, k=k, budget=count, options=fit_options, seed=settings.seed, threads=settings.threads,
            device=settings.device, progress=progress,
        )  # fmt: skip
        gaussians, done = decoded.gaussians, perf_counter()
        if size is not None and size.file is not PLY:
            gaussians = drop_to_bytes(gaussians, [], size.num_bytes, size.file)
        if len(gaussians) == 0:
            raise SceneError(path, "expected visible Gaussians, found none", "encode the scene again")
        if not all(np.isfinite(getattr(gaussians, name)).all() for name in ("means", "scales", "quats")):
            raise SceneError(path, "expected Gaussians of finite numbers, found others", "encode the scene again")
        write_gaussians(
            temporary, gaussians, overwrite=True, comments=_comments(stored), ending=output_format(out).ending,
            normals=normals, spz_version=spz_version,
        )  # fmt: skip
    seconds = {**(seconds_before or {}), "read": read - start, "decode": done - read, "write": perf_counter() - done}
    return document | {
        "output": {"path": str(out), "bytes": out.stat().st_size, "num_gaussians": len(gaussians)},
        "ratio": len(gaussians) / max(stored.settings.num_input, 1),
        "fit": decoded.fit and decoded.fit.to_dict(),
        **seconds_document(seconds),
        "notes": [*decoded.notes, *notes],
    }


def _file_size(budget: int | str | None, out: Path, spz_version: int) -> FileSize | None:
    """Return the size in bytes that a budget asks for; None of another one."""
    try:
        return None if budget is None else file_size(BudgetOptions(budget, output=out.name, spz_version=spz_version))
    except ValueError as error:
        raise UsageError(str(error)) from error


def _comments(stored: Encoded | OnlineState) -> list[str]:
    """Return the lines of the header: that of a result, and those of the file that was encoded, as compact does."""
    texts = stored.about.get("source", {}).get("comments")
    return [RESULT_COMMENT, *copied_comments(texts if isinstance(texts, list) else ())]


def decoding_line(document: Mapping[str, Any]) -> str:
    """Describe the report of a decoding in one line."""
    before, after = document["input"], document["output"]
    if "dry_run" in document:
        return f"would write  {after['path']}: at most {after['num_gaussians_at_most']:,} Gaussians"
    return (
        f"{after['path']}: {before['num_groups']:,} groups -> {after['num_gaussians']:,} Gaussians"
        f" ({100 * document['ratio']:.2f} % of the scene's), {human_bytes(before['bytes'])} ->"
        f" {human_bytes(after['bytes'])}; {seconds_line(document)}"
    )
