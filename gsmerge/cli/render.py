"""``gsmerge render``: pictures of any Gaussian scene."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gsmerge.cli import options as opt
from gsmerge.cli.console import announce_compilation, say, stage_progress
from gsmerge.cli.paths import cameras_of, check_folder
from gsmerge.cli.pictures import write_picture


def render(
    scene: Annotated[Path, typer.Argument(metavar="SCENE", help="A Gaussian .ply of any kind, or its folder.")],
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder for the pictures.", rich_help_panel=opt.OUTPUT)
    ],
    cameras: opt.CamerasOption = None,
    background: Annotated[
        float, typer.Option(min=0.0, max=1.0, help="Grey level behind the scene.", rich_help_panel=opt.OUTPUT)
    ] = 0.0,
    antialiased: Annotated[
        bool,
        typer.Option("--antialiased", help="Keep small Gaussians' energy (Mip-Splatting).", rich_help_panel=opt.OUTPUT),
    ] = False,
    opacity: opt.OpacityOption = opt.Opacity.auto,
    threads: opt.ThreadsOption = None,
    overwrite: opt.OverwriteOption = False,
    quiet: opt.QuietOption = False,
    debug: opt.DebugOption = False,
) -> None:
    """Render a scene from every camera, one PNG each."""
    check_folder(output, overwrite=overwrite)
    from gsmerge.io import find_scene_files, read_ply, to_cameras
    from gsmerge.preview import to_picture
    from gsmerge.render import render as render_views
    from gsmerge.threads import use_threads

    files = find_scene_files(scene, cameras=cameras)
    camera_file = cameras_of(files)
    views, names = to_cameras(camera_file), camera_file.names
    gaussians = read_ply(files.ply, opacity=opacity.value).gaussians
    with use_threads(threads) as count, announce_compilation(quiet=quiet), stage_progress(quiet=quiet) as progress:
        for first in range(0, len(views), count):  # as many at once as there are threads keeps the memory low
            some = slice(first, first + count)
            images = render_views(gaussians, views[some], background, antialiased=antialiased).images
            for name, image in zip(names[some], images, strict=True):
                write_picture(output / f"{Path(name).stem}.png", to_picture(image), overwrite=overwrite)
            if progress is not None:
                progress("render", min(first + count, len(views)), len(views))
    say(f"{output}: {len(views)} pictures of {views.width} x {views.height}", quiet=quiet)
