"""``gsmerge evaluate``: a scene and its compact versions against photos."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from gsmerge.cli import options as opt
from gsmerge.cli.console import announce_compilation, print_document, say_notes, stage_progress
from gsmerge.cli.held_out import file_names, held_out_views, lpips_networks, own_cameras, require_views
from gsmerge.cli.paths import check_outputs, input_files, write_texts
from gsmerge.errors import UsageError

if TYPE_CHECKING:
    from gsmerge.io import PlyInfo, PlyScene
    from gsmerge.types import Cameras

OUTSIDE = 0.03  # share of a result's Gaussians beyond all of its own views: what merging and a fit move there


def parse_zoom(text: str) -> tuple[float, ...]:
    """``--zoom``: numbers with commas between."""
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError:
        raise typer.BadParameter(f"expected sizes such as .5,1,2,4, got {text!r}") from None


def parse_align(text: str) -> tuple[str, ...]:
    """``--align``: names with commas between."""
    return tuple(part.strip() for part in text.split(","))


@opt.command(
    opt.SCENE,
    opt.argument("results", list[Path] | None, "[RESULTS]...", "Compact .ply files of that scene.", default=None),
    f"{opt.READING} {opt.TARGETS}",
    *opt.panel(
        opt.MEASURING,
        opt.option("views", int, "Use so many of the input views, at equal intervals, as the context, and the held-out "
                   "ones midway between them as targets.", wording="all", min=1),
        opt.option("context", bool, "Also measure the input views.", "--context/--no-context", default=True),
        opt.option("zoom", str, "Also measure PSNR and SSIM at other sizes: rendered at these multiples of the photos' "
                   "pixels per side.", wording="1", metavar="LIST", parser=parse_zoom),
        opt.option("align", str, "Also score held-out views after alignment with their photos: of the renders' colours "
                   "(color), of the cameras (pose), or both (color,pose).", metavar="LIST", parser=parse_align),
    ),
    "lpips lpips_views antialiased",
    *opt.panel(opt.OUTPUT, opt.option("csv", Path, "Write a row for each result and view to this file.")),
    "report overwrite threads",
)  # fmt: skip
def evaluate(args: opt.Args) -> None:
    """Measure compact scenes against photos: PSNR, SSIM, LPIPS, counts, sizes, render time."""
    if not args.context and args.targets is None:
        raise UsageError("--no-context: expected held-out views to measure instead; name them with --targets")
    if args.align and args.targets is None:
        raise UsageError("--align: expected held-out views, whose photos to align with; name them with --targets")
    from gsmerge.io import read_gaussians
    from gsmerge.measure.evaluate import EvaluateOptions
    from gsmerge.measure.evaluate import evaluate as evaluate_scene
    from gsmerge.measure.scores import evaluation_csv, evaluation_document, evaluation_lines
    from gsmerge.report import to_json

    files, paths = args.files(args.scene), args.results or []
    inputs = (*input_files(files), *paths, args.targets, args.target_images)
    check_outputs((args.csv, args.report), inputs, overwrite=args.overwrite)
    nets, missing = lpips_networks(args.lpips)
    with opt.usage_errors():
        options = EvaluateOptions(
            nets, args.lpips_views, args.context, threads=args.threads, antialiased=args.antialiased,
            **args.given(("zoom", "align")),
        )  # fmt: skip
    load = args.load(files)
    require_views(load)
    scene, held_out, adapted = held_out_views(load, args.targets, args.target_images, args.views)
    plys = {name: read_gaussians(path) for name, path in zip(file_names(paths), paths, strict=True)}
    cameras, moved = own_cameras(paths, scene)
    notes = [*load.notes, *adapted, *missing, *moved]
    if len(scene) < len(load.scene):
        notes += [_more_views(name, ply, scene.cameras) for name, ply in plys.items()]
    say_notes(notes, quiet=args.silent)
    gaussians = {name: ply.gaussians for name, ply in plys.items()}
    with announce_compilation(quiet=args.silent), stage_progress(quiet=args.silent) as progress:
        evaluation = evaluate_scene(scene, gaussians, held_out, options, cameras=cameras, progress=progress)
    facts = {"input": _file(load.ply), **{name: _file(ply.info) for name, ply in plys.items()}}
    document = evaluation_document(evaluation, facts, notes)
    texts = {args.report: to_json(document), args.csv: evaluation_csv(document)}
    write_texts({path: text for path, text in texts.items() if path is not None}, overwrite=args.overwrite)
    print_document(document, evaluation_lines(document), as_json=args.json, quiet=args.quiet)
    say_notes(evaluation.notes, quiet=args.silent)


def _more_views(name: str, ply: PlyScene, cameras: Cameras) -> str:
    """What is known of a result that is measured as one of some views, but may be made of all."""
    from gsmerge.measure.inspect import share_outside

    views, outside = len(cameras), share_outside(ply.gaussians[ply.valid], cameras)
    if outside > OUTSIDE:
        return (
            f"{name}: {100 * outside:.0f} % of its Gaussians lie outside of the {views} views of --views: it was made"
            f" of more views, so these are no scores of {views}"
        )
    return f"{name}: measured as a result of {views} views; if it was made of more, it has seen what it is asked here"


def _file(info: PlyInfo) -> dict[str, Any]:
    return {"path": info.path, "bytes": info.file_bytes, "bytes_by_attribute": info.bytes_by_attribute}
