"""``gsmerge convert``: convert, join, crop and transform Gaussians, without merging or fitting."""

from pathlib import Path
from typing import Annotated

from gsmerge.cli import parameters as opt
from gsmerge.cli.console import print_document, say, say_notes, stage_progress
from gsmerge.cli.paths import check_outputs, output_file
from gsmerge.errors import UsageError
from gsmerge.settings.files import FileOptions, PlacementOptions
from gsmerge.settings.stages import CleanOptions

SETTINGS = (FileOptions, CleanOptions, PlacementOptions)


def convert(
    paths: Annotated[list[Path], opt.argument("IN... OUT", "Files or folders of Gaussians, such as a .ply, .spz or "
        ".sog. Several files in one coordinate frame are joined. Without -o the last path is the output. Its name sets "
        "the format, also .html (a page to send), lod-meta.json, or a folder.")],
    output: Annotated[Path | None, opt.output("The output, instead of the last path.")] = None,
    cameras: Annotated[opt.Parsed | None, opt.option(opt.INPUT, "PATH", "Cameras in the frame of the first file; they "
        "are transformed as well. Default: the cameras inside a result or beside it; none: without.",
        read=opt.path_or_none)] = None,
    images: Annotated[opt.Parsed | None, opt.option(opt.INPUT, "PATH", "Folder of the photos of the cameras, which "
        "--drop sky needs.", read=opt.path_or_none)] = None,
    hint: Annotated[list[str] | None, opt.option(opt.INPUT, "NAME=VALUE", "How the files store opacity, scales and "
        "colours, if it is not recognised: opacity=logit or raw, scales=log or linear, colors=sh or rgb.")] = None,
    set: Annotated[list[str] | None, opt.settings_option(SETTINGS, example="normals=false")] = None,
    up: opt.Up = None, scale: opt.Scale = None, rotate: opt.Rotate = None, translate: opt.Translate = None,
    sh_degree: opt.ShDegree = None, crop: opt.Crop = None, drop: opt.Drop = None, overwrite: opt.Overwrite = False,
    threads: opt.OwnThreads = None, json: opt.Json = False, progress: opt.Progress = None,
    quiet: opt.Quiet = False,
) -> None:  # fmt: skip
    """Write Gaussians in another format, frame or extent, without merging or fitting them."""
    given = opt.read_settings(
        SETTINGS, set, up=up, scale=scale, rotate=rotate, translate=translate, sh_degree=sh_degree, crop=crop, drop=drop
    )
    *inputs, output = paths if output is None else (*paths, output)
    if not inputs:
        remedy = f"name the output last, as in gsmerge convert {output} x.spz"
        raise UsageError(f"expected files to read and one to write, got only {output}; {remedy}")
    from gsmerge.reading.scene_files import find_plys

    inputs = [file for path in inputs for file in (find_plys(path) if path.is_dir() else [path])]
    writing, cleaning, placement = given.make(*SETTINGS)
    named = [path for path in (cameras, images) if isinstance(path, Path)]
    from gsmerge.results.outputs import name_outputs

    outputs = name_outputs(output_file(output, inputs[0].name), writing, overwrite=overwrite)
    check_outputs(outputs.paths, (*inputs, *named), overwrite=overwrite)
    from gsmerge.io.formats.table import estimate_counts
    from gsmerge.jobs.convert import ConvertOptions, conversion_line, convert_files
    from gsmerge.runtime.memory import conversion_bytes, memory_problem
    from gsmerge.runtime.record import record_run

    remedy = "a .ply takes least, and parts of the scene can be converted one by one"
    if problem := memory_problem(conversion_bytes(*estimate_counts(inputs)), remedy):
        say(problem, kind="warning", quiet=quiet or json)
    reading = opt.read_hints(hint)
    hints = reading.hints
    options = ConvertOptions(
        inputs, outputs, cameras=cameras, images=images, opacity=reading.opacity, scales=hints.scales,
        colors=hints.colors, clean=cleaning, placement=placement,
    )  # fmt: skip
    with stage_progress(quiet=quiet or json) as on_step, record_run(on_step):
        document = convert_files(options)
    say_notes(document["notes"], quiet=quiet or json)
    print_document(document, conversion_line(document), as_json=json, quiet=quiet)
