"""``gsmerge segment``: pictures of the superpixels."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from gsmerge.cli import options as opt
from gsmerge.cli.console import announce_compilation, say_notes
from gsmerge.cli.paths import check_folder, input_files
from gsmerge.cli.pictures import picture_stems, tell_pictures, write_picture
from gsmerge.cli.settings import reading_of, told_as_usage

if TYPE_CHECKING:
    from gsmerge.stages.segment import SegmentOptions
    from gsmerge.types import PixelScene

KINDS = ("borders", "means", "saliency")


def segment(
    scene: opt.SceneArgument,
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder for the pictures.", rich_help_panel=opt.OUTPUT)
    ],
    superpixels: opt.SuperpixelsOption = None,
    density: opt.DensityOption = None,
    segmentation: opt.SegmentationOption = None,
    effort: opt.EffortOption = None,
    cameras: opt.CamerasOption = None,
    images: opt.ImagesOption = None,
    opacity: opt.OpacityOption = opt.Opacity.auto,
    exporter: opt.DialectOption = "auto",
    quats: opt.QuatsOption = opt.Quats.auto,
    order: opt.OrderOption = opt.Order.auto,
    scene_scale: opt.SceneScaleOption = None,
    threads: opt.ThreadsOption = None,
    overwrite: opt.OverwriteOption = False,
    json: opt.JsonOption = False,
    dry_run: opt.DryRunOption = False,
    quiet: opt.QuietOption = False,
    debug: opt.DebugOption = False,
) -> None:
    """Draw the superpixels of every view: their borders, their mean colours, and the saliency that seeds them."""
    hints = reading_of(exporter, quats.value, order.value, scene_scale)
    from gsmerge.io import find_scene_files, load_files
    from gsmerge.runtime.threads import use_threads
    from gsmerge.stages.segment import SegmentOptions, count_for

    chosen: dict[str, Any] = {"superpixels": superpixels, "density": density}
    chosen |= {"segmentation": segmentation and segmentation.value, "effort": effort and effort.value}
    with told_as_usage():
        options = SegmentOptions(**{name: value for name, value in chosen.items() if value is not None})
    files = find_scene_files(scene, cameras=cameras, images=images)
    check_folder(output, input_files(files), overwrite=overwrite)
    loaded = load_files(files, opacity=opacity.value, hints=hints)
    pixel_scene = loaded.pixel_scene()
    per_view = count_for(options, pixel_scene.cameras.height, pixel_scene.cameras.width)
    say_notes(loaded.notes, quiet=quiet or json)
    stems = picture_stems(pixel_scene.names)
    pictures = [output / f"{stem}.{kind}.png" for stem in stems for kind in KINDS]
    counts: Sequence[int] = [per_view] * len(stems)
    if not dry_run:
        with use_threads(threads), announce_compilation(quiet=quiet or json):
            counts = _write_overlays(pixel_scene, options, pictures, overwrite=overwrite)
    facts = {"superpixels": counts, "options": vars(options), "notes": loaded.notes}
    line = f"{len(pictures)} pictures, {min(counts)} to {max(counts)} superpixels per view"
    tell_pictures(output, pictures, facts, line, dry_run=dry_run, as_json=json, quiet=quiet)


def _write_overlays(
    scene: PixelScene, options: SegmentOptions, pictures: Sequence[Path], *, overwrite: bool
) -> Sequence[int]:
    """Segment and draw; returns the number of superpixels of every view."""
    from gsmerge.measure.preview import draw_borders, draw_heat, draw_means
    from gsmerge.render.photos import scene_pictures
    from gsmerge.stages.segment import saliency
    from gsmerge.stages.segment import segment as segment_images

    images = scene_pictures(scene)
    groups = segment_images(images, options)
    paths = iter(pictures)
    for image, labels in zip(images, groups.labels, strict=True):
        for drawn in (draw_borders(image, labels), draw_means(image, labels), draw_heat(saliency(image))):
            write_picture(next(paths), drawn, overwrite=overwrite)
    return groups.counts
