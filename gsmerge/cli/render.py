"""``gsmerge render``: pictures of any Gaussian scene."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from gsmerge.cli import options as opt
from gsmerge.cli.console import announce_compilation, say_notes, stage_progress
from gsmerge.cli.paths import cameras_of, check_folder, input_files
from gsmerge.cli.pictures import picture_stems, tell_pictures, write_picture

if TYPE_CHECKING:
    from gsmerge.types import Cameras, Gaussians


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
    json: opt.JsonOption = False,
    dry_run: opt.DryRunOption = False,
    quiet: opt.QuietOption = False,
    debug: opt.DebugOption = False,
) -> None:
    """Render a scene from every camera, one PNG each."""
    from gsmerge.io import find_scene_files, ply_notes, read_ply, to_cameras

    files = find_scene_files(scene, cameras=cameras)
    check_folder(output, input_files(files), overwrite=overwrite)
    camera_file = cameras_of(files)
    views = to_cameras(camera_file)
    pictures = [output / f"{stem}.png" for stem in picture_stems(camera_file.names)]
    ply = read_ply(files.ply, opacity=opacity.value)
    notes = ply_notes(ply.info)
    say_notes(notes, quiet=quiet or json)
    if not dry_run:
        look = {"background": background, "antialiased": antialiased}
        _write_renders(ply.gaussians, views, pictures, look, threads=threads, overwrite=overwrite, quiet=quiet or json)
    facts = {"width": views.width, "height": views.height, "num_gaussians": ply.info.count, "notes": notes}
    line = f"{len(views)} pictures of {views.width} x {views.height}"
    tell_pictures(output, pictures, facts, line, dry_run=dry_run, as_json=json, quiet=quiet)


def _write_renders(
    gaussians: Gaussians,
    views: Cameras,
    pictures: Sequence[Path],
    look: Mapping[str, Any],
    *,
    threads: int | None,
    overwrite: bool,
    quiet: bool,
) -> None:
    """Render and write, as many views at once as there are threads, which keeps the memory low."""
    from gsmerge.preview import to_picture
    from gsmerge.render import render as render_views
    from gsmerge.threads import use_threads

    with use_threads(threads) as count, announce_compilation(quiet=quiet), stage_progress(quiet=quiet) as progress:
        for first in range(0, len(views), count):
            some = slice(first, first + count)
            for path, image in zip(pictures[some], render_views(gaussians, views[some], **look).images, strict=True):
                write_picture(path, to_picture(image), overwrite=overwrite)
            if progress is not None:
                progress("render", min(first + count, len(views)), len(views))
