"""``gsmerge inspect``: what is recognised in a scene's files."""

from __future__ import annotations

from gsmerge.cli import options as opt
from gsmerge.cli.console import print_document


@opt.command(opt.SCENE, opt.READING)
def inspect(args: opt.Args) -> None:
    """Say what a scene holds: layout, count, bytes, cameras, images, and whether the pixels line up."""
    hints = args.hints()
    from gsmerge.measure.inspect import inspect as inspect_scene
    from gsmerge.measure.inspection_lines import inspection_lines
    from gsmerge.report import document_head

    facts = inspect_scene(
        args.scene, cameras=args.cameras, images=args.images, opacity=args.opacity, **vars(hints)
    ).to_dict()
    lines = inspection_lines(facts)
    print_document({**document_head(), **facts}, lines, as_json=args.json, quiet=args.quiet, wrap=True)
