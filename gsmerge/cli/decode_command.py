"""``gsmerge decode``: a compact scene from an encoded one, or from a state of views."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Any

from gsmerge.cli import parameters as opt
from gsmerge.cli.console import print_document, say_notes, stage_progress
from gsmerge.cli.paths import FileOptions, check_format, check_outputs, default_output
from gsmerge.errors import SceneError


@opt.command(
    opt.argument("encoded", Path, "ENCODED", "A .gsm file of gsmerge encode or extend."),
    opt.changed("k", help="Gaussians per group, up to what was encoded.", show_default="as encoded"),
    opt.changed("budget", help="Gaussians in the result: a number, a share of the input such as 2%, a size such as "
                "5MB; at least one per group. auto: as many as compact takes without photos."),
    opt.changed("fit", help="What is fitted to the photos that a state has kept.",
                show_default="full where there are photos"),
    "effort device set",
    opt.output(opt.COMPACT_SCENE, "ENCODED.compact.ply"),
    f"overwrite dry_run {opt.RUN}",
)  # fmt: skip
def decode(args: opt.Args) -> None:
    """Write a compact scene from an encoded one, or from a state of gsmerge extend, fitted to its photos."""
    start = perf_counter()
    out = args.output or default_output(args.encoded)
    check_outputs((out,), (args.encoded,), overwrite=args.overwrite or args.dry_run)
    import numpy as np

    from gsmerge.encoded.to_gaussians import plan_decode
    from gsmerge.fit import FitOptions
    from gsmerge.io import atomic_output, lost_harmonics, output_format, write_gaussians
    from gsmerge.online.decode_stored import check_fit, decodable, decode_stored, default_fit, num_photos
    from gsmerge.online.file import load_stored
    from gsmerge.plan import resolve_fit
    from gsmerge.report import document_head, seconds_document
    from gsmerge.settings.compact import CompactOptions

    wanted, writing = args.make(FitOptions, FileOptions, viewer_cameras=False)  # a .gsm has no names of views
    check_format(out, writing)
    run = args.given(("effort", "device", "seed", "threads"))
    with opt.usage_errors():
        settings = replace(CompactOptions(fit=wanted), **run)
    imported, path = perf_counter(), args.encoded
    count = {"k": args.k, "budget": args.budget}
    stored = load_stored(path)
    lost, read = lost_harmonics(out, stored.sh_degree, writing.spz_version), perf_counter()
    document: dict[str, Any] = {
        **document_head(),
        "input": {
            "path": str(path), "bytes": path.stat().st_size, "num_groups": len(stored),
            "num_gaussians_encoded": stored.settings.num_input, "encoding": dict(stored.about),
        },
        **count,
    }  # fmt: skip
    notes = [lost] if lost else []
    fit = resolve_fit(settings) if args.fit is not None or num_photos(stored) else default_fit(stored)
    check_fit(stored, fit)
    if args.dry_run:
        encoded = decodable(stored)
        plan = plan_decode(encoded, **count)
        most = int(plan.counts.sum()) + encoded.num_kept
        output = {"dry_run": True, "output": {"path": str(out), "num_gaussians_at_most": most}}
        document |= output | {"notes": [*plan.notes, *notes]}
        say_notes(document["notes"], quiet=args.silent)
        print_document(document, f"would write  {out}: at most {most:,} Gaussians", as_json=args.json)
        return
    with atomic_output(out, overwrite=args.overwrite) as temporary:
        with stage_progress(quiet=args.silent) as progress:
            decoded = decode_stored(
                stored, **count, options=fit, seed=settings.seed, threads=settings.threads, device=settings.device,
                progress=progress,
            )  # fmt: skip
        if len(decoded.gaussians) == 0:
            raise SceneError(path, "expected visible Gaussians, found none", "encode the scene again")
        if not all(np.isfinite(getattr(decoded.gaussians, name)).all() for name in ("means", "scales", "quats")):
            raise SceneError(path, "expected Gaussians of finite numbers, found others", "encode the scene again")
        done, ending = perf_counter(), output_format(out)
        source = stored.about.get("source")
        texts = source.get("comments") if isinstance(source, dict) else None
        lines = [line for line in texts if isinstance(line, str)] if isinstance(texts, list) else []
        comments = [line for line in lines if line.isascii() and line.isprintable()]  # compact copies them too
        write_gaussians(
            temporary, decoded.gaussians, overwrite=True, comments=comments, ending=ending,
            normals=writing.normals, spz_version=writing.spz_version,
        )  # fmt: skip
    seconds = {"import": imported - start, "read": read - imported, "decode": done - read}
    seconds["write"] = perf_counter() - done
    document |= {
        "output": {"path": str(out), "bytes": out.stat().st_size, "num_gaussians": len(decoded.gaussians)},
        "ratio": len(decoded.gaussians) / max(stored.settings.num_input, 1),
        "fit": decoded.fit and decoded.fit.to_dict(),
        **seconds_document(seconds),
        "notes": [*decoded.notes, *notes],
    }
    say_notes(document["notes"], quiet=args.silent)
    print_document(document, _summary(document), as_json=args.json, quiet=args.quiet)


def _summary(document: Mapping[str, Any]) -> str:
    """Write the line that the command ends with."""
    from gsmerge.report import human_bytes, seconds_line

    before, after = document["input"], document["output"]
    return (
        f"{after['path']}: {before['num_groups']:,} groups -> {after['num_gaussians']:,} Gaussians"
        f" ({100 * document['ratio']:.2f} % of the scene's), {human_bytes(before['bytes'])} ->"
        f" {human_bytes(after['bytes'])}; {seconds_line(document)}"
    )
