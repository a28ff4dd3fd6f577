"""``gsmerge render``: draw pictures of scenes from their cameras, and clips along paths."""

from __future__ import annotations

import re
from pathlib import Path

from gsmerge.cli import parameters as opt
from gsmerge.cli.console import print_document, say_notes, stage_progress
from gsmerge.cli.paths import check_folder, check_outputs, input_files
from gsmerge.errors import UsageError
from gsmerge.settings.pictures import CLIPS, PICTURES
from gsmerge.settings.reading import NONE

MAX_SIDE = 1 << 20  # pixels; larger than any camera, so that pictures keep the size of the cameras
# Endings of outputs that can hold each channel: "color" with alpha, "alpha", and "depth", which takes 16 bits. Folders
# can hold all channels
LAYERS = {"color": (".png", ".webp", ".webm"), "alpha": (*PICTURES, *CLIPS), "depth": (".png",)}
MAX_DIGITS = 9  # only so many digits of a number of views are read
SIDES = (16, 16384)  # least and largest width and height of a picture, pixels


def parse_size(text: str) -> tuple[int, int]:
    """Parse ``--size``: width and height, separated by an x."""
    match = re.fullmatch(r"(\d{1,5})[xX](\d{1,5})", text)
    size = (int(match[1]), int(match[2])) if match else (0, 0)
    if not all(SIDES[0] <= side <= SIDES[1] for side in size):
        raise ValueError(f"expected WIDTHxHEIGHT, such as 1920x1080, {SIDES[0]} to {SIDES[1]} pixels each")
    return size


def parse_views(text: str) -> int | str:
    """Parse ``--views``: a number or the name of a view. Digits that begin with 0 are a name."""
    if not re.fullmatch(r"[+-]?[\d.]+", text) or re.fullmatch(r"0\d+", text):
        return text
    count = int(text[:MAX_DIGITS]) if text.isdecimal() else 0
    if count < 1:
        raise ValueError(f"expected a number from 1 or the name of a view, got {text}")
    return count


def parse_background(text: str) -> float | str:
    """Parse ``--background``: a grey level or "none"."""
    if text.lower() == NONE:
        return NONE
    try:
        level = float(text)
    except ValueError:
        level = -1
    if not 0 <= level <= 1:
        raise ValueError("expected a grey level, 0 to 1, or none")
    return level


