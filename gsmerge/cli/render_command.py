"""``gsmerge render``: pictures of scenes from their cameras, and clips along paths."""

from __future__ import annotations

import re
from pathlib import Path

import typer

from gsmerge.cli import parameters as opt
from gsmerge.cli.console import print_document, say_notes, stage_progress
from gsmerge.cli.paths import check_folder, check_outputs, input_files
from gsmerge.errors import UsageError
from gsmerge.settings.reading import NONE

MAX_SIDE = 1 << 20  # pixels: pictures have the cameras' own size
PICTURES, CLIPS = (".png", ".jpg", ".jpeg", ".webp"), (".mp4", ".webm", ".gif")
ALPHA_CLIP = ".webm"  # the one kind of clip that has alpha
SIDES = (16, 16384)  # pixels of a picture


def parse_size(text: str) -> tuple[int, int]:
    """Parse ``--size``: a width and a height with an x between."""
    match = re.fullmatch(r"(\d{1,5})[xX](\d{1,5})", text)
    size = (int(match[1]), int(match[2])) if match else (0, 0)
    if not all(SIDES[0] <= side <= SIDES[1] for side in size):
        raise typer.BadParameter(f"expected WIDTHxHEIGHT, such as 1920x1080, {SIDES[0]} to {SIDES[1]} pixels each")
    return size


def parse_background(text: str) -> float | str:
    """Parse ``--background``: a grey level, or "none"."""
    if text.lower() == NONE:
        return NONE
    try:
        level = float(text)
    except ValueError:
        level = -1
    if not 0 <= level <= 1:
        raise typer.BadParameter("expected a grey level, 0 to 1, or none")
    return level


@opt.command(
    opt.argument("scenes", list[Path], "SCENES...", "Gaussian files, the first may be a folder: before, after, ..."),
    opt.READING,
    opt.output("A panel of photos and scenes, .png or .jpg; a clip, .mp4, .webm or .gif, in which a line moves between "
               "two scenes; or a folder for a picture of each camera.", default=opt.REQUIRED),
    *opt.panel(
        opt.OUTPUT,
        opt.option("path", str, "The way of the camera: orbit about the middle view, or orbit:45 by 45 degrees to each "
                   "side; turntable, once about the scene's middle; spline through all views; each with ,back:0.5 for "
                   "half of the depth farther back; or a camera for each frame in a file.",
                   wording="orbit, none for a folder", metavar="orbit|turntable|spline|FILE"),
        opt.option("size", str, "Width and height in pixels, on a panel of each picture; views of another shape lose "
                   "two borders.", wording="the cameras', of a GIF at most 640",
                   metavar="WIDTHxHEIGHT", parser=parse_size),
        opt.option("frames", int, "Frames of a clip, 30 a second, or 12.5 of a GIF.",
                   wording="6 seconds of a turntable, else 4", min=2, max=100_000),
        opt.option("views", int, "Views at most, at equal intervals.", wording="4 on a panel, else all", min=1),
        opt.option("overlay", ("support",), "Colour what one view of the scene alone shows, and what none does: "
                   "yellow, red."),
        opt.option("background", str, "Grey level behind the scene, 0 to 1; none: nothing, a .webm or pictures in a "
                   "folder have alpha.", wording="0", metavar="LEVEL|none", parser=parse_background),
        opt.option("channel", ("color", "alpha", "depth"), "What the pictures in a folder show: colour, opacity, or "
                   "depth in 16 bits, 0 where nothing is; --json has their unit.", wording="color"),
    ),
    "overwrite",
)  # fmt: skip
def render(args: opt.Args) -> None:
    """Draw scenes: a clip with before and after, a panel beside the photos, or a picture for each camera."""
    kind = _choose_kind(args)
    from gsmerge.measure import drawings
    from gsmerge.measure.camera_path import parse_path
    from gsmerge.report import document_head

    files = args.files(args.scenes[0])
    like = drawings.frame_files(files, args.cameras, args.images)
    inputs = (*args.scenes, *input_files(files), *input_files(like))
    if args.path is not None and parse_path(args.path) is None:  # of a file
        inputs = (*inputs, Path(args.path))
    if args.output.suffix.lower() in (*PICTURES, *CLIPS):
        read = [path for path in inputs if path not in args.scenes or not path.is_dir()]  # photos in it may not be
        check_outputs((args.output,), (*read, files.images), overwrite=args.overwrite)
    else:
        check_folder(args.output, inputs, overwrite=args.overwrite)
    hints = args.hints(max_side=MAX_SIDE) if kind == "views" else args.hints()
    arguments = args.given(("views", "path", "frames", "size", "overlay", "background", "channel"))
    drawing = drawings.DRAWINGS[kind](
        drawings.DrawOptions(files, args.scenes, like, args.output, args.opacity, hints, **arguments)
    )
    document = {**document_head(), "output": str(args.output), "pictures": [str(path) for path in drawing.paths]}
    document |= drawing.facts
    say_notes(document["notes"], quiet=args.silent)
    with stage_progress(quiet=args.silent) as progress:
        document |= drawings.write_drawing(drawing, overwrite=args.overwrite, progress=progress)
    line = f"{args.output}: {drawings.drawing_line(document)}"
    print_document(document, line, as_json=args.json, quiet=args.quiet)


def _choose_kind(args: opt.Args) -> str:
    """Choose what is drawn by the name of the output and ``--path``; UsageError if they do not fit."""
    suffix = args.output.suffix.lower()
    is_clip, is_picture = suffix in CLIPS, suffix in PICTURES
    if suffix and not is_clip and not is_picture and not args.output.is_dir():
        expected = f"a picture, {opt.join_words(PICTURES)}, a clip, {opt.join_words(CLIPS)}, or a folder"
        raise UsageError(f"{args.output}: expected {expected}")
    if is_clip and args.path is None:
        args.path = "orbit"
    in_folder = not (is_clip or is_picture) and len(args.scenes) == 1
    if args.channel not in (None, "color") and not in_folder:
        raise UsageError(f"{args.output}: expected a folder and one scene with --channel")
    if args.background == NONE and not in_folder and (suffix != ALPHA_CLIP or len(args.scenes) > 1):
        raise UsageError(f"{args.output}: expected a folder or a {ALPHA_CLIP}, and one scene, with --background none")
    if args.path is not None:
        if is_picture:
            raise UsageError(f"{args.output}: expected a clip, {opt.join_words(CLIPS)}, or a folder with --path")
        _check_path(args)
        return "path"
    if args.frames is not None:
        raise UsageError(f"--frames: expected a clip, {opt.join_words(CLIPS)}, or --path with it")
    return "panel" if is_picture else "views"


def _check_path(args: opt.Args) -> None:
    """Raise UsageError for an unknown path, or for frames of a file."""
    from gsmerge.measure.camera_path import parse_path

    with opt.usage_errors():
        if parse_path(args.path) is not None:
            return
    if not Path(args.path).exists():
        expected = "orbit, turntable, spline or a file of cameras"
        raise UsageError(f"--path {args.path}: expected {expected}, found no such file")
    if args.frames is not None:
        raise UsageError("--frames: expected a path by its name; of a file, --views chooses some of the cameras")
