"""``gsmerge convert``: convert, join, crop and transform Gaussians, without merging or fitting."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from gsmerge.cli import parameters as opt
from gsmerge.cli.console import print_document, say_notes, stage_progress
from gsmerge.cli.paths import FileOptions, check_format, check_outputs, files_beside, output_file
from gsmerge.errors import UsageError
from gsmerge.settings.placement import PlacementOptions
from gsmerge.settings.setting import Settings, setting
from gsmerge.settings.stages import CleanOptions


@dataclass(frozen=True)
class PhotoOptions(Settings):
    """Photos that a conversion reads."""

    images: str | None = setting(None, "Folder of the photos of the cameras. `--drop sky` needs it, and a COLMAP model "
        "links it. For a model, a folder `images` beside the cameras is found without this setting.",
        metavar="PATH")  # fmt: skip


@opt.command(
    opt.argument("paths", list[Path], "IN... OUT",
                 "Files or folders of Gaussians: .ply, .compressed.ply, .spz, .sog, .splat, .glb, lod-meta.json, "
                 ".ksplat, meta.json, .lcc or .lcc2. Several files in one coordinate frame are joined. The last path "
                 "is the output, and its name sets the format: .ply, .spz, .sog, .splat, .glb, .usdc, .usdz, .html (a "
                 "page to send), lod-meta.json, a folder, or a folder named colmap. Or a .gsm of gsmerge extend, and "
                 "a .npz for the arrays of its Feature Gaussians."),
    opt.changed("cameras", help="Cameras in the frame of the first file; they are transformed as well. Default: "
                "the cameras inside a result or beside it; none: without."),
    opt.changed("hint", help="How the files store opacity and scales, if it is not recognised: opacity=logit or "
                "raw, scales=log or linear."),
    opt.settings_option(FileOptions, PhotoOptions, CleanOptions, PlacementOptions, example="normals=false"),
    "up scale rotate translate sh_degree crop drop overwrite",
)  # fmt: skip
def convert(args: opt.Args) -> None:
    """Write Gaussians in another format, frame or extent, without merging or fitting them."""
    *inputs, output = args.paths
    if not inputs:
        remedy = f"name the output last, as in gsmerge convert {output} x.spz"
        raise UsageError(f"expected files to read and one to write, got only {output}; {remedy}")
    if output.suffix.lower() == ".npz":
        _convert_features(args, inputs, output)
        return
    from gsmerge.scene.files import find_plys

    inputs = [file for path in inputs for file in (find_plys(path) if path.is_dir() else [path])]
    writing, photos, cleaning, placement = args.make(FileOptions, PhotoOptions, CleanOptions, PlacementOptions)
    images = None if photos.images is None else opt.named_or_none(photos.images)
    named = [path for path in (args.cameras, images) if isinstance(path, Path)]
    output = output_file(output, inputs[0].name, site=writing.site)
    check_outputs((output, *files_beside(output, site=writing.site)), (*inputs, *named), overwrite=args.overwrite)
    check_format(output, writing)
    from gsmerge.compaction.convert import ConvertOptions, conversion_line, convert_files
    from gsmerge.runtime.record import record_run

    options = ConvertOptions(
        inputs, output, args.cameras, images, args.opacity, args.hints().scales, cleaning, placement,
        normals=writing.normals, full_columns=writing.columns == "full",
        site=writing.site, overwrite=args.overwrite,
    )  # fmt: skip
    with stage_progress(quiet=args.silent) as progress, record_run(progress):
        document = convert_files(options)
    say_notes(document["notes"], quiet=args.silent)
    print_document(document, conversion_line(document), as_json=args.json, quiet=args.quiet)


def _convert_features(args: opt.Args, inputs: list[Path], output: Path) -> None:
    """Write the Feature Gaussians of a ``.gsm`` as arrays."""
    from gsmerge.io.formats.table import STATE_ENDING

    path = inputs[0]
    if len(inputs) > 1 or path.suffix.lower() != STATE_ENDING:
        raise UsageError(f"{output}: expected one {STATE_ENDING} of Feature Gaussians to write as arrays, got {path}")
    args.require_scene(("paths", "overwrite", "json", "quiet"), path)
    from gsmerge.states.files import arrays_line, convert_features

    check_outputs((output,), (path,), overwrite=args.overwrite)
    document = convert_features(path, output, overwrite=args.overwrite)
    print_document(document, arrays_line(document), as_json=args.json, quiet=args.quiet)
