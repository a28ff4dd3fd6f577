"""``gsmerge render``: pictures of any Gaussian scene."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from gsmerge.cli import options as opt
from gsmerge.cli.console import announce_compilation, say_notes, stage_progress
from gsmerge.cli.paths import check_cameras, check_folder, input_files, source_of
from gsmerge.cli.pictures import picture_stems, report_pictures, write_picture

MAX_SIDE = 1 << 20  # pixels: pictures have the cameras' own size

if TYPE_CHECKING:
    from gsmerge.io import CamerasInScene, PlyScene, SceneFiles


@opt.command(
    opt.argument("scene", Path, "SCENE", "A Gaussian .ply of any kind, or its folder."),
    "cameras",
    *opt.panel(
        opt.INPUT,
        opt.option("frame_of", Path, "The .ply whose frame the cameras are moved into. Default: SCENE, or the scene it "
                   "was compacted from.", metavar="PLY"),
    ),
    "opacity",
    *opt.panel(
        opt.OUTPUT,
        opt.option("background", float, "Grey level behind the scene.", default=0.0, min=0.0, max=1.0),
    ),
    opt.output("Folder for the pictures.", default=opt.REQUIRED),
    "antialiased overwrite dry_run threads",
)  # fmt: skip
def render(args: opt.Args) -> None:
    """Render a scene from every camera, one PNG each."""
    from gsmerge.io import find_scene_files, read_gaussians
    from gsmerge.measure.preview import to_picture
    from gsmerge.render import render as render_views
    from gsmerge.runtime.threads import use_threads

    files = args.files(args.scene)
    source = args.frame_of or source_of(files.ply)
    like = files if source is None else find_scene_files(source, cameras=args.cameras or files.cameras)
    check_folder(args.output, (*input_files(files), *input_files(like)), overwrite=args.overwrite or args.dry_run)
    check_cameras(like)
    ply = read_gaussians(files.ply, opacity=args.opacity)
    placed = _place(ply, like)
    views, notes = placed.views.cameras, placed.notes
    pictures = [args.output / f"{stem}.png" for stem in picture_stems(placed.views.names)]
    say_notes(notes, quiet=args.silent)
    if not args.dry_run:
        with (
            use_threads(args.threads) as count,
            announce_compilation(quiet=args.silent),
            stage_progress(quiet=args.silent) as progress,
        ):
            for first in range(0, len(views), count):  # as many views at once as threads, which keeps the memory low
                some = slice(first, first + count)
                renders = render_views(
                    placed.gaussians, views[some], background=args.background, antialiased=args.antialiased
                ).images
                for path, image in zip(pictures[some], renders, strict=True):
                    write_picture(path, to_picture(image), overwrite=args.overwrite)
                progress("render", min(first + count, len(views)), len(views))
    facts = {"width": views.width, "height": views.height, "num_gaussians": ply.info.count, "notes": notes}
    report_pictures(args, pictures, facts, f"{len(views)} pictures of {views.width} x {views.height}")


def _place(ply: PlyScene, like: SceneFiles) -> CamerasInScene:
    """The Gaussians, and the cameras in the frame of the scene ``like``."""
    from gsmerge.io import ReadHints, place_cameras_in_scene, ply_notes, read_gaussians

    hints = ReadHints(max_side=MAX_SIDE)
    if str(like.ply) == ply.info.path:
        return place_cameras_in_scene(ply, like, hints=hints, photos=False)
    placed = place_cameras_in_scene(read_gaussians(like.ply), like, hints=hints, photos=False)
    return replace(placed, gaussians=ply.gaussians, notes=(*ply_notes(ply.info), *placed.notes))
