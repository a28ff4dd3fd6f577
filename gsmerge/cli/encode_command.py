"""``gsmerge encode``: a scene as Feature Gaussians in a file, to be decoded at any K without its images."""

from __future__ import annotations

from time import perf_counter

from gsmerge.cli import parameters as opt
from gsmerge.cli.console import print_document, say_notes, stage_progress
from gsmerge.cli.paths import check_outputs, checkpoint_files, input_files


@opt.command(
    opt.SCENE,
    opt.output("The encoded scene.", "SCENE.gsm"),
    f"{opt.READING} k max_k superpixels budget effort checkpoint set",
    f"overwrite dry_run {opt.RUN}",
)
def encode(args: opt.Args) -> None:
    """Store a scene as merged Feature Gaussians, from which gsmerge decode makes results of any size."""
    start = perf_counter()
    hints, settings = args.hints(), args.settings(fit="none")
    files = args.files(args.scene)
    out = args.output or files.base.with_suffix(".gsm")
    inputs = (*input_files(files), *checkpoint_files(settings.checkpoint))
    check_outputs((out,), inputs, overwrite=args.overwrite or args.dry_run)
    if args.dry_run:
        from gsmerge.cli.compact_command import print_plan

        print_plan(args, files, settings, out, hints)
        return
    from gsmerge.states.to_encoded import encode_files, encoding_line

    before = {"import": perf_counter() - start}
    with stage_progress(quiet=args.silent) as progress:
        document = encode_files(
            files, settings, out, max_k=args.max_k, opacity=args.opacity, hints=hints, overwrite=args.overwrite,
            progress=progress, seconds_before=before,
        )  # fmt: skip
    say_notes(document["notes"], quiet=args.silent)
    print_document(document, encoding_line(document), as_json=args.json, quiet=args.quiet)
