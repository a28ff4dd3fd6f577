"""``gsmerge preview``: a contact sheet, before and after."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from gsmerge.cli import options as opt
from gsmerge.cli.console import announce_compilation, say
from gsmerge.cli.paths import cameras_of, check_output
from gsmerge.cli.pictures import write_picture

if TYPE_CHECKING:
    from torch import Tensor

    from gsmerge.io import CameraFile, SceneFiles


def preview(
    scenes: Annotated[list[Path], typer.Argument(metavar="SCENES...", help="Gaussian .ply files: before, after, ...")],
    output: Annotated[Path, typer.Option("--output", "-o", help="The picture, .png.", rich_help_panel=opt.OUTPUT)],
    cameras: opt.CamerasOption = None,
    images: opt.ImagesOption = None,
    views: Annotated[int, typer.Option(min=1, help="Views at most.", rich_help_panel=opt.OUTPUT)] = 4,
    opacity: opt.OpacityOption = opt.Opacity.auto,
    threads: opt.ThreadsOption = None,
    overwrite: opt.OverwriteOption = False,
    quiet: opt.QuietOption = False,
    debug: opt.DebugOption = False,
) -> None:
    """Put renders of several scenes from the same cameras side by side, with the photos where there are any."""
    check_output(output, tuple(scenes), overwrite=overwrite)
    from gsmerge.io import find_scene_files, read_ply, to_cameras
    from gsmerge.preview import contact_sheet
    from gsmerge.threads import use_threads

    files = find_scene_files(scenes[0], cameras=cameras, images=images)
    camera_file = cameras_of(files)
    photos = _photos(files, camera_file)
    size = None if photos is None else (photos.shape[2], photos.shape[1])
    parts = [(path.name, read_ply(path, opacity=opacity.value).gaussians) for path in scenes]
    with use_threads(threads), announce_compilation(quiet=quiet):
        sheet = contact_sheet(parts, to_cameras(camera_file, size), photos, most_views=views)
    write_picture(output, sheet, overwrite=overwrite)
    say(f"{output}: {sheet.shape[1]} x {sheet.shape[0]} pixels", quiet=quiet)


def _photos(files: SceneFiles, camera_file: CameraFile) -> Tensor | None:
    """``[c,h,w,3]`` from the folder or the cameras' own file; None where there are none."""
    from gsmerge.io.images import as_tensor, read_images

    if files.images is not None and files.images.is_dir():
        return read_images(files.images, camera_file.names)
    return None if camera_file.images is None else as_tensor(camera_file.images)
