"""``gsmerge render``: pictures of scenes from their cameras, videos along paths, and pictures of superpixels."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gsmerge.cli import parameters as opt
from gsmerge.cli.console import Progress, print_document, say, say_notes, stage_progress
from gsmerge.cli.paths import check_cameras, check_folder, check_outputs, input_files, source_of
from gsmerge.errors import SceneError, UsageError

if TYPE_CHECKING:
    import numpy as np

    from gsmerge.measure.preview import Picture
    from gsmerge.scene.exporters import ReadHints
    from gsmerge.scene.files import SceneFiles
    from gsmerge.scene.read import Loaded
    from gsmerge.types import Cameras, Gaussians

    Drawing = tuple[list[Path], dict[str, Any], Callable[[int], Iterator[Picture]]]  # files, facts, and what draws them

MAX_SIDE = 1 << 20  # pixels: pictures have the cameras' own size
PANEL_VIEWS = 4  # rows of a panel
PATH_FRAMES = 120  # of a path, at least
VIEW_FRAMES = 4  # for each view of a spline, at least
FPS = 30  # frames per second
# Endings by which a name means a file that cannot be written along a path, and no folder for the frames
NO_FOLDER = (".avi", ".gif", ".jpeg", ".jpg", ".m4v", ".mkv", ".mov", ".mpg", ".ogv", ".png", ".webp")
KINDS = ("borders", "means", "saliency")  # pictures of the superpixels of a view


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
    plan = _choose_plan(args)
    paths, facts, draw = plan(args, args.files(args.scenes[0]))
    from gsmerge.report import document_head
    from gsmerge.runtime.threads import use_threads

    say_notes(facts["notes"], quiet=args.silent)
    if not args.dry_run:
        with (
            use_threads(args.threads) as threads,
            stage_progress(quiet=args.silent) as progress,
        ):
            pictures = _count(draw(threads), facts.get("frames", len(paths)), progress)
            if "fps" in facts:
                from gsmerge.measure.video import write_video

                facts["encoding"] = write_video(args.output, pictures, facts["fps"], overwrite=args.overwrite)
            else:
                for path, picture in zip(paths, pictures, strict=True):
                    write_picture(path, picture, overwrite=args.overwrite)
    head = {**document_head(), "dry_run": args.dry_run, "output": str(args.output)}
    document = {**head, "pictures": [str(path) for path in paths], **facts}
    line = _describe(len(paths), facts)
    if args.json or args.dry_run:
        print_document(document, f"would write {args.output}: {line}", as_json=args.json)
    else:
        say(f"{args.output}: {line}", quiet=args.quiet)


def _choose_plan(args: opt.Args) -> Callable[[opt.Args, SceneFiles], Drawing]:
    """Choose what is drawn by ``--path``, ``--as`` and the name of the output; UsageError if they do not fit."""
    suffix = args.output.suffix.lower()
    kind = args.kind or ("panel" if suffix == ".png" else "views")
    if kind != "superpixels" and (args.superpixels or args.set):
        raise UsageError("--superpixels and --set: expected --as superpixels with them")
    if args.path is not None:
        _check_path(args)
        return _plan_path
    from gsmerge.measure.video import is_video

    if args.frames or args.fps or is_video(args.output):
        what = f"{args.output}" if is_video(args.output) else "--frames and --fps"
        raise UsageError(f"{what}: expected the path of a video with it, --path orbit, spline or a file of cameras")
    if kind == "panel" and suffix != ".png":
        raise UsageError(f"{args.output}: expected a name that ends in .png")
    if kind != "panel" and len(args.scenes) > 1:
        raise UsageError(f"--as {kind}: expected one scene, got {len(args.scenes)}; a panel shows several, as a .png")
    return {"panel": _plan_panel, "views": _plan_views, "superpixels": _plan_superpixels}[kind]


def _check_path(args: opt.Args) -> None:
    """Refuse an unknown path, and options and outputs that do not go with one."""
    from gsmerge.measure.camera_path import parse_path
    from gsmerge.measure.video import is_video

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


def _count(pictures: Iterator[Picture], total: int, progress: Progress) -> Iterator[Picture]:
    """Yield pictures, and show after each how many are done."""
    for done, picture in enumerate(pictures, 1):
        yield picture
        progress("render", done, total)


def _describe(num_files: int, facts: dict[str, Any]) -> str:
    """Write in a line what was drawn."""
    if "frames" in facts:
        line = f"{facts['frames']} frames of {facts['width']} x {facts['height']}"
        line += f", {facts['frames'] / facts['fps']:.1f} s" if "fps" in facts else ""
        return f"{line}, {facts['encoding']}" if "encoding" in facts else line
    line = f"{num_files} picture(s) of {len(facts['views'])} views"
    if "superpixels" in facts:
        line += f", {min(facts['superpixels'])} to {max(facts['superpixels'])} superpixels per view"
    return line


def _plan_panel(args: opt.Args, files: SceneFiles) -> Drawing:
    """Plan a picture of photo, before, after, ... of some views, one row each, and of all scenes from outside."""
    like = _frame_files(args, files)
    inputs = (*args.scenes, *input_files(files), *input_files(like))
    check_outputs((args.output,), inputs, overwrite=args.overwrite or args.dry_run)
    scenes, load, notes = _read(args, files, like, args.hints(), photos=True)
    views, used = load.views, list(load.views.used)
    cameras, photos = views.cameras[used], views.images
    ids = _choose(args, len(used), PANEL_VIEWS)

    def draw(_: int) -> Iterator[Picture]:
        from gsmerge.measure.preview import contact_sheet, outside_pictures, view_pictures

        parts = [(path.name, gaussians) for path, gaussians in zip(args.scenes, scenes, strict=True)]
        own = None if photos is None else photos[used]
        how = {"background": args.background, "antialiased": args.antialiased}
        rows = view_pictures(parts, cameras, own, max_views=len(ids), **how)
        yield contact_sheet([*rows, outside_pictures(parts, cameras, photos=own is not None, **how)])

    facts = {"scenes": _counts(args, scenes), "views": ids, "photos": photos is not None, "notes": notes}
    return [args.output], facts, draw


def _counts(args: opt.Args, scenes: Sequence[Gaussians]) -> dict[str, int]:
    return {str(path): len(gaussians) for path, gaussians in zip(args.scenes, scenes, strict=True)}


def _plan_views(args: opt.Args, files: SceneFiles) -> Drawing:
    """Plan one picture for each camera."""
    like = _frame_files(args, files)
    inputs = (*input_files(files), *input_files(like))
    check_folder(args.output, inputs, overwrite=args.overwrite or args.dry_run)
    scenes, load, notes = _read(args, files, like, args.hints(max_side=MAX_SIDE), photos=False)
    placed = load.views
    ids = _choose(args, len(placed.cameras))
    views, stems = placed.cameras[ids], picture_stems(placed.names)

    def draw(threads: int) -> Iterator[Picture]:
        from gsmerge.measure.preview import to_picture

        for (image,) in _draw_views(args, scenes, views, threads):
            yield to_picture(image)

    facts = {"width": views.width, "height": views.height, "num_gaussians": len(scenes[0])}
    return [args.output / f"{stems[i]}.png" for i in ids], {**facts, "views": ids, "notes": notes}, draw


def _draw_views(
    args: opt.Args, scenes: Sequence[Gaussians], views: Cameras, threads: int, near: float = 0.01
) -> Iterator[tuple[np.ndarray, ...]]:
    """Yield the pictures ``[h,w,3]`` of all scenes from each camera, with as many views in memory as threads."""
    from gsmerge.raster import render_in_turn

    drawn = (
        render_in_turn(gaussians, views, args.background, at_once=threads, antialiased=args.antialiased, near=near)
        for gaussians in scenes
    )
    return zip(*drawn, strict=True)


def _plan_path(args: opt.Args, files: SceneFiles) -> Drawing:
    """Plan a video, or its frames as pictures, of the scenes side by side along a path."""
    from gsmerge.measure.video import is_video

    like, named = _frame_files(args, files), Path(args.path)
    inputs = (*args.scenes, *input_files(files), *input_files(like), named)
    overwrite = args.overwrite or args.dry_run
    if is_video(args.output):
        check_outputs((args.output,), inputs, overwrite=overwrite)
    else:
        check_folder(args.output, inputs, overwrite=overwrite)
    scenes, cameras, near, facts = _path_cameras(args, files, like)
    labels = [f"{path.name}: {len(one):,}" for path, one in zip(args.scenes, scenes, strict=True)]

    def draw(threads: int) -> Iterator[Picture]:
        from gsmerge.measure.preview import contact_sheet, to_picture

        for images in _draw_views(args, scenes, cameras, threads, near=near):
            yield contact_sheet([list(zip(labels, images, strict=True))]) if len(images) > 1 else to_picture(images[0])

    paths = [args.output]
    facts |= {
        "scenes": _counts(args, scenes),
        "path": args.path,
        "frames": len(cameras),
        "width": cameras.width,
        "height": cameras.height,
    }
    if is_video(args.output):
        facts["fps"] = args.fps or FPS
    else:
        paths = [args.output / f"frame_{i:05d}.png" for i in range(len(cameras))]
    return paths, facts, draw


def _path_cameras(
    args: opt.Args, files: SceneFiles, like: SceneFiles
) -> tuple[list[Gaussians], Cameras, float, dict[str, Any]]:
    """Read the scenes and make the cameras of the path; also return its near plane, and facts."""
    from gsmerge.measure.camera_path import parse_path, plan_path, viewing_depth
    from gsmerge.raster.photos import NEAR

    path = parse_path(args.path)
    file, own = None if path else Path(args.path), True
    try:
        check_cameras(like)
    except SceneError:
        if file is None:
            raise
        like, own = replace(like, cameras=file), False
    scenes, load, notes = _read(args, files, like, args.hints(), photos=False)
    placed = load.views
    cameras = placed.cameras if file is None or not own else _place_file(file, load)
    ids = _choose(args, len(cameras))
    cameras = cameras[ids]
    depth = viewing_depth(cameras if file is None else placed.cameras, scenes[0].means)
    if path is not None:
        least = VIEW_FRAMES * len(ids) if path.kind == "spline" else 0
        with opt.usage_errors():
            cameras = plan_path(path, cameras, depth, args.frames or max(PATH_FRAMES, least))
    return scenes, cameras, NEAR * depth, {"views": ids, "notes": notes}


def _place_file(file: Path, load: Loaded) -> Cameras:
    """Read the cameras of a path into the frame of a scene, with the size of the scene's where they have none."""
    from gsmerge.io import read_cameras, to_cameras
    from gsmerge.io.cameras.camera_file import sizes_of
    from gsmerge.scene.held_out import place_camera_file

    stored = read_cameras(file) if load.cameras is None else place_camera_file(load, file)[0]
    size = None if sizes_of(stored) else (load.views.cameras.width, load.views.cameras.height)
    return to_cameras(replace(stored, lenses=()), size)


