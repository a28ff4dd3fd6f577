"""``gsmerge report``: what compaction did to storage, render speed and quality."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from gsmerge.cli import options as opt
from gsmerge.cli.console import announce_compilation, one_line, say, say_notes
from gsmerge.cli.held_out import file_names, held_out_views, networks
from gsmerge.cli.paths import check_outputs, input_files
from gsmerge.cli.settings import reading_of
from gsmerge.errors import SceneError, UsageError

if TYPE_CHECKING:
    from gsmerge.io import PlyInfo
    from gsmerge.measure.comparison import Storage
    from gsmerge.types import Gaussians, PixelScene, UnalignedScene

SUFFIXES = (".md", ".html", ".json")


def parse_sizes(text: str) -> tuple[int, ...]:
    """``--sizes``: numbers with commas between."""
    parts = text.split(",")
    if not all(part.strip().isdigit() and 1 <= int(part) <= 16384 for part in parts):
        raise typer.BadParameter(f"expected pixels such as 480,960, got {text!r}")
    return tuple(int(part) for part in parts)


def report(
    before: Annotated[Path, typer.Argument(metavar="BEFORE", help="The scene: a .ply or its folder.")],
    after: Annotated[list[Path], typer.Argument(metavar="AFTER...", help="Compact .ply files of that scene.")],
    output: Annotated[
        list[Path] | None,
        typer.Option(
            "--output", "-o", help="Write it here: .md, .html or .json; may be repeated.", rich_help_panel=opt.OUTPUT
        ),
    ] = None,
    cameras: opt.CamerasOption = None,
    images: opt.ImagesOption = None,
    opacity: opt.OpacityOption = opt.Opacity.auto,
    exporter: opt.DialectOption = "auto",
    quats: opt.QuatsOption = opt.Quats.auto,
    order: opt.OrderOption = opt.Order.auto,
    scene_scale: opt.SceneScaleOption = None,
    max_side: opt.MaxSideOption = None,
    targets: opt.TargetsOption = None,
    target_images: opt.TargetImagesOption = None,
    sizes: Annotated[
        str | None,
        typer.Option(
            parser=parse_sizes,
            metavar="PIXELS,...",
            help="Longer sides of the pictures whose render time is measured.",
            show_default="the views' own, and twice that",
            rich_help_panel=opt.MEASURING,
        ),
    ] = None,
    merge_seconds: Annotated[
        list[float] | None,
        typer.Option(
            min=0.0, help="What making each AFTER took; may be repeated, in their order.", rich_help_panel=opt.MEASURING
        ),
    ] = None,
    compact_report: Annotated[
        list[Path] | None,
        typer.Option(help="The --report of the compact run of each AFTER, instead.", rich_help_panel=opt.MEASURING),
    ] = None,
    lpips: opt.LpipsOption = None,
    threads: opt.ThreadsOption = None,
    overwrite: opt.OverwriteOption = False,
    json: opt.JsonOption = False,
    quiet: opt.QuietOption = False,
    debug: opt.DebugOption = False,
) -> None:
    """Compare a scene with its compact versions: bytes, render time, overdraw, quality, break-even frames."""
    hints = reading_of(exporter, quats.value, order.value, scene_scale, max_side)
    from gsmerge.io import find_scene_files, load_files, read_ply
    from gsmerge.measure.comparison import compare
    from gsmerge.measure.comparison_page import comparison_document
    from gsmerge.measure.evaluate import INPUT, EvaluateOptions
    from gsmerge.runtime.run_log import RunLog
    from gsmerge.stages.place_cameras import add_views
    from gsmerge.types import UnalignedScene

    files = find_scene_files(before, cameras=cameras, images=images)
    for path in output or []:
        if path.suffix not in SUFFIXES:
            raise UsageError(f"{path}: expected a name that ends in {', '.join(SUFFIXES)}")
    inputs = (*input_files(files), *after, *(compact_report or []), targets, target_images)
    check_outputs(output or [], inputs, overwrite=overwrite)
    seconds = _merge_seconds(after, merge_seconds, compact_report)
    nets, missing = networks(lpips)
    load = load_files(files, opacity=opacity.value, hints=hints)
    scene, held_out, adapted = held_out_views(load, targets, target_images, None)
    log = RunLog()
    if isinstance(scene, UnalignedScene):
        scene = add_views(scene, log)
    plys = {name: read_ply(path) for name, path in zip(file_names(after), after, strict=True)}
    notes = [*load.notes, *adapted, *log.notes, *missing]
    say_notes(notes, quiet=quiet or json)
    storage = {INPUT: _storage(load.ply), **{name: _storage(ply.info) for name, ply in plys.items()}}
    gaussians = {name: ply.gaussians for name, ply in plys.items()}
    with announce_compilation(quiet=quiet or json):
        found = compare(
            scene, gaussians, storage, held_out, EvaluateOptions(nets, threads=threads),
            long_sides=sizes, merge_seconds=dict(zip(plys, seconds, strict=False)),  # type: ignore[arg-type]
        )  # fmt: skip
    document = comparison_document(found, notes)
    for path in output or []:
        _write(path, document, scene, gaussians, overwrite=overwrite)
    _tell(document, found.quality.notes, written=bool(output), as_json=json, quiet=quiet)


def _merge_seconds(
    after: Sequence[Path], told: Sequence[float] | None, reports: Sequence[Path] | None
) -> Sequence[float]:
    """What making each result took; empty where nobody said."""
    if told and reports:
        raise UsageError("--merge-seconds and --compact-report: expected one of them")
    given = told or reports or []
    if given and len(given) != len(after):
        raise UsageError(f"expected the merge time of each of {len(after)} AFTER, got {len(given)}")
    return [_seconds_of(path) for path in reports] if reports else list(told or [])


def _seconds_of(path: Path) -> float:
    from gsmerge.io import read_json

    found = read_json(path)
    seconds = found.get("total_seconds") if isinstance(found, dict) else None
    if not isinstance(seconds, int | float) or isinstance(seconds, bool) or not 0 <= seconds < 1e9:
        raise SceneError(path, "expected the report of a compact run (total_seconds), found none")
    return float(seconds)


def _storage(info: PlyInfo) -> Storage:
    from gsmerge.measure.comparison import Storage

    return Storage(info.path, info.count, info.file_bytes, info.bytes_by_attribute)


def _write(
    path: Path,
    document: Mapping[str, Any],
    scene: PixelScene | UnalignedScene,
    gaussians: Mapping[str, Gaussians],
    *,
    overwrite: bool,
) -> None:
    from gsmerge.cli.pictures import png_bytes
    from gsmerge.io import atomic_output
    from gsmerge.measure.comparison_page import comparison_html, comparison_markdown
    from gsmerge.measure.evaluate import near_plane
    from gsmerge.measure.preview import contact_sheet
    from gsmerge.report import to_json

    if path.suffix == ".html":
        parts = [("before", scene.file_gaussians), *gaussians.items()]
        sheet = contact_sheet(parts, scene.cameras, scene.images, max_views=2, near=near_plane(scene))
        text = comparison_html(document, png_bytes(sheet))
    else:
        text = comparison_markdown(document) if path.suffix == ".md" else to_json(document)
    with atomic_output(path, overwrite=overwrite) as temporary:
        temporary.write_text(text, encoding="utf-8", errors="replace")


def _tell(document: Mapping[str, Any], notes: Sequence[str], *, written: bool, as_json: bool, quiet: bool) -> None:
    from gsmerge.measure.comparison_page import comparison_markdown
    from gsmerge.report import to_json

    if as_json:
        sys.stdout.write(to_json(document))
    elif not quiet and not written:
        print("\n".join(map(one_line, comparison_markdown(document).rstrip().split("\n"))))
    if not (quiet or as_json):
        for note in notes if written else ():
            say(f"note: {note}")
