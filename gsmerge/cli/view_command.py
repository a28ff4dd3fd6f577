"""``gsmerge view``: show a scene and its compact versions on one page, in stills and in 3D."""

from __future__ import annotations

import os
import sys
from pathlib import Path

from gsmerge.cli import parameters as opt
from gsmerge.cli.before_after import read_before_after
from gsmerge.cli.console import print_document, say, say_notes, stage_progress
from gsmerge.cli.paths import check_outputs, input_files, write_texts


@opt.command(
    opt.BEFORE,
    opt.AFTER,
    f"{opt.READING} masks targets",
    opt.output("The page, .html. A page that gsmerge made is replaced.",
               wording="AFTER.compare.html, or BEFORE.view.html, beside it"),
    *opt.panel(
        opt.OUTPUT_GROUP,
        opt.switch("light", "Show BEFORE only in pictures, and AFTER in 3D; the page has a third of the size."),
    ),
    "open",
)  # fmt: skip
def view(args: opt.Args) -> None:
    """Show a scene, alone or beside its compact versions, in the browser: photos, stills, 3D and scores in one file."""
    from gsmerge.io.atomic import common_mode
    from gsmerge.measure.documents import document_head, note_entries
    from gsmerge.pages.data import collect_page_data
    from gsmerge.pages.page import headline, speed, speed_words, view_page
    from gsmerge.pages.view import check_page_name, file_gains

    args.after = args.after or []
    files, after = args.files(args.before), args.after
    default = after[0].with_name(f"{after[0].stem}.compare.html") if after else files.base.with_suffix(".view.html")
    output = args.output or default
    shown = [path for path in (*input_files(files), *after, args.targets) if path is not None]
    check_outputs((output,), shown, reports=True)
    check_page_name(output)
    mode = common_mode(shown)
    with stage_progress(quiet=args.silent) as progress:
        progress("read", 0, 0)
        pair = read_before_after(args, files)
        say_notes(pair.notes, quiet=args.silent)
        sizes = [pair.load.info.file_bytes, *(ply.info.file_bytes for ply in pair.plys.values())]
        data = collect_page_data(
            pair.title, pair.scene, pair.gaussians, sizes, pair.held_out, cameras=pair.cameras,
            new_gains=file_gains(pair.plys), light=args.light, progress=progress,
        )  # fmt: skip
    page = view_page(data)
    write_texts({output: page}, mode)
    say_notes(data.notes, quiet=args.silent)
    summary = headline(data) + speed_words(speed(data)).replace("\u00a0", " ")
    notes = [*pair.notes, *data.notes]
    document = {
        **document_head(),
        "output": str(output),
        **note_entries(notes),
        "bytes": len(page),
        "headline": summary,
    }
    print_document(document, f"{output}: {summary}", as_json=args.json, quiet=args.quiet)
    if args.open and not _open(output):
        say(f"open {output.absolute().as_uri()} in a browser", quiet=args.silent)


def _open(page: Path) -> bool:
    """Open a page in the browser, and return whether that worked.

    Nothing is opened without a screen, because a text browser would take over the terminal.
    """
    if sys.platform.startswith("linux") and not {"DISPLAY", "WAYLAND_DISPLAY"} & set(os.environ):
        return False
    import webbrowser

    return webbrowser.open(page.absolute().as_uri())
