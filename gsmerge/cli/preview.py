"""``gsmerge preview``: a contact sheet, before and after."""

from __future__ import annotations

from pathlib import Path

from gsmerge.cli import options as opt
from gsmerge.cli.console import announce_compilation, say_notes
from gsmerge.cli.paths import check_cameras, check_outputs, input_files, write_texts
from gsmerge.cli.pictures import report_pictures, write_picture
from gsmerge.errors import UsageError


@opt.command(
    opt.argument("scenes", list[Path], "SCENES...", "Gaussian .ply files: before, after, ..."),
    opt.READING,
    *opt.panel(opt.OUTPUT, opt.option("views", int, "Number of views at most.", default=4, min=1)),
    opt.output("The picture, .png, or a page with swipes, .html.", default=opt.REQUIRED),
    "overwrite dry_run threads",
)
def preview(args: opt.Args) -> None:
    """Put renders of several scenes from the same cameras side by side, with the photos where there are any."""
    hints, scenes = args.hints(), args.scenes
    from gsmerge.io import place_cameras_in_scene, ply_notes, read_gaussians, read_ply_with_hints
    from gsmerge.measure.preview import contact_sheet, view_pictures
    from gsmerge.runtime.threads import use_threads
    from gsmerge.views import pick_views

    files = args.files(scenes[0])
    check_outputs((args.output,), (*scenes, *input_files(files)), overwrite=args.overwrite or args.dry_run)
    suffix = args.output.suffix.lower()
    if suffix not in (".png", ".html"):
        raise UsageError(f"{args.output}: expected a name that ends in .png or .html")
    check_cameras(files)
    plys = [read_ply_with_hints(files.ply, opacity=args.opacity, hints=hints)]
    plys += [read_gaussians(path, opacity=args.opacity) for path in scenes[1:]]
    placed = place_cameras_in_scene(plys[0], files, hints=hints)
    used = list(placed.views.used)
    cameras, photos = placed.views.cameras[used], placed.views.images
    photos = None if photos is None else photos[used]
    notes_of = [placed.notes, *(ply_notes(ply.info) for ply in plys[1:])]
    notes = [f"{path}: {note}" for path, some in zip(scenes, notes_of, strict=True) for note in some]
    say_notes(notes, quiet=args.silent)
    if not args.dry_run:
        gaussians = [placed.gaussians, *(ply.gaussians for ply in plys[1:])]
        parts = [(path.name, some) for path, some in zip(scenes, gaussians, strict=True)]
        with use_threads(args.threads), announce_compilation(quiet=args.silent):
            pictures = view_pictures(parts, cameras, photos, max_views=args.views)
        if suffix == ".png":
            write_picture(args.output, contact_sheet(pictures), overwrite=args.overwrite)
        else:
            from gsmerge.view.report_page import pictures_page

            title = f"{scenes[0].name}: {len(scenes)} scene(s)"
            write_texts({args.output: pictures_page(title, pictures)}, overwrite=args.overwrite)
    ids = pick_views(len(cameras), args.views)
    facts = {
        "scenes": {str(path): ply.info.count for path, ply in zip(scenes, plys, strict=True)},
        "views": ids,
        "photos": photos is not None,
        "notes": notes,
    }
    report_pictures(args, [args.output], facts, f"{len(scenes)} scene(s) from {len(ids)} views")
