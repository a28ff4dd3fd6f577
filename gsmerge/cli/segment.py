"""``gsmerge segment``: pictures of the superpixels."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from gsmerge.cli import options as opt
from gsmerge.cli.console import announce_compilation, say
from gsmerge.cli.paths import check_folder
from gsmerge.cli.pictures import write_picture
from gsmerge.cli.settings import superpixels_per_view, told_as_usage


def segment(
    scene: opt.SceneArgument,
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder for the pictures.", rich_help_panel=opt.OUTPUT)
    ],
    superpixels: opt.SuperpixelsOption = None,
    density: opt.DensityOption = None,
    method: opt.MethodOption = None,
    preset: opt.PresetOption = None,
    cameras: opt.CamerasOption = None,
    images: opt.ImagesOption = None,
    threads: opt.ThreadsOption = None,
    overwrite: opt.OverwriteOption = False,
    quiet: opt.QuietOption = False,
    debug: opt.DebugOption = False,
) -> None:
    """Draw the superpixels of every view: their borders, their mean colours, and the saliency that seeds them."""
    check_folder(output, overwrite=overwrite)
    from gsmerge import preview
    from gsmerge.io import read_scene
    from gsmerge.segment import SegmentOptions, saliency
    from gsmerge.segment import segment as segment_images
    from gsmerge.threads import use_threads

    chosen: dict[str, Any] = {"superpixels": superpixels, "density": density}
    chosen |= {"method": method and method.value, "preset": preset and preset.value}
    with told_as_usage():
        options = SegmentOptions(**{name: value for name, value in chosen.items() if value is not None})
    pixel_scene = read_scene(scene, cameras=cameras, images=images)
    superpixels_per_view(options, pixel_scene.cameras.width, pixel_scene.cameras.height)
    pictures = preview.view_pictures(pixel_scene)
    with use_threads(threads), announce_compilation(quiet=quiet):
        groups = segment_images(pictures, options)
    for view, name in enumerate(pixel_scene.names):
        image, labels = pictures[view], groups.labels[view]
        drawn = {
            "borders": preview.draw_borders(image, labels),
            "means": preview.draw_means(image, labels),
            "saliency": preview.draw_heat(saliency(image)),
        }
        for kind, picture in drawn.items():
            write_picture(output / f"{Path(name).stem}.{kind}.png", picture, overwrite=overwrite)
    counts = groups.counts
    say(f"{output}: {3 * len(counts)} pictures, {min(counts)} to {max(counts)} superpixels per view", quiet=quiet)
