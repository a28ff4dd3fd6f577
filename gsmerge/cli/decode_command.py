"""``gsmerge decode``: a compact scene from an encoded one, or from a state of views."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from time import perf_counter

from gsmerge.cli import parameters as opt
from gsmerge.cli.console import print_document, say_notes, stage_progress
from gsmerge.cli.paths import FileOptions, check_format, check_outputs, default_output


@opt.command(
    opt.argument("encoded", Path, "ENCODED", "A .gsm file of gsmerge encode or extend."),
    opt.changed("k", help="Gaussians per group, up to what was encoded.", show_default="as encoded"),
    opt.changed("budget", help="Gaussians in the result: a number, a share of the input such as 2%, a size such as "
                "5MB; at least one per group. auto: up to the knee of the superpixels' distortion."),
    opt.changed("fit", help="What is fitted to the photos that a state has kept.",
                show_default="full where there are photos"),
    "effort device",
    opt.changed("set", help="Any other setting of the fit or of the written file, such as normals=false; may be "
                "repeated."),
    opt.output(opt.COMPACT_SCENE, "ENCODED.compact.ply"),
    f"overwrite dry_run {opt.RUN}",
)  # fmt: skip
def decode(args: opt.Args) -> None:
    """Write a compact scene from an encoded one, or from a state of gsmerge extend, fitted to its photos."""
    start = perf_counter()
    out = args.output or default_output(args.encoded)
    check_outputs((out,), (args.encoded,), overwrite=args.overwrite or args.dry_run)
    from gsmerge.fit import FitOptions
    from gsmerge.settings.compact import CompactOptions
    from gsmerge.states.decode_stored import decode_file, decoding_line

    wanted, writing = args.make(FitOptions, FileOptions, viewer_cameras=False)  # a .gsm has no names of views
    check_format(out, writing)
    run = args.given(("effort", "device", "seed", "threads"))
    with opt.usage_errors():
        settings = replace(CompactOptions(fit=wanted), **run)
    before = {"import": perf_counter() - start}
    with stage_progress(quiet=args.silent) as progress:
        document = decode_file(
            args.encoded, out, settings, k=args.k, budget=args.budget, always_fit=args.fit is not None,
            normals=writing.normals, spz_version=writing.spz_version, overwrite=args.overwrite,
            dry_run=args.dry_run, progress=progress, seconds_before=before,
        )  # fmt: skip
    say_notes(document["notes"], quiet=args.silent)
    print_document(document, decoding_line(document), as_json=args.json, quiet=args.quiet and not args.dry_run)
