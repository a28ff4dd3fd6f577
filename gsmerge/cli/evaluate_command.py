"""``gsmerge evaluate``: measure quality, bytes and render time of a scene and its compact versions."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gsmerge.cli import parameters as opt
from gsmerge.cli.before_after import BeforeAfter, lpips_networks, read_before_after
from gsmerge.cli.console import print_document, say_notes, stage_progress, terminal_columns
from gsmerge.cli.paths import check_folder, check_outputs, check_replaced, input_files, write_texts
from gsmerge.errors import SceneError, UsageError
from gsmerge.settings.evaluate import EvaluateOptions
from gsmerge.settings.setting import Settings, setting

if TYPE_CHECKING:
    from gsmerge.measure.evaluate import Evaluation
    from gsmerge.pages.data import Stills

PAGE = ".html"
SUFFIXES = (".json", ".csv", ".md", PAGE)
SPEED_ZOOMS = (1.0, 2.0)  # picture sizes for render times, unless `zoom` is given


@dataclass(frozen=True)
class MeasuringOptions(Settings):
    """Settings of the command besides those of :func:`gsmerge.evaluate`."""

    views: int | None = setting(None, "Number of input views to use as the context, at equal intervals; the "
        "held-out views midway between them are the targets.", least=1, shown="all")  # fmt: skip
    masks: str | None = setting(None, "Folder of masks with the names of the photos, dark where a photo does not "
        "count.",
        shown="masks beside the photos")  # fmt: skip
    speed: bool = setting(False, "Also measure the render time, at the sizes of `zoom` or at 1 and 2, and the "
        "Gaussians per pixel.")  # fmt: skip
    merge_seconds: tuple[float | str, ...] = setting((), "Seconds that it took to make each AFTER, or the JSON report "
        "of its run; gives the number of frames after which this time is saved.", metavar="LIST")  # fmt: skip


@opt.command(
    opt.BEFORE,
    opt.AFTER,
    f"{opt.READING} {opt.TARGETS}",
    "lpips",
    opt.settings_option(EvaluateOptions, MeasuringOptions, example="context=false, photo_side=476 or speed=true"),
    *opt.panel(
        opt.OUTPUT,
        opt.option("output", list[Path], "File to write: .json, .csv (a row for each result and view), .md, or .html "
                   "(the page of gsmerge view with these scores); may be repeated.", "--output", "-o"),
        opt.option("maps", Path, "Folder for a picture of each result and view: photo, result, and a map of the likely "
                   "error of new views, estimated by the photos of other views.", metavar="DIR"),
    ),
)  # fmt: skip
def evaluate(args: opt.Args) -> None:
    """Measure a scene and its compact versions against photos: PSNR, SSIM, LPIPS, fog, counts, bytes, render time."""
    args.after = args.after or []
    args.lpips, lpips_notes = lpips_networks(args.lpips)
    options, measuring = args.make(EvaluateOptions, MeasuringOptions)
    if not options.context and args.targets is None:
        raise UsageError("context=false: expected held-out views to measure instead; name them with --targets")
    args.views, args.masks = measuring.views, None if measuring.masks is None else opt.named_or_none(measuring.masks)
    files, outputs = args.files(args.before), args.output or []
    if args.quiet and not (outputs or args.json or args.maps):
        raise UsageError("--quiet: expected -o, --maps or --json with it, since otherwise nothing is shown or written")
    _check_files(args, outputs, measuring, input_files(files))
    if args.maps is not None:
        check_folder(args.maps, tuple(input_files(files)), overwrite=True)
    seconds = [_read_seconds(value) for value in measuring.merge_seconds]
    from gsmerge.measure.evaluate import evaluate as evaluate_scene
    from gsmerge.measure.scores import evaluation_document, evaluation_lines
    from gsmerge.pages.data import still_keeper

    with stage_progress(quiet=args.silent) as progress:
        progress("read", 0, 0)
        pair = read_before_after(args, files)
    if args.maps is not None:
        from gsmerge.measure.error_maps import require_photos

        require_photos(pair.scene, pair.load.files.ply)
    notes = [*pair.notes, *lpips_notes]
    if pair.plys and len(pair.scene) < len(pair.load.scene):
        notes.append(
            f"scores assume results of {len(pair.scene)} views; a result of more views has seen the held-out photos"
        )
    say_notes(notes, quiet=args.silent)
    stills: Stills = {}
    hooks = {"on_image": still_keeper(stills)} if any(path.suffix == PAGE for path in outputs) else {}
    with stage_progress(quiet=args.silent) as progress:
        evaluation = evaluate_scene(
            pair.scene, pair.gaussians, pair.held_out, options, cameras=pair.cameras, progress=progress, **hooks
        )
        facts = _facts(pair, options, measuring, dict(zip(pair.plys, seconds, strict=False)))
    document = evaluation_document(evaluation, facts, notes)
    _write(outputs, document, pair, evaluation, stills)
    lines = evaluation_lines(document, terminal_columns(sys.stdout))
    document["maps"] = []
    if args.maps is not None:
        document["maps"] = [str(path) for path in _write_maps(args.maps, pair, context=options.context)]
        lines.append(f"maps: {len(document['maps'])} pictures in {args.maps}")
    print_document(document, lines, as_json=args.json, quiet=args.quiet, wrap=False)
    say_notes(evaluation.notes, quiet=args.silent)


def _check_files(args: opt.Args, outputs: Sequence[Path], measuring: MeasuringOptions, inputs: Sequence[Path]) -> None:
    """Raise UsageError if an output cannot be written, or if ``merge_seconds`` has not one value per result."""
    for path in outputs:
        if path.suffix not in SUFFIXES:
            raise UsageError(f"{path}: expected a name ending in {opt.join_words(SUFFIXES)}")
    reports = [Path(value) for value in measuring.merge_seconds if isinstance(value, str)]
    check_outputs(outputs, (*inputs, *args.after, args.targets, args.target_images, *reports), overwrite=True)
    check_replaced(outputs)
    if measuring.merge_seconds and len(measuring.merge_seconds) != len(args.after):
        raise UsageError(
            f"merge_seconds: expected one value for each of {len(args.after)} AFTER, got {len(measuring.merge_seconds)}"
        )


def _facts(
    pair: BeforeAfter, options: EvaluateOptions, measuring: MeasuringOptions, seconds: Mapping[str, float]
) -> dict[str, dict[str, Any]]:
    """Collect facts about each file by name, with the cost of rendering if requested."""
    from gsmerge.measure.evaluate import INPUT, near_plane
    from gsmerge.measure.sizes import shrink_cameras
    from gsmerge.measure.speed import measure_costs

    infos = {INPUT: pair.load.info, **{name: ply.info for name, ply in pair.plys.items()}}
    facts: dict[str, dict[str, Any]] = {
        name: {"path": info.path, "bytes": info.file_bytes, "bytes_by_attribute": info.bytes_by_attribute}
        for name, info in infos.items()
    }
    if measuring.speed or measuring.merge_seconds:
        scenes = {INPUT: pair.scene.file_gaussians, **pair.gaussians}
        cameras = shrink_cameras(pair.scene.cameras, options.photo_side)
        zooms = SPEED_ZOOMS if options.zoom == EvaluateOptions().zoom else options.zoom
        near = near_plane(pair.scene)
        costs = measure_costs(scenes, cameras, zooms, near, merge_seconds=seconds, threads=options.threads)
        facts = {name: facts[name] | costs[name] for name in facts}
    return facts


def _read_seconds(value: float | str) -> float:
    """Return a number of seconds, or read it from the report of a run if ``value`` is a path."""
    seconds: Any = value
    if isinstance(value, str):
        from gsmerge.io import read_json

        document = read_json(Path(value))
        seconds = document.get("total_seconds") if isinstance(document, dict) else None
    if not isinstance(seconds, int | float) or isinstance(seconds, bool) or not 0 <= seconds < 1e9:
        raise SceneError(
            Path(str(value)), "expected seconds or the report of a compact run (total_seconds), found neither"
        )
    return float(seconds)


def _write(
    outputs: Sequence[Path], document: Mapping[str, Any], pair: BeforeAfter, evaluation: Evaluation, stills: Stills
) -> None:
    """Write the reports, each in the format of its ending."""
    from gsmerge.measure.scores import evaluation_csv, evaluation_markdown
    from gsmerge.report import to_json

    writers = {".json": to_json, ".csv": evaluation_csv, ".md": evaluation_markdown}
    texts: dict[Path, str | bytes] = {}
    texts |= {path: writers[path.suffix](document) for path in outputs if path.suffix in writers}
    if stills:
        from gsmerge.pages.data import page_data
        from gsmerge.pages.page import view_page

        sizes = [result["bytes"] for result in document["results"]]
        data = page_data(
            pair.title, pair.scene, pair.gaussians, sizes, pair.held_out, evaluation, stills, cameras=pair.cameras
        )
        texts |= {path: view_page(data) for path in outputs if path not in texts}
    write_texts(texts, overwrite=True)


def _write_maps(folder: Path, pair: BeforeAfter, *, context: bool) -> list[Path]:
    """Write a sheet of each result and view into a folder, named after both; return the paths."""
    from gsmerge.measure.drawings import picture_stems
    from gsmerge.measure.error_maps import draw_sheets
    from gsmerge.measure.evaluate import INPUT
    from gsmerge.measure.preview import save_picture

    views = picture_stems([*pair.scene.names, *(() if pair.held_out is None else pair.held_out.names)])
    results, paths = pair.gaussians or {INPUT: pair.scene.file_gaussians}, list[Path]()
    stems = dict(
        zip(results, picture_stems([Path(name).with_suffix(".png").as_posix() for name in results]), strict=True)
    )
    sheets = draw_sheets(pair.scene, results, pair.held_out, pair.cameras, context=context)
    for name, view, sheet in sheets:
        paths.append(folder / f"{stems[name]}.{views[view]}.map.png")
        folder.mkdir(parents=True, exist_ok=True)
        save_picture(paths[-1], sheet)
    return paths
