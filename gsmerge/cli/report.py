"""``gsmerge report``: what compaction did to storage, render speed and quality."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from gsmerge.cli import options as opt
from gsmerge.cli.console import announce_compilation, print_document, say_notes
from gsmerge.cli.held_out import BeforeAfter, lpips_networks, read_before_after
from gsmerge.cli.paths import check_outputs, input_files, write_texts
from gsmerge.errors import SceneError, UsageError

if TYPE_CHECKING:
    from gsmerge.io import PlyInfo
    from gsmerge.measure.comparison import Storage

SUFFIXES = (".md", ".html", ".json")


def parse_sizes(text: str) -> tuple[int, ...]:
    """``--sizes``: numbers with commas between."""
    parts = text.split(",")
    if not all(part.strip().isdigit() and 1 <= int(part) <= 16384 for part in parts):
        raise typer.BadParameter(f"expected pixels such as 480,960, got {text!r}")
    return tuple(int(part) for part in parts)


@opt.command(
    opt.BEFORE,
    opt.AFTER,
    f"{opt.READING} {opt.TARGETS}",
    *opt.panel(
        opt.MEASURING,
        opt.option("sizes", str, "Longer sides of the pictures whose render time is measured.", parser=parse_sizes,
                   metavar="PIXELS,...", wording="the views' own, and twice that"),
        opt.option("merge_seconds", list[float], "Seconds that making each AFTER took; may be repeated, in their "
                   "order.", min=0.0),
        opt.option("compact_report", list[Path], "The --report of the compact run of each AFTER, instead."),
    ),
    "lpips",
    *opt.panel(
        opt.OUTPUT,
        opt.option("output", list[Path], "The file to write: .md, .html or .json; may be repeated.", "--output", "-o"),
    ),
    "overwrite threads",
)  # fmt: skip
def report(args: opt.Args) -> None:
    """Compare a scene with its compact versions: bytes, render time, overdraw, quality, break-even frames."""
    from gsmerge.measure.comparison import compare
    from gsmerge.measure.comparison_page import comparison_document, comparison_markdown
    from gsmerge.measure.evaluate import INPUT, EvaluateOptions

    files, after, outputs = args.files(args.before), args.after, args.output or []
    for path in outputs:
        if path.suffix not in SUFFIXES:
            raise UsageError(f"{path}: expected a name that ends in {', '.join(SUFFIXES)}")
    inputs = (*input_files(files), *after, *(args.compact_report or []), args.targets, args.target_images)
    check_outputs(outputs, inputs, overwrite=args.overwrite)
    seconds = _merge_seconds(after, args.merge_seconds, args.compact_report)
    nets, missing = lpips_networks(args.lpips)
    given = read_before_after(args, files)
    notes = [*given.notes, *missing]
    say_notes(notes, quiet=args.silent)
    storage = {INPUT: _storage(given.load.ply), **{name: _storage(ply.info) for name, ply in given.plys.items()}}
    with announce_compilation(quiet=args.silent):
        comparison = compare(
            given.scene, given.gaussians, storage, given.held_out, EvaluateOptions(nets, threads=args.threads),
            cameras=given.cameras, long_sides=args.sizes,
            merge_seconds=dict(zip(given.plys, seconds, strict=False)),
        )  # fmt: skip
    document = comparison_document(comparison, notes)
    for path in outputs:
        _write(path, document, given, overwrite=args.overwrite)
    lines = comparison_markdown(document).rstrip().split("\n")
    print_document(document, lines, as_json=args.json, quiet=args.quiet or bool(outputs))
    say_notes(comparison.quality.notes, quiet=args.silent or not outputs)


def _merge_seconds(
    after: Sequence[Path], seconds: Sequence[float] | None, reports: Sequence[Path] | None
) -> Sequence[float]:
    """Seconds that making each result took; empty where not given."""
    if seconds and reports:
        raise UsageError("--merge-seconds and --compact-report: expected one of them")
    given = seconds or reports or []
    if given and len(given) != len(after):
        raise UsageError(f"expected the merge time of each of {len(after)} AFTER, got {len(given)}")
    return [_seconds_of(path) for path in reports] if reports else list(seconds or [])


def _seconds_of(path: Path) -> float:
    from gsmerge.io import read_json

    document = read_json(path)
    seconds = document.get("total_seconds") if isinstance(document, dict) else None
    if not isinstance(seconds, int | float) or isinstance(seconds, bool) or not 0 <= seconds < 1e9:
        raise SceneError(path, "expected the report of a compact run (total_seconds), found none")
    return float(seconds)


def _storage(info: PlyInfo) -> Storage:
    from gsmerge.measure.comparison import Storage

    return Storage(info.path, info.count, info.file_bytes, info.bytes_by_attribute)


def _write(path: Path, document: Mapping[str, Any], given: BeforeAfter, *, overwrite: bool) -> None:
    from gsmerge.measure.comparison_page import comparison_markdown
    from gsmerge.measure.evaluate import near_plane
    from gsmerge.measure.preview import view_pictures
    from gsmerge.report import to_json

    if path.suffix == ".html":
        from gsmerge.view.report_page import report_page

        scene = given.scene
        parts = [("before", scene.file_gaussians), *given.gaussians.items()]
        pictures = view_pictures(parts, scene.cameras, scene.images, max_views=2, near=near_plane(scene))
        text = report_page(document, pictures)
    else:
        text = comparison_markdown(document) if path.suffix == ".md" else to_json(document)
    write_texts({path: text}, overwrite=overwrite)
