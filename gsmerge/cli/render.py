"""``gsmerge render``: pictures of any Gaussian scene."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from gsmerge.cli import options as opt
from gsmerge.cli.console import announce_compilation, say_notes, stage_progress
from gsmerge.cli.paths import check_cameras, check_folder, input_files, source_of
from gsmerge.cli.pictures import picture_stems, tell_pictures, write_picture

MAX_SIDE = 1 << 20  # pixels: pictures have the cameras' own size

if TYPE_CHECKING:
    from gsmerge.io import CamerasInScene, PlyScene, SceneFiles
    from gsmerge.types import Cameras, Gaussians


def render(
    scene: Annotated[Path, typer.Argument(metavar="SCENE", help="A Gaussian .ply of any kind, or its folder.")],
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder for the pictures.", rich_help_panel=opt.OUTPUT)
    ],
    cameras: opt.CamerasOption = None,
    frame_of: Annotated[
        Path | None,
        typer.Option(
            metavar="PLY",
            help="The .ply whose frame the cameras are moved into; default: SCENE, or what it was compacted from.",
            rich_help_panel=opt.INPUT,
        ),
    ] = None,
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
    from gsmerge.io import find_scene_files, read_ply

    files = find_scene_files(scene, cameras=cameras)
    source = frame_of or source_of(files.ply)
    like = files if source is None else find_scene_files(source, cameras=cameras or files.cameras)
    check_folder(output, (*input_files(files), *input_files(like)), overwrite=overwrite)
    check_cameras(like)
    ply = read_ply(files.ply, opacity=opacity.value)
    placed = _placed(ply, like)
    views, notes = placed.views.cameras, placed.notes
    pictures = [output / f"{stem}.png" for stem in picture_stems(placed.views.names)]
    say_notes(notes, quiet=quiet or json)
    if not dry_run:
        look = {"background": background, "antialiased": antialiased}
        parts = placed.gaussians, views, pictures
        _write_renders(*parts, look, threads=threads, overwrite=overwrite, quiet=quiet or json)
    facts = {"width": views.width, "height": views.height, "num_gaussians": ply.info.count, "notes": notes}
    line = f"{len(views)} pictures of {views.width} x {views.height}"
    tell_pictures(output, pictures, facts, line, dry_run=dry_run, as_json=json, quiet=quiet)


def _placed(ply: PlyScene, like: SceneFiles) -> CamerasInScene:
    """The Gaussians, and the cameras as they stand for the scene of ``like``."""
    from gsmerge.io import ReadHints, place_cameras_in_scene, ply_notes, read_ply

    hints = ReadHints(max_side=MAX_SIDE)
    if str(like.ply) == ply.info.path:
        return place_cameras_in_scene(ply, like, hints=hints, photos=False)
    placed = place_cameras_in_scene(read_ply(like.ply), like, hints=hints, photos=False)
    return replace(placed, gaussians=ply.gaussians, notes=(*ply_notes(ply.info), *placed.notes))


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
    from gsmerge.measure.preview import to_picture
    from gsmerge.render import render as render_views
    from gsmerge.runtime.threads import use_threads

    with use_threads(threads) as count, announce_compilation(quiet=quiet), stage_progress(quiet=quiet) as progress:
        for first in range(0, len(views), count):
            some = slice(first, first + count)
            for path, image in zip(pictures[some], render_views(gaussians, views[some], **look).images, strict=True):
                write_picture(path, to_picture(image), overwrite=overwrite)
            if progress is not None:
                progress("render", min(first + count, len(views)), len(views))
