"""``gsmerge convert``: convert, join, crop and transform Gaussians, without merging or fitting."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from gsmerge.cli import parameters as opt
from gsmerge.cli.console import print_document, say, say_notes, stage_progress
from gsmerge.cli.paths import check_outputs, output_file
from gsmerge.errors import UsageError
from gsmerge.settings.files import FileOptions
from gsmerge.settings.placement import PlacementOptions
from gsmerge.settings.setting import Settings, setting
from gsmerge.settings.stages import CleanOptions


@dataclass(frozen=True)
class PhotoOptions(Settings):
    """Photos that a conversion reads."""

    images: str | None = setting(None, "Folder of the photos of the cameras, which `--drop sky` needs.")


@opt.command(
    opt.argument("paths", list[Path], "IN... OUT",
                 "Files or folders of Gaussians, such as a .ply, .spz or .sog. Several files in one coordinate frame "
                 "are joined. The last path is the output, and its name sets the format, also .html (a page to send), "
                 "lod-meta.json, or a folder."),
    opt.change_option("cameras", help="Cameras in the frame of the first file; they are transformed as well. Default: "
                "the cameras inside a result or beside it; none: without."),
    opt.change_option("hint", help="How the files store opacity, scales and colours, if it is not recognised: "
                "opacity=logit or raw, scales=log or linear, colors=sh or rgb."),
    opt.settings_option(FileOptions, PhotoOptions, CleanOptions, PlacementOptions, example="normals=false"),
    "up scale rotate translate sh_degree crop drop overwrite",
)  # fmt: skip
def convert(args: opt.Args) -> None:
    """Write Gaussians in another format, frame or extent, without merging or fitting them."""
    *inputs, output = args.paths
    if not inputs:
        remedy = f"name the output last, as in gsmerge convert {output} x.spz"
        raise UsageError(f"expected files to read and one to write, got only {output}; {remedy}")
    from gsmerge.io.scene_files import find_plys

    inputs = [file for path in inputs for file in (find_plys(path) if path.is_dir() else [path])]
    writing, photos, cleaning, placement = args.make(FileOptions, PhotoOptions, CleanOptions, PlacementOptions)
    images = None if photos.images is None else opt.named_or_none(photos.images)
    named = [path for path in (args.cameras, images) if isinstance(path, Path)]
    from gsmerge.compaction.outputs import name_outputs

    outputs = name_outputs(output_file(output, inputs[0].name), writing, overwrite=args.overwrite)
    check_outputs(outputs.paths, (*inputs, *named), overwrite=args.overwrite)
    from gsmerge.compaction.convert import ConvertOptions, conversion_line, convert_files
    from gsmerge.io.formats.table import estimate_counts
    from gsmerge.runtime.memory import conversion_bytes, memory_problem
    from gsmerge.runtime.record import record_run

    remedy = "a .ply takes least, and parts of the scene can be converted one by one"
    if problem := memory_problem(conversion_bytes(*estimate_counts(inputs)), remedy):
        say(problem, kind="warning", quiet=args.silent)
    hints = args.hints()
    options = ConvertOptions(
        inputs, outputs, args.cameras, images, args.opacity, hints.scales, hints.colors, cleaning, placement,
    )  # fmt: skip
    with stage_progress(quiet=args.silent) as progress, record_run(progress):
        document = convert_files(options)
    say_notes(document["notes"], quiet=args.silent)
    print_document(document, conversion_line(document), as_json=args.json, quiet=args.quiet)