def _plan_superpixels(args: opt.Args, files: SceneFiles) -> Drawing:
    """Plan the pictures of every photo's superpixels: borders, mean colours, and the saliency that seeds them."""
    from gsmerge.stages.superpixels import SegmentOptions, count_for

    (options,) = args.make(SegmentOptions)
    check_folder(args.output, input_files(files), overwrite=args.overwrite or args.dry_run)
    load = args.load(files)
    scene = load.pixel_scene()
    ids, stems = _choose(args, len(scene)), picture_stems(scene.names)
    counts = [count_for(options, scene.cameras.height, scene.cameras.width)] * len(ids)

    def draw(_: int) -> Iterator[Picture]:
        from gsmerge.measure.preview import draw_borders, draw_heat, draw_means
        from gsmerge.raster.photos import scene_pictures
        from gsmerge.stages.superpixels import saliency, segment

        images = scene_pictures(scene)
        images = images[ids] if len(ids) < len(images) else images  # all of them without a copy
        groups = segment(images, options)
        counts[:] = groups.counts
        for image, labels in zip(images, groups.labels, strict=True):
            yield from (draw_borders(image, labels), draw_means(image, labels), draw_heat(saliency(image)))

    paths = [args.output / f"{stems[i]}.{kind}.png" for i in ids for kind in KINDS]
    return paths, {"superpixels": counts, "options": vars(options), "views": ids, "notes": load.notes}, draw


