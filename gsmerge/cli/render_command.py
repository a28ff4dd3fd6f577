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
# What can have alpha beside its colours, show opacity, and show depth, which takes 16 bits; so do pictures in a folder
LAYERS = {"color": (".png", ".webp", ".webm"), "alpha": (*PICTURES, *CLIPS), "depth": (".png",)}
MAX_DIGITS = 9  # of a number of views: more are as many
SIDES = (16, 16384)  # pixels of a picture


def parse_size(text: str) -> tuple[int, int]:
    """Parse ``--size``: a width and a height with an x between."""
    match = re.fullmatch(r"(\d{1,5})[xX](\d{1,5})", text)
    size = (int(match[1]), int(match[2])) if match else (0, 0)
    if not all(SIDES[0] <= side <= SIDES[1] for side in size):
        raise typer.BadParameter(f"expected WIDTHxHEIGHT, such as 1920x1080, {SIDES[0]} to {SIDES[1]} pixels each")
    return size


def parse_views(text: str) -> int | str:
    """Parse ``--views``: a number, or the name of a view; digits that begin with 0 are a name."""
    if not re.fullmatch(r"[+-]?[\d.]+", text) or re.fullmatch(r"0\d+", text):
        return text
    count = int(text[:MAX_DIGITS]) if text.isdecimal() else 0
    if count < 1:
        raise typer.BadParameter(f"expected a number from 1, or the name of a view, got {text}")
    return count


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
               "two scenes; or a folder for a picture of each camera. With --views NAME a picture of one.",
               default=opt.REQUIRED),
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
        opt.option("views", str, "Views at most, at equal intervals; or the name of one, which the picture of one "
                   "scene shows alone: 00006, or 6.jpg, as 6 is a number.", metavar="NUMBER|NAME", parser=parse_views,
                   wording="4 on a panel, else all; the first of a picture with alpha, opacity or depth"),
        opt.option("overlay", ("support",), "Colour what one view of the scene alone shows, and what none does: "
                   "yellow, red."),
        opt.option("background", str, "Grey level behind the scene, 0 to 1; none: nothing, so that .png, .webp, .webm "
                   "and pictures in a folder have alpha.", wording="0", metavar="LEVEL|none", parser=parse_background),
        opt.option("channel", ("color", "alpha", "depth"), "What pictures and clips show: colour; opacity; or depth, "
                   "in a .png or a folder, in 16 bits, 0 where nothing is; --json has their unit.", wording="color"),
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
    """Choose what is drawn by the name of the output and the options; UsageError if they do not fit."""
    suffix = args.output.suffix.lower()
    is_clip, is_picture = suffix in CLIPS, suffix in PICTURES
    if suffix and not is_clip and not is_picture and not args.output.is_dir():
        expected = f"a picture, {opt.join_words(PICTURES)}, a clip, {opt.join_words(CLIPS)}, or a folder"
        raise UsageError(f"{args.output}: expected {expected}")
    if is_clip and args.path is None:
        args.path = "orbit"
    is_layer = _check_layer(args, suffix if is_clip or is_picture else "")
    if args.path is not None:
        if is_picture:
            raise UsageError(f"{args.output}: expected a clip, {opt.join_words(CLIPS)}, or a folder with --path")
        if isinstance(args.views, str):
            raise UsageError("--views: expected a number of views with --path and clips, got a name")
        _check_path(args)
        return "path"
    if args.frames is not None:
        raise UsageError(f"--frames: expected a clip, {opt.join_words(CLIPS)}, or --path with it")
    if is_layer and is_picture and isinstance(args.views, int):
        raise UsageError(f"{args.output}: expected a folder with a number of --views, or the name of one view")
    alone = is_layer or (isinstance(args.views, str) and len(args.scenes) == 1)
    return "panel" if is_picture and not alone else "views"


def _check_layer(args: opt.Args, suffix: str) -> bool:
    """Return whether alpha, opacity or depth is asked for; UsageError unless the output, "" for a folder, has it."""
    channel = args.channel or "color"
    if channel == "color" and args.background != NONE:
        return False
    option, endings = f"--channel {channel}", LAYERS[channel]
    if channel == "color":
        option = "--background none"
    for other in ("overlay", "background") if channel != "color" else ():
        if vars(args)[other] is not None:
            raise UsageError(f"--{other}: expected colours with it, got {option}")
    if len(args.scenes) > 1 or (suffix and suffix not in endings):
        raise UsageError(f"{args.output}: expected a folder or {opt.join_words(endings)}, and one scene, with {option}")
    return True


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
