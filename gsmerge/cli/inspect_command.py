"""``gsmerge inspect``: what a scene's files hold, and what compact would make of them."""

from __future__ import annotations

from gsmerge.cli import parameters as opt
from gsmerge.cli.console import print_document, stage_progress


@opt.command(opt.SCENE, opt.READING, "masks threads")
def inspect(args: opt.Args) -> None:
    """Say what a scene holds, whether its pixels line up, and what compact would make of it."""
    hints = args.hints()
    from gsmerge.compaction.inspect import inspect as inspect_scene
    from gsmerge.compaction.inspect import inspection_lines
    from gsmerge.report import document_head
    from gsmerge.runtime.record import record_run

    places = {"cameras": args.cameras, "images": args.images, "masks": args.masks}
    with stage_progress(quiet=args.silent) as progress, record_run(progress):
        facts = inspect_scene(args.scene, **places, opacity=args.opacity, threads=args.threads, **vars(hints))
    document, lines = {**document_head(), **facts}, inspection_lines(facts)
    print_document(document, lines, as_json=args.json, quiet=args.quiet)
