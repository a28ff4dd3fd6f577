"""``gsmerge view``: a scene and its compact versions as one page, in stills and in 3D."""

from __future__ import annotations

import os
import sys
from pathlib import Path

from gsmerge.cli import parameters as opt
from gsmerge.cli.before_after import read_before_after
from gsmerge.cli.console import print_document, say, say_notes, stage_progress
from gsmerge.cli.paths import check_outputs, input_files, write_texts
from gsmerge.errors import UsageError


@opt.command(
    opt.BEFORE,
    opt.AFTER,
    f"{opt.READING} masks {opt.TARGETS}",
    opt.changed("set", help="How the outlined superpixels are cut, where results were made with another than the "
                "default, such as superpixels=2%; may be repeated."),
    opt.output("The page, .html.", wording="AFTER.compare.html, or BEFORE.view.html, beside it"),
    *opt.panel(opt.OUTPUT, opt.option("open", bool, "Open the page in the browser.", "--open/--no-open", default=True)),
    "overwrite dry_run threads",
)  # fmt: skip
def view(args: opt.Args) -> None:
    """Show a scene, alone or beside its compact versions, in the browser: photos, stills, 3D, scores in one file."""
    from gsmerge.report import document_head
    from gsmerge.settings.stages import SegmentOptions
    from gsmerge.stages.superpixels import count_for

    (segmentation,) = args.make(SegmentOptions)
    args.after = args.after or []
    files, after = args.files(args.before), args.after
    beside = after[0].with_name(f"{after[0].stem}.compare.html") if after else files.base.with_suffix(".view.html")
    output = args.output or beside
    inputs = (*input_files(files), *after, args.targets, args.target_images)
    check_outputs((output,), inputs, overwrite=args.overwrite or args.dry_run)
    if output.suffix.lower() not in (".html", ".htm"):
        raise UsageError(f"{output}: expected a name that ends in .html")
    with stage_progress(quiet=args.silent) as progress:
        progress("read", 0, 0)
        pair = read_before_after(args, files)
    size = pair.scene.cameras.height, pair.scene.cameras.width
    count_for(segmentation, *size)  # refuses more superpixels than pixels, before anything is measured
    say_notes(pair.notes, quiet=args.silent)
    document = {**document_head(), "output": str(output), "dry_run": args.dry_run, "notes": pair.notes}
    if args.dry_run:
        print_document(document, f"would write {output}", as_json=args.json)
        return
    from gsmerge.pages.data import collect
    from gsmerge.pages.page import headline, view_page

    sizes = [pair.load.info.file_bytes, *(ply.info.file_bytes for ply in pair.plys.values())]
    with stage_progress(quiet=args.silent) as progress:
        data = collect(
            pair.title, pair.scene, pair.gaussians, sizes, pair.held_out, cameras=pair.cameras,
            segmentation=segmentation, threads=args.threads, progress=progress,
        )  # fmt: skip
    page = view_page(data)
    write_texts({output: page}, overwrite=args.overwrite)
    say_notes(data.notes, quiet=args.silent)
    said = headline(data)
    document |= {"bytes": len(page), "headline": said, "notes": [*pair.notes, *data.notes]}
    print_document(document, f"{output}: {said}", as_json=args.json, quiet=args.quiet)
    if args.open and not _open(output):
        say(f"open {output.absolute().as_uri()} in a browser", quiet=args.silent)


def _open(page: Path) -> bool:
    """Open a page in the browser; False without a screen, where a text browser would occupy the terminal."""
    if sys.platform.startswith("linux") and not {"DISPLAY", "WAYLAND_DISPLAY"} & set(os.environ):
        return False
    import webbrowser

    return webbrowser.open(page.absolute().as_uri())
