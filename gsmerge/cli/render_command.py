"""``gsmerge render``: pictures of scenes from their cameras, videos along paths, and pictures of superpixels."""

from __future__ import annotations

from pathlib import Path

from gsmerge.cli import parameters as opt
from gsmerge.cli.console import print_document, say, say_notes, stage_progress
from gsmerge.cli.paths import check_folder, check_outputs, input_files
from gsmerge.errors import UsageError

MAX_SIDE = 1 << 20  # pixels: pictures have the cameras' own size
# Endings by which a name means a file that cannot be written along a path, and no folder for the frames
NO_FOLDER = (".avi", ".gif", ".jpeg", ".jpg", ".m4v", ".mkv", ".mov", ".mpg", ".ogv", ".png", ".webp")


@opt.command(
    opt.argument("scenes", list[Path], "SCENES...", "Gaussian files, the first may be a folder: before, after, ..."),
    opt.READING,
    *opt.panel(
        opt.INPUT,
        opt.option("frame_of", Path, "The .ply whose frame the cameras are moved into. Default: the first scene, or "
                   "what it was compacted from.", metavar="PLY"),
    ),
    *opt.panel(
        opt.OUTPUT,
        opt.option("kind", ("panel", "views", "superpixels"), "panel: photo and scenes side by side, and in a last "
                   "row the scenes from outside, where no photo is; views: one picture for each camera; superpixels: "
                   "the borders, mean colours and saliency of each photo.",
                   "--as", wording="panel for a .png, views for a folder"),
    ),
    opt.output("The picture of a panel, .png, a video, .mp4 or .webm, or a folder for pictures.",
               default=opt.REQUIRED),
    *opt.panel(
        opt.OUTPUT,
        opt.option("path", str, "A video, or its frames in a folder. orbit: around the middle view and back to the "
                   "start; orbit:45: by 45 degrees to each side, beyond the cameras; spline: through all views in "
                   "their order. orbit,back:0.5 or spline,back:0.5: half of the depth farther back. Or the cameras of "
                   "a file, one for each frame.", metavar="orbit|spline|FILE"),
        opt.option("frames", int, "Frames along an orbit or a spline.",
                   wording="120, for a spline at least 4 for each view", min=2, max=100_000),
        opt.option("fps", int, "Frames of a video per second.", wording="30", min=1, max=120),
        opt.option("views", int, "Views at most, at equal intervals.", wording="4 on a panel, else all", min=1),
        opt.option("background", float, "Grey level behind the scene.", default=0.0, min=0.0, max=1.0),
    ),
    "antialiased",
    opt.changed("superpixels", help="Superpixels per view: a number, a share of its pixels, or auto."),
    opt.changed("set", help="How superpixels are cut, such as segmentation=grid; may be repeated."),
    "overwrite dry_run threads",
)  # fmt: skip
def render(args: opt.Args) -> None:
    """Draw scenes: side by side with their photos, a picture for each camera, a video along a path, or superpixels."""
    kind, overwrite = _choose_kind(args), args.overwrite or args.dry_run
    from gsmerge.measure import drawings
    from gsmerge.measure.camera_path import parse_path
    from gsmerge.measure.preview import is_video
    from gsmerge.settings.stages import SegmentOptions

    files = like = args.files(args.scenes[0])
    (segmentation,) = args.make(SegmentOptions)
    if kind != "superpixels":
        like = drawings.frame_files(files, args.frame_of, args.cameras, args.images)
    inputs = (*input_files(files), *input_files(like))
    if kind in ("panel", "path"):
        inputs = (*args.scenes, *inputs)
        if args.path is not None and parse_path(args.path) is None:  # of a file
            inputs = (*inputs, Path(args.path))
    if kind == "panel" or is_video(args.output):
        check_outputs((args.output,), inputs, overwrite=overwrite)
    else:
        check_folder(args.output, inputs, overwrite=overwrite)
    hints = args.hints(max_side=MAX_SIDE) if kind == "views" else args.hints()
    arguments = args.given(("views", "path", "frames", "fps", "background", "antialiased"))
    drawing = drawings.DRAWINGS[kind](
        drawings.DrawOptions(
            files, args.scenes, like, args.output, args.opacity, hints, segmentation=segmentation, **arguments
        )
    )
    document = drawings.drawing_document(drawing, args.output, dry_run=args.dry_run)
    say_notes(document["notes"], quiet=args.silent)
    if not args.dry_run:
        with stage_progress(quiet=args.silent) as progress:
            document |= drawings.write_drawing(drawing, overwrite=overwrite, threads=args.threads, progress=progress)
    line = f"{args.output}: {drawings.drawing_line(document)}"
    if args.json or args.dry_run:
        print_document(document, f"would write {line}", as_json=args.json)
    else:
        say(line, quiet=args.quiet)


def _choose_kind(args: opt.Args) -> str:
    """Choose what is drawn by ``--path``, ``--as`` and the name of the output; UsageError if they do not fit."""
    suffix = args.output.suffix.lower()
    kind: str = args.kind or ("panel" if suffix == ".png" else "views")
    if kind != "superpixels" and (args.superpixels or args.set):
        raise UsageError("--superpixels and --set: expected --as superpixels with them")
    if args.path is not None:
        _check_path(args)
        return "path"
    from gsmerge.measure.preview import is_video

    if args.frames or args.fps or is_video(args.output):
        what = f"{args.output}" if is_video(args.output) else "--frames and --fps"
        raise UsageError(f"{what}: expected the path of a video with it, --path orbit, spline or a file of cameras")
    if kind == "panel" and suffix != ".png":
        raise UsageError(f"{args.output}: expected a name that ends in .png")
    if kind != "panel" and len(args.scenes) > 1:
        raise UsageError(f"--as {kind}: expected one scene, got {len(args.scenes)}; a panel shows several, as a .png")
    return kind


def _check_path(args: opt.Args) -> None:
    """Raise UsageError for an unknown path, or for options and outputs that do not fit a path."""
    from gsmerge.measure.camera_path import parse_path
    from gsmerge.measure.preview import is_video

    if args.kind is not None:
        raise UsageError(f"--path: expected no --as with it, got --as {args.kind}")
    if args.output.suffix.lower() in NO_FOLDER:
        raise UsageError(f"{args.output}: expected a video, .mp4 or .webm, or a folder for the frames of --path")
    if args.fps is not None and not is_video(args.output):
        raise UsageError(f"--fps: expected a video, .mp4 or .webm, got the folder {args.output}")
    with opt.usage_errors():
        if parse_path(args.path) is not None:
            return
    if not Path(args.path).exists():
        raise UsageError(f"--path {args.path}: expected orbit, spline or a file of cameras, found no such file")
    if args.frames is not None:
        raise UsageError("--frames: expected an orbit or a spline; of a file, --views chooses some of the cameras")
