"""``gsmerge segment``: pictures of the superpixels."""

from __future__ import annotations

from collections.abc import Sequence

from gsmerge.cli import options as opt
from gsmerge.cli.console import announce_compilation, say_notes
from gsmerge.cli.paths import check_folder, input_files
from gsmerge.cli.pictures import picture_stems, report_pictures, write_picture

KINDS = ("borders", "means", "saliency")


@opt.command(
    opt.SCENE,
    "cameras images opacity exporter quats order scene_scale superpixels",
    opt.changed("segmentation", hidden=False),
    opt.output("Folder for the pictures.", default=opt.REQUIRED),
    "overwrite dry_run threads",
)
def segment(args: opt.Args) -> None:
    """Draw the superpixels of every view: their borders, their mean colours, and the saliency that seeds them."""
    from gsmerge.measure.preview import draw_borders, draw_heat, draw_means
    from gsmerge.render.photos import scene_pictures
    from gsmerge.runtime.threads import use_threads
    from gsmerge.stages.superpixels import SegmentOptions, count_for, saliency
    from gsmerge.stages.superpixels import segment as segment_images

    with opt.usage_errors():
        options = SegmentOptions(**args.given(SegmentOptions.__dataclass_fields__))
    files = args.files(args.scene)
    check_folder(args.output, input_files(files), overwrite=args.overwrite)
    load = args.load(files)
    scene = load.pixel_scene()
    per_view = count_for(options, scene.cameras.height, scene.cameras.width)
    say_notes(load.notes, quiet=args.silent)
    stems = picture_stems(scene.names)
    pictures = [args.output / f"{stem}.{kind}.png" for stem in stems for kind in KINDS]
    counts: Sequence[int] = [per_view] * len(stems)
    if not args.dry_run:
        with use_threads(args.threads), announce_compilation(quiet=args.silent):
            images, paths = scene_pictures(scene), iter(pictures)
            groups = segment_images(images, options)
            counts = groups.counts
            for image, labels in zip(images, groups.labels, strict=True):
                for drawn in (draw_borders(image, labels), draw_means(image, labels), draw_heat(saliency(image))):
                    write_picture(next(paths), drawn, overwrite=args.overwrite)
    facts = {"superpixels": counts, "options": vars(options), "notes": load.notes}
    line = f"{len(pictures)} pictures, {min(counts)} to {max(counts)} superpixels per view"
    report_pictures(args, pictures, facts, line)
