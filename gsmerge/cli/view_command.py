"""``gsmerge view``: show a scene and its compact versions on one page, in stills and in 3D."""

import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from gsmerge.cli import parameters as opt
from gsmerge.cli.before_after import read_before_after
from gsmerge.cli.console import print_document, say, say_notes, stage_progress
from gsmerge.cli.paths import check_outputs, input_files, write_texts

if TYPE_CHECKING:
    from gsmerge.reading.read_scene import Loaded
    from gsmerge.reading.scene_files import SceneFiles


def view(
    before: opt.Before,
    after: opt.After = None,
    cameras: opt.Cameras = None, images: opt.Images = None, hint: opt.Hint = None, masks: opt.Masks = None,
    targets: opt.Targets = None,
    output: Annotated[Path | None, opt.output("The page, .html.", "AFTER.compare.html, or BEFORE.view.html, "
        "beside it, replaced if gsmerge made it")] = None,
    light: Annotated[bool, opt.option(opt.OUTPUT, "", "Show BEFORE only in pictures, and AFTER in 3D; the page has a "
        "third of the size.", "--light")] = False,
    open: Annotated[bool, opt.option(opt.OUTPUT, "", "Open the page in the browser.", "--open/--no-open",
        default="open")] = True,
    overwrite: opt.Overwrite = False, threads: opt.OwnThreads = None, json: opt.Json = False,
    progress: opt.Progress = None, quiet: opt.Quiet = False,
) -> None:  # fmt: skip
    """Show a scene, alone or beside its compact versions, in the browser: photos, stills, 3D and scores in one file."""
    from gsmerge.reading.scene_files import find_scene_files

    files = find_scene_files(before, cameras=cameras, images=images, masks=masks)
    reading = opt.read_hints(hint)
    show_page(
        files, after or [], output, reading, targets=targets, light=light, open=open, overwrite=overwrite, json=json,
        quiet=quiet,
    )  # fmt: skip


def show_page(
    files: "SceneFiles", after: list[Path], output: Path | None = None, reading: opt.Reading = opt.Reading(), *, loaded:
    "Loaded | None" = None, changes: Sequence[str] = (), targets: Path | None = None, light: bool = False, open: bool =
    True, overwrite: bool = False, json: bool = False, quiet: bool = False,
) -> None:  # fmt: skip
    """Make the page of a scene, which may be ``loaded`` already, and of its compact versions; open it if ``open``.

    ``changes`` says what a run did to photos, cameras and Gaussians before it merged them.
    """
    from gsmerge.drawing.pages.data import collect_page_data
    from gsmerge.drawing.pages.page import headline, speed, speed_words, view_page
    from gsmerge.drawing.pages.view import check_page_name, file_new_views
    from gsmerge.io.atomic import common_mode
    from gsmerge.runtime.documents import document_head, note_entries

    silent = quiet or json
    default = after[0].with_name(f"{after[0].stem}.compare.html") if after else files.base.with_suffix(".view.html")
    shown = [path for path in (*input_files(files), *after, targets) if path is not None]
    check_outputs((output or default,), shown, overwrite=overwrite, reports=output is None)
    output = output or default
    check_page_name(output)
    mode = common_mode(shown)
    with stage_progress(quiet=silent) as progress:
        progress("read", 0, 0)
        pair = read_before_after(files, after, reading, loaded=loaded, targets=targets)
        say_notes(pair.notes, quiet=silent)
        sizes = [pair.load.info.file_bytes, *(ply.info.file_bytes for ply in pair.plys.values())]
        data = collect_page_data(
            pair.title, pair.scene, pair.gaussians, sizes, pair.held_out, cameras=pair.cameras,
            new_views=file_new_views(pair.plys), changes=changes, light=light, progress=progress,
        )  # fmt: skip
    page = view_page(data)
    write_texts({output: page}, mode)
    say_notes(data.notes, quiet=silent)
    summary = headline(data) + speed_words(speed(data)).replace("\u00a0", " ")
    notes = [*pair.notes, *data.notes]
    document = {
        **document_head(),
        "output": str(output),
        **note_entries(notes),
        "bytes": len(page),
        "headline": summary,
    }
    print_document(document, f"{output}: {summary}", as_json=json, quiet=quiet)
    if open:
        import webbrowser

        # Nothing is opened without a screen, because a text browser would take over the terminal
        has_screen = not sys.platform.startswith("linux") or {"DISPLAY", "WAYLAND_DISPLAY"} & set(os.environ)
        address = output.absolute().as_uri()
        if not (has_screen and webbrowser.open(address)):
            say(f"open {address} in a browser", quiet=silent)
