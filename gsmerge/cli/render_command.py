"""``gsmerge render``: draw pictures of scenes from their cameras, and clips along paths."""

from __future__ import annotations

import re
from pathlib import Path

from gsmerge.cli import parameters as opt
from gsmerge.cli.console import print_document, say_notes, stage_progress
from gsmerge.cli.paths import check_folder, check_outputs, input_files
from gsmerge.errors import UsageError
from gsmerge.settings.pictures import CLIPS, PICTURES

MAX_SIDE = 1 << 20  # pixels; larger than any camera, so that pictures keep the size of the cameras


def parse_size(text: str) -> tuple[int, int]:
    """Parse ``--size``: width and height, separated by an x."""
    match = re.fullmatch(r"(\d{1,5})[xX](\d{1,5})", text)
    size = (int(match[1]), int(match[2])) if match else (0, 0)
    sides = (16, 16384)  # least and largest width and height of a picture, pixels
    if not all(sides[0] <= side <= sides[1] for side in size):
        expected = f"WIDTHxHEIGHT, such as 1920x1080, {sides[0]} to {sides[1]} pixels each"
        raise ValueError(f"expected {expected}, got {text!r}")
    return size


def parse_views(text: str) -> int | str:
    """Parse ``--views``: a number or the name of a view. Digits that begin with 0 are a name."""
    if not re.fullmatch(r"[+-]?[\d.]+", text) or re.fullmatch(r"0\d+", text):
        return text
    max_digits = 9  # of a longer number only this many digits are read, which is still more than enough views
    count = int(text[:max_digits]) if text.isdecimal() else 0
    if count < 1:
        raise ValueError(f"expected a number from 1 or the name of a view, got {text}")
    return count


@opt.command(
    opt.argument("scenes", list[Path], "SCENES...", "Files of Gaussians: before, after, ... The first may be a "
                 "folder."),
    opt.READING,
    opt.output("A picture, .png or .jpg: a panel of photos and scenes, or with --views NAME one view of one scene. A "
               "clip, .mp4, .webm or .gif; a moving line separates two scenes. A folder gets a picture of each camera.",
               default=opt.REQUIRED),
    *opt.panel(
        opt.OUTPUT_GROUP,
        opt.option("path", str, "Path of the camera. orbit: about the middle view, orbit:45 by 45 degrees to each "
                   "side; spline: through all views. With ,back:0.5 it moves back by half of the depth. Or a file "
                   "with a camera for each frame.",
                   wording="orbit, none for a folder", metavar="orbit|spline|FILE"),
        opt.option("size", str, "Width and height in pixels, in a panel of each picture. Views with another aspect "
                   "ratio are cropped on two sides.", wording="the cameras', of a GIF at most 640",
                   metavar="WIDTHxHEIGHT", parser=parse_size),
        opt.option("frames", int, "Number of frames of a clip, at 30 frames per second, or 12.5 in a GIF.",
                   wording="4 seconds", min=2, max=100_000),
        opt.option("views", str, "Largest number of views, at equal intervals; or the name of one view, such as "
                   "00006 or 6.jpg (6 would be a number).", metavar="NUMBER|NAME", parser=parse_views,
                   wording="4 on a panel, else all"),
        opt.option("background", float, "Grey level behind the scene, 0 to 1.", wording="0", metavar="LEVEL", min=0,
                   max=1),
    ),
    "overwrite",
)  # fmt: skip
def render(args: opt.Args) -> None:
    """Draw scenes: a clip of before and after, a panel with the photos, or a picture for each camera."""
    kind = _choose_kind(args)
    from gsmerge.measure import drawings
    from gsmerge.measure.camera_path import parse_camera_path
    from gsmerge.measure.documents import document_head, note_entries

    files = args.files(args.scenes[0])
    framing = drawings.frame_files(files, args.cameras, args.images)
    inputs = (*args.scenes, *input_files(files), *input_files(framing))
    if args.path is not None and parse_camera_path(args.path) is None:  # the path is a file
        inputs = (*inputs, Path(args.path))
    if args.output.suffix.lower() in (*PICTURES, *CLIPS):
        # A picture in the folder of a scene may be replaced, unless it is a photo of this scene
        read = [path for path in inputs if path not in args.scenes or not path.is_dir()]
        check_outputs((args.output,), (*read, files.images), overwrite=args.overwrite)
    else:
        check_folder(args.output, inputs, overwrite=args.overwrite)
    hints = args.hints(max_side=MAX_SIDE) if kind == "views" else args.hints()
    arguments = args.get_given(("views", "path", "frames", "size", "background"))
    drawing = drawings.DRAWINGS[kind](
        drawings.DrawOptions(files, args.scenes, framing, args.output, args.opacity, hints, **arguments)
    )
    document = {**document_head(), "output": str(args.output), "pictures": [str(path) for path in drawing.paths]}
    document |= drawing.facts | note_entries(drawing.facts["notes"])
    say_notes(document["notes"], quiet=args.silent)
    with stage_progress(quiet=args.silent) as progress:
        document |= drawings.write_drawing(drawing, overwrite=args.overwrite, progress=progress)
    line = f"{args.output}: {drawings.drawing_line(document)}"
    print_document(document, line, as_json=args.json, quiet=args.quiet)


def _choose_kind(args: opt.Args) -> str:
    """Return the kind of drawing, by the name of the output and the options.

    Raises UsageError if output and options do not fit each other. A clip without ``--path`` gets the path "orbit".
    """
    suffix = args.output.suffix.lower()
    is_clip, is_picture = suffix in CLIPS, suffix in PICTURES
    if suffix and not is_clip and not is_picture and not args.output.is_dir():
        expected = f"a picture, {opt.join_words(PICTURES)}, a clip, {opt.join_words(CLIPS)}, or a folder"
        raise UsageError(f"{args.output}: expected {expected}")
    if is_clip and args.path is None:
        args.path = "orbit"
    if args.path is not None:
        if is_picture:
            raise UsageError(f"{args.output}: expected a clip, {opt.join_words(CLIPS)}, or a folder with --path")
        if isinstance(args.views, str):
            raise UsageError("--views: expected a number of views for a clip or a --path, got a name")
        _check_path(args)
        return "path"
    if args.frames is not None:
        raise UsageError(f"--frames: expected a clip, {opt.join_words(CLIPS)}, or a --path with it")
    is_single = isinstance(args.views, str) and len(args.scenes) == 1
    return "panel" if is_picture and not is_single else "views"


def _check_path(args: opt.Args) -> None:
    """Raise UsageError for an unknown path, or for ``--frames`` with a path that is a file."""
    from gsmerge.measure.camera_path import parse_camera_path

    with opt.usage_errors():
        if parse_camera_path(args.path) is not None:
            return
    if not Path(args.path).exists():
        expected = "orbit, spline or a file of cameras"
        raise UsageError(f"--path {args.path}: expected {expected}, found no such file")
    if args.frames is not None:
        raise UsageError("--frames: expected orbit or spline; with a file of cameras, use --views")