@opt.command(
    opt.argument("scenes", list[Path], "SCENES...", "Files of Gaussians: before, after, ... The first may be a "
                 "folder."),
    opt.READING,
    opt.output("A picture, .png or .jpg: a panel of photos and scenes, or with --views NAME one view of one scene. A "
               "clip, .mp4, .webm or .gif; a moving line separates two scenes. A folder gets a picture of each camera.",
               default=opt.REQUIRED),
    *opt.panel(
        opt.OUTPUT,
        opt.option("path", str, "Path of the camera. orbit: about the middle view, orbit:45 by 45 degrees to each "
                   "side; turntable: once about the centre of the scene; spline: through all views. With ,back:0.5 "
                   "it moves back by half of the depth. Or a file with a camera for each frame.",
                   wording="orbit, none for a folder", metavar="orbit|turntable|spline|FILE"),
        opt.option("size", str, "Width and height in pixels, in a panel of each picture. Views with another aspect "
                   "ratio are cropped on two sides.", wording="the cameras', of a GIF at most 640",
                   metavar="WIDTHxHEIGHT", parser=parse_size),
        opt.option("frames", int, "Number of frames of a clip, at 30 frames per second, or 12.5 in a GIF.",
                   wording="6 seconds of a turntable, else 4", min=2, max=100_000),
        opt.option("views", str, "Largest number of views, at equal intervals; or the name of one view, such as "
                   "00006 or 6.jpg (6 would be a number).", metavar="NUMBER|NAME", parser=parse_views,
                   wording="4 on a panel, else all; the first of a picture with alpha, opacity or depth"),
        opt.option("overlay", ("support",), "Colour what only one view of the scene shows yellow, and what no view "
                   "shows red."),
        opt.option("background", str, "Grey level behind the scene, 0 to 1; none: transparent, in .png, .webp, .webm "
                   "or a folder.", wording="0", metavar="LEVEL|none", parser=parse_background),
        opt.option("channel", ("color", "alpha", "depth"), "Channel to draw: color, alpha (opacity), or depth. Depth "
                   "takes a .png or a folder, with 16 bits and 0 where nothing is; --json gives its unit.",
                   wording="color"),
    ),
    "overwrite",
)  # fmt: skip
def render(args: opt.Args) -> None:
    """Draw scenes: a clip of before and after, a panel with the photos, or a picture for each camera."""
    kind = _choose_kind(args)
    from gsmerge.measure import drawings
    from gsmerge.measure.camera_path import parse_path
    from gsmerge.report import document_head

    files = args.files(args.scenes[0])
    framing = drawings.frame_files(files, args.cameras, args.images)
    inputs = (*args.scenes, *input_files(files), *input_files(framing))
    if args.path is not None and parse_path(args.path) is None:  # the path is a file
        inputs = (*inputs, Path(args.path))
    if args.output.suffix.lower() in (*PICTURES, *CLIPS):
        # A picture in a scene's folder may be replaced, unless it is a photo
        read = [path for path in inputs if path not in args.scenes or not path.is_dir()]
        check_outputs((args.output,), (*read, files.images), overwrite=args.overwrite)
    else:
        check_folder(args.output, inputs, overwrite=args.overwrite)
    hints = args.hints(max_side=MAX_SIDE) if kind == "views" else args.hints()
    arguments = args.given(("views", "path", "frames", "size", "overlay", "background", "channel"))
    drawing = drawings.DRAWINGS[kind](
        drawings.DrawOptions(files, args.scenes, framing, args.output, args.opacity, hints, **arguments)
    )
    document = {**document_head(), "output": str(args.output), "pictures": [str(path) for path in drawing.paths]}
    document |= drawing.facts
    say_notes(document["notes"], quiet=args.silent)
    with stage_progress(quiet=args.silent) as progress:
        document |= drawings.write_drawing(drawing, overwrite=args.overwrite, progress=progress)
    line = f"{args.output}: {drawings.drawing_line(document)}"
    print_document(document, line, as_json=args.json, quiet=args.quiet)


def _choose_kind(args: opt.Args) -> str:
    """Choose the kind of drawing by the name of the output and the options; UsageError if they do not fit."""
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
            raise UsageError("--views: expected a number of views for a clip or a --path, got a name")
        _check_path(args)
        return "path"
    if args.frames is not None:
        raise UsageError(f"--frames: expected a clip, {opt.join_words(CLIPS)}, or a --path with it")
    if is_layer and is_picture and isinstance(args.views, int):
        raise UsageError(f"{args.output}: expected a folder for several --views, or the name of one view")
    is_single = is_layer or (isinstance(args.views, str) and len(args.scenes) == 1)
    return "panel" if is_picture and not is_single else "views"


def _check_layer(args: opt.Args, suffix: str) -> bool:
    """Return True if colours with alpha, opacity or depth are drawn; UsageError if the output cannot hold them.

    ``suffix`` is the ending of the output, "" for a folder.
    """
    channel = args.channel or "color"
    if channel == "color" and args.background != NONE:
        return False
    option, endings = f"--channel {channel}", LAYERS[channel]
    if channel == "color":
        option = "--background none"
    for name in ("overlay", "background") if channel != "color" else ():
        if vars(args)[name] is not None:
            raise UsageError(f"--{name}: expected --channel color with it, got {option}")
    if len(args.scenes) > 1:
        raise UsageError(f"{option}: expected one scene, got {len(args.scenes)}")
    if suffix and suffix not in endings:
        expected = f"expected a folder or {opt.join_words(endings)} with {option}"
        reason = "is written without transparency" if channel == "color" else f"cannot hold {channel}"
        raise UsageError(f"{args.output}: {expected}, got {suffix}, which {reason}")
    return True


def _check_path(args: opt.Args) -> None:
    """Raise UsageError for an unknown path, or for ``--frames`` with a path that is a file."""
    from gsmerge.measure.camera_path import parse_path

    with opt.usage_errors():
        if parse_path(args.path) is not None:
            return
    if not Path(args.path).exists():
        expected = "orbit, turntable, spline or a file of cameras"
        raise UsageError(f"--path {args.path}: expected {expected}, found no such file")
    if args.frames is not None:
        raise UsageError("--frames: expected orbit, turntable or spline; with a file of cameras, use --views")
