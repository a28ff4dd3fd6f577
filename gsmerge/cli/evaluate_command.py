"""``gsmerge evaluate``: a scene and its compact versions: quality against photos, bytes, render time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from gsmerge.cli import parameters as opt
from gsmerge.cli.before_after import BeforeAfter, lpips_networks, read_before_after
from gsmerge.cli.console import print_document, say_notes, stage_progress
from gsmerge.cli.paths import check_outputs, input_files, write_texts
from gsmerge.errors import SceneError, UsageError

if TYPE_CHECKING:
    from gsmerge.io import GaussianFile
    from gsmerge.types import Cameras

OUTSIDE = 0.03  # share of a result's Gaussians beyond all of its own views: what merging and a fit move there
SUFFIXES = (".json", ".csv", ".md", ".html")
SPEED_ZOOMS = (1.0, 2.0)  # sizes of pictures whose render time is measured where --zoom names none
PAGE_VIEWS = 2  # pictures on a page


def parse_zoom(text: str) -> tuple[float, ...]:
    """Parse ``--zoom``: numbers with commas between."""
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError:
        raise typer.BadParameter(f"expected sizes such as .5,1,2,4, got {text!r}") from None


@opt.command(
    opt.BEFORE,
    opt.AFTER,
    f"{opt.READING} masks {opt.TARGETS}",
    *opt.panel(
        opt.MEASURING,
        opt.option("views", int, "Use so many of the input views, at equal intervals, as the context, and the held-out "
                   "ones midway between them as targets.", wording="all", min=1),
        opt.option("context", bool, "Also measure the input views.", "--context/--no-context", default=True),
    ),
    "photo_side",
    *opt.panel(
        opt.MEASURING,
        opt.option("zoom", str, "Also measure PSNR and SSIM at other sizes: rendered at these multiples of the photos' "
                   "pixels per side.", wording="1", metavar="LIST", parser=parse_zoom),
    ),
    "lpips lpips_views antialiased",
    *opt.panel(
        opt.MEASURING,
        opt.switch("speed", "Also measure render time, at the sizes of --zoom or at 1 and 2, and Gaussians per pixel."),
        opt.option("merge_seconds", list[str], "Seconds that making each AFTER took, or the --report of its compact "
                   "run, to say after how many frames they are earned back; repeated in their order.",
                   metavar="SECONDS|REPORT"),
    ),
    *opt.panel(
        opt.OUTPUT,
        opt.option("output", list[Path], "A file to write: .json, .csv (a row for each result and view), .md, or .html "
                   "with pictures; may be repeated.", "--output", "-o"),
    ),
    "overwrite threads",
)  # fmt: skip
def evaluate(args: opt.Args) -> None:
    """Measure a scene and its compact versions against photos: PSNR, SSIM, LPIPS, fog, counts, bytes, render time."""
    if not args.context and args.targets is None:
        raise UsageError("--no-context: expected held-out views to measure instead; name them with --targets")
    from gsmerge.measure.evaluate import EvaluateOptions
    from gsmerge.measure.evaluate import evaluate as evaluate_scene
    from gsmerge.measure.scores import evaluation_document, evaluation_lines

    args.after = args.after or []
    files, outputs = args.files(args.before), args.output or []
    for path in outputs:
        if path.suffix not in SUFFIXES:
            raise UsageError(f"{path}: expected a name that ends in {', '.join(SUFFIXES)}")
    makings = args.merge_seconds or []
    inputs = (*input_files(files), *args.after, args.targets, args.target_images, *map(Path, makings))
    check_outputs(outputs, inputs, overwrite=args.overwrite)
    if makings and len(makings) != len(args.after):
        raise UsageError(f"--merge-seconds: expected that of each of {len(args.after)} AFTER, got {len(makings)}")
    seconds = [_seconds_of(text) for text in makings]
    nets, missing = lpips_networks(args.lpips)
    with opt.usage_errors():
        options = EvaluateOptions(
            nets, args.lpips_views, args.context, threads=args.threads, antialiased=args.antialiased,
            **args.given(("photo_side", "zoom")),
        )  # fmt: skip
    with stage_progress(quiet=args.silent) as progress:
        progress("read", 0, 0)
        pair = read_before_after(args, files)
    notes = [*pair.notes, *missing]
    if len(pair.scene) < len(pair.load.scene):
        notes += [_more_views(name, ply, pair.scene.cameras) for name, ply in pair.plys.items()]
    say_notes(notes, quiet=args.silent)
    with stage_progress(quiet=args.silent) as progress:
        evaluation = evaluate_scene(
            pair.scene, pair.gaussians, pair.held_out, options, cameras=pair.cameras, progress=progress
        )
        facts = _facts(args, pair, dict(zip(pair.plys, seconds, strict=False)))
    document = evaluation_document(evaluation, facts, notes)
    _write(outputs, document, pair, overwrite=args.overwrite)
    print_document(document, evaluation_lines(document), as_json=args.json, quiet=args.quiet)
    say_notes(evaluation.notes, quiet=args.silent)


def _facts(args: opt.Args, pair: BeforeAfter, seconds: Mapping[str, float]) -> dict[str, dict[str, Any]]:
    """Collect facts about each file by name, with the cost of drawing if requested."""
    from gsmerge.measure.evaluate import INPUT, near_plane
    from gsmerge.measure.sizes import shrink_cameras
    from gsmerge.measure.speed import measure_costs

    infos = {INPUT: pair.load.info, **{name: ply.info for name, ply in pair.plys.items()}}
    facts: dict[str, dict[str, Any]] = {
        name: {"path": info.path, "bytes": info.file_bytes, "bytes_by_attribute": info.bytes_by_attribute}
        for name, info in infos.items()
    }
    if args.speed or args.merge_seconds:
        scenes = {INPUT: pair.scene.file_gaussians, **pair.gaussians}
        cameras = shrink_cameras(pair.scene.cameras, args.photo_side or 0)
        zooms, near = args.zoom or SPEED_ZOOMS, near_plane(pair.scene)
        costs = measure_costs(scenes, cameras, zooms, near, merge_seconds=seconds, threads=args.threads)
        facts = {name: facts[name] | costs[name] for name in facts}
    return facts


def _seconds_of(text: str) -> float:
    from gsmerge.io import read_json

    try:
        seconds: Any = float(text)
    except ValueError:
        document = read_json(Path(text))
        seconds = document.get("total_seconds") if isinstance(document, dict) else None
    if not isinstance(seconds, int | float) or isinstance(seconds, bool) or not 0 <= seconds < 1e9:
        raise SceneError(Path(text), "expected seconds or the report of a compact run (total_seconds), found neither")
    return float(seconds)


def _more_views(name: str, ply: GaussianFile, cameras: Cameras) -> str:
    """Describe a result that is measured as one made from some of the views, but may be made from all."""
    from gsmerge.measure.visibility import share_outside

    views, outside = len(cameras), share_outside(ply.gaussians[ply.valid], cameras)
    if outside > OUTSIDE:
        return (
            f"{name}: {100 * outside:.0f} % of its Gaussians lie outside of the {views} views of --views: it was made"
            f" of more views, so these are no scores of {views}"
        )
    return f"{name}: measured as a result of {views} views; if it was made of more, it has seen what it is asked here"


def _write(outputs: Sequence[Path], document: Mapping[str, Any], pair: BeforeAfter, *, overwrite: bool) -> None:
    """Write the files, each in the format of its ending."""
    from gsmerge.measure.scores import evaluation_csv, evaluation_markdown
    from gsmerge.report import to_json

    writers = {".json": to_json, ".csv": evaluation_csv, ".md": evaluation_markdown}
    texts = {path: writers[path.suffix](document) for path in outputs if path.suffix in writers}
    if len(texts) < len(outputs):
        from gsmerge.measure.evaluate import near_plane
        from gsmerge.measure.preview import view_pictures
        from gsmerge.pages.page import report_page

        scene = pair.scene
        parts, near = [("before", scene.file_gaussians), *pair.gaussians.items()], near_plane(scene)
        pictures = view_pictures(parts, scene.cameras, scene.images, max_views=PAGE_VIEWS, near=near)
        texts |= {path: report_page(document, pictures) for path in outputs if path not in texts}
    write_texts(texts, overwrite=overwrite)
