"""``gsmerge render``: pictures of scenes from their cameras, and of superpixels."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gsmerge.cli import parameters as opt
from gsmerge.cli.console import print_document, say, say_notes, stage_progress
from gsmerge.cli.paths import check_cameras, check_folder, check_outputs, input_files, source_of
from gsmerge.errors import SceneError, UsageError

if TYPE_CHECKING:
    from gsmerge.io import SceneFiles
    from gsmerge.io.scene import SceneViews
    from gsmerge.measure.preview import Picture
    from gsmerge.types import Gaussians

    Drawing = tuple[list[Path], dict[str, Any], Callable[[int], Iterator[Picture]]]  # files, facts, and what draws them

MAX_SIDE = 1 << 20  # pixels: pictures have the cameras' own size
PANEL_VIEWS = 4  # rows of a panel
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
        opt.option("kind", ("panel", "views", "superpixels"), "panel: photo and scenes side by side; views: one "
                   "picture for each camera; superpixels: the borders, mean colours and saliency of each photo.",
                   "--as", wording="panel for a .png, views for a folder"),
    ),
    opt.output("The picture of a panel, .png, or a folder for pictures.", default=opt.REQUIRED),
    *opt.panel(
        opt.OUTPUT,
        opt.option("views", int, "Views at most, at equal intervals.", wording="4 on a panel, else all", min=1),
        opt.option("background", float, "Grey level behind the scene.", default=0.0, min=0.0, max=1.0),
    ),
    "antialiased",
    opt.changed("superpixels", help="Superpixels per view: a number, a share of its pixels, or auto."),
    opt.changed("set", help="How superpixels are cut, such as segmentation=grid; may be repeated."),
    "overwrite dry_run threads",
)  # fmt: skip
def render(args: opt.Args) -> None:
    """Draw scenes from the same cameras, side by side with the photos or one picture each, or draw superpixels."""
    kind = args.kind or ("panel" if args.output.suffix.lower() == ".png" else "views")
    if kind == "panel" and args.output.suffix.lower() != ".png":
        raise UsageError(f"{args.output}: expected a name that ends in .png")
    if kind != "panel" and len(args.scenes) > 1:
        raise UsageError(f"--as {kind}: expected one scene, got {len(args.scenes)}; a panel shows several, as a .png")
    if kind != "superpixels" and (args.superpixels or args.set):
        raise UsageError("--superpixels and --set: expected --as superpixels with them")
    plan = {"panel": _plan_panel, "views": _plan_views, "superpixels": _plan_superpixels}[kind]
    paths, facts, draw = plan(args, args.files(args.scenes[0]))
    from gsmerge.report import document_head
    from gsmerge.runtime.threads import use_threads

    say_notes(facts["notes"], quiet=args.silent)
    if not args.dry_run:
        with (
            use_threads(args.threads) as threads,
            stage_progress(quiet=args.silent) as progress,
        ):
            for i, (path, picture) in enumerate(zip(paths, draw(threads), strict=True), 1):
                write_picture(path, picture, overwrite=args.overwrite)
                progress("render", i, len(paths))
    head = {**document_head(), "dry_run": args.dry_run, "output": str(args.output)}
    document = {**head, "pictures": [str(path) for path in paths], **facts}
    line = f"{len(paths)} picture(s) of {len(facts['views'])} views"
    if "superpixels" in facts:
        line += f", {min(facts['superpixels'])} to {max(facts['superpixels'])} superpixels per view"
    if args.json or args.dry_run:
        print_document(document, f"would write {args.output}: {line}", as_json=args.json)
    else:
        say(f"{args.output}: {line}", quiet=args.quiet)


def _plan_panel(args: opt.Args, files: SceneFiles) -> Drawing:
    """Plan a picture of photo, before, after, ... of some views, one row each."""
    like = _frame_files(args, files)
    inputs = (*args.scenes, *input_files(files), *input_files(like))
    check_outputs((args.output,), inputs, overwrite=args.overwrite or args.dry_run)
    scenes, views, notes = _read(args, files, like, photos=True)
    used = list(views.used)
    cameras, photos = views.cameras[used], views.images
    ids = _choose(args, len(used), PANEL_VIEWS)

    def draw(_: int) -> Iterator[Picture]:
        from gsmerge.measure.preview import contact_sheet, view_pictures

        parts = [(path.name, gaussians) for path, gaussians in zip(args.scenes, scenes, strict=True)]
        own = None if photos is None else photos[used]
        how = {"background": args.background, "antialiased": args.antialiased}
        yield contact_sheet(view_pictures(parts, cameras, own, max_views=len(ids), **how))

    counts = {str(path): len(gaussians) for path, gaussians in zip(args.scenes, scenes, strict=True)}
    return [args.output], {"scenes": counts, "views": ids, "photos": photos is not None, "notes": notes}, draw


def _plan_views(args: opt.Args, files: SceneFiles) -> Drawing:
    """Plan one picture for each camera."""
    like = _frame_files(args, files)
    inputs = (*input_files(files), *input_files(like))
    check_folder(args.output, inputs, overwrite=args.overwrite or args.dry_run)
    (gaussians,), placed, notes = _read(args, files, like, photos=False)
    ids = _choose(args, len(placed.cameras))
    views, stems = placed.cameras[ids], picture_stems(placed.names)

    def draw(threads: int) -> Iterator[Picture]:
        from gsmerge.measure.preview import to_picture
        from gsmerge.render import render_in_turn

        how = {"background": args.background, "antialiased": args.antialiased}
        yield from map(to_picture, render_in_turn(gaussians, views, at_once=threads, **how))

    facts = {"width": views.width, "height": views.height, "num_gaussians": len(gaussians)}
    return [args.output / f"{stems[i]}.png" for i in ids], {**facts, "views": ids, "notes": notes}, draw


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
        from gsmerge.render.photos import scene_pictures
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
    from gsmerge.views import pick_views

    return pick_views(count, args.views or most or count)


def _frame_files(args: opt.Args, files: SceneFiles) -> SceneFiles:
    """Find the files of the scene whose frame the cameras are moved into."""
    from gsmerge.io import find_scene_files

    source = args.frame_of or source_of(files.ply)
    if source is None:
        return files
    return find_scene_files(source, cameras=args.cameras or files.cameras, images=args.images)


def _read(
    args: opt.Args, files: SceneFiles, like: SceneFiles, *, photos: bool
) -> tuple[list[Gaussians], SceneViews, list[str]]:
    """Read the scenes, and place the cameras in the frame of ``like``; notes are returned with them."""
    hints = args.hints() if photos else args.hints(max_side=MAX_SIDE)
    from gsmerge.io import place_cameras_in_scene, ply_notes, read_gaussians, read_ply_with_hints

    check_cameras(like)
    first = read_ply_with_hints(files.ply, opacity=args.opacity, hints=hints)
    others = [read_gaussians(path, opacity=args.opacity) for path in args.scenes[1:]]
    own = like.ply == files.ply
    framed = first if own else read_gaussians(like.ply)
    gaussians, views, placing = place_cameras_in_scene(framed, like, hints=hints, photos=photos)
    scenes = [gaussians if own else first.gaussians, *(ply.gaussians for ply in others)]
    notes = [*([] if own else ply_notes(first.info)), *placing]
    if others:
        names = [str(path) for path in args.scenes]
        notes = [f"{names[0]}: {note}" for note in notes]
        notes += [
            f"{name}: {note}" for name, ply in zip(names[1:], others, strict=True) for note in ply_notes(ply.info)
        ]
    return scenes, views, notes


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
