"""``gsmerge preview``: a contact sheet, before and after."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gsmerge.cli import options as opt
from gsmerge.cli.console import announce_compilation, say_notes
from gsmerge.cli.paths import check_cameras, check_output, check_picture, input_files
from gsmerge.cli.pictures import tell_pictures, write_picture
from gsmerge.cli.settings import reading_of


def preview(
    scenes: Annotated[list[Path], typer.Argument(metavar="SCENES...", help="Gaussian .ply files: before, after, ...")],
    output: Annotated[Path, typer.Option("--output", "-o", help="The picture, .png.", rich_help_panel=opt.OUTPUT)],
    cameras: opt.CamerasOption = None,
    images: opt.ImagesOption = None,
    views: Annotated[int, typer.Option(min=1, help="Views at most.", rich_help_panel=opt.OUTPUT)] = 4,
    opacity: opt.OpacityOption = opt.Opacity.auto,
    exporter: opt.DialectOption = "auto",
    quats: opt.QuatsOption = opt.Quats.auto,
    order: opt.OrderOption = opt.Order.auto,
    scene_scale: opt.SceneScaleOption = None,
    max_side: opt.MaxSideOption = None,
    threads: opt.ThreadsOption = None,
    overwrite: opt.OverwriteOption = False,
    json: opt.JsonOption = False,
    dry_run: opt.DryRunOption = False,
    quiet: opt.QuietOption = False,
    debug: opt.DebugOption = False,
) -> None:
    """Put renders of several scenes from the same cameras side by side, with the photos where there are any."""
    hints = reading_of(exporter, quats.value, order.value, scene_scale, max_side)
    from gsmerge.io import find_scene_files, place_cameras_in_scene, ply_notes, read_ply, read_ply_with_hints
    from gsmerge.measure.preview import contact_sheet
    from gsmerge.runtime.threads import use_threads
    from gsmerge.views import pick_views

    files = find_scene_files(scenes[0], cameras=cameras, images=images)
    check_output(output, (*scenes, *input_files(files)), overwrite=overwrite)
    check_picture(output)
    check_cameras(files)
    plys = [read_ply_with_hints(files.ply, opacity=opacity.value, hints=hints)]
    plys += [read_ply(path, opacity=opacity.value) for path in scenes[1:]]
    placed = place_cameras_in_scene(plys[0], files, hints=hints)
    used = list(placed.views.used)
    seen_from, photos = placed.views.cameras[used], placed.views.images
    photos = None if photos is None else photos[used]
    said = [placed.notes, *(ply_notes(ply.info) for ply in plys[1:])]
    notes = [f"{path}: {note}" for path, some in zip(scenes, said, strict=True) for note in some]
    say_notes(notes, quiet=quiet or json)
    if not dry_run:
        shown = [placed.gaussians, *(ply.gaussians for ply in plys[1:])]
        parts = [(path.name, gaussians) for path, gaussians in zip(scenes, shown, strict=True)]
        with use_threads(threads), announce_compilation(quiet=quiet or json):
            sheet = contact_sheet(parts, seen_from, photos, max_views=views)
        write_picture(output, sheet, overwrite=overwrite)
    ids = pick_views(len(seen_from), views)
    facts = {
        "scenes": {str(path): ply.info.count for path, ply in zip(scenes, plys, strict=True)},
        "views": ids,
        "photos": photos is not None,
        "notes": notes,
    }
    line = f"{len(scenes)} scene(s) from {len(ids)} views"
    tell_pictures(output, [output], facts, line, dry_run=dry_run, as_json=json, quiet=quiet)