def _choose(args: opt.Args, count: int, most: int | None = None) -> list[int]:
    """Choose the views to draw: those of ``--views``, or at most ``most``; None: all."""
    from gsmerge.facts.views import pick_views

    return pick_views(count, args.views or most or count)


def _frame_files(args: opt.Args, files: SceneFiles) -> SceneFiles:
    """Find the files of the scene whose frame the cameras are moved into."""
    from gsmerge.scene.files import find_scene_files

    source = args.frame_of or source_of(files.ply)
    if source is None:
        return files
    return find_scene_files(source, cameras=args.cameras or files.cameras, images=args.images)


def _read(
    args: opt.Args, files: SceneFiles, like: SceneFiles, hints: ReadHints, *, photos: bool
) -> tuple[list[Gaussians], Loaded, list[str]]:
    """Read the scenes, and ``like``, with its cameras in the frame of its Gaussians; also return notes."""
    from gsmerge.io import file_notes, read_gaussians
    from gsmerge.scene.exporters import AUTO
    from gsmerge.scene.read import place_cameras_in_scene, read_rows

    check_cameras(like)
    first = read_rows(files, opacity=args.opacity, hints=hints)
    others = [read_gaussians(path, opacity=args.opacity) for path in args.scenes[1:]]
    own = like.ply == files.ply
    framed = first if own else read_rows(like, opacity="auto", hints=AUTO)
    load = place_cameras_in_scene(framed, like, hints=hints, photos=photos)
    scenes = [load.scene.file_gaussians if own else first.gaussians, *(ply.gaussians for ply in others)]
    notes = [*([] if own else file_notes(first.info)), *load.notes]
    if others:
        names = [str(path) for path in args.scenes]
        notes = [f"{names[0]}: {note}" for note in notes]
        notes += [
            f"{name}: {note}" for name, ply in zip(names[1:], others, strict=True) for note in file_notes(ply.info)
        ]
    return scenes, load, notes


def picture_stems(names: Sequence[str]) -> list[str]:
    """Choose a different file name per view: the image's name, its path joined by ``_``, or the view's number."""
    from gsmerge.io.image_names import IMAGE_SUFFIXES

    paths = []
    for name in names:
        parts = [part for part in re.split(r"[\\/]+", name) if part not in ("", ".", "..")] or ["view"]
        stem, dot, suffix = parts[-1].rpartition(".")
        known = stem and f"{dot}{suffix}".lower() in IMAGE_SUFFIXES
        paths.append([*parts[:-1], stem if known else parts[-1]])
    numbers = [[f"view_{i:03d}"] for i in range(len(names))]
    for candidates in ([path[-1:] for path in paths], paths, numbers):
        stems = ["_".join(path) for path in candidates]
        if len({stem.lower() for stem in stems}) == len(stems):  # some file systems do not tell case apart
            break
    return stems


def write_picture(path: Path, picture: Picture, *, overwrite: bool) -> None:
    """Write a picture; make its folder if it is not there."""
    from gsmerge.measure.preview import save_picture

    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SceneError(path.parent, f"cannot be made ({error.strerror})", "name another with --output") from error
    save_picture(path, picture, overwrite=overwrite)
