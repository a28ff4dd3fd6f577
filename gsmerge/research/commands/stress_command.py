"""``gsmerge stress``: a user's own scene under bad conditions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from gsmerge.cli import parameters as opt
from gsmerge.cli.before_after import held_out_views, require_views
from gsmerge.cli.console import print_document, say_notes, stage_progress
from gsmerge.cli.paths import check_outputs, input_files, write_texts
from gsmerge.errors import TargetError

if TYPE_CHECKING:
    from gsmerge.research.stress import StressOutcome


@opt.command(
    opt.SCENE,
    f"{opt.READING} {opt.TARGETS} set",
    *opt.panel(opt.MEASURING, opt.option("cases", str, "Run only these cases.", wording="all", metavar="NAME,...")),
    "report overwrite threads",
)
def stress(args: opt.Args) -> None:
    """Compact a scene under bad conditions, and say of each whether the result holds."""
    hints = args.hints()
    from gsmerge.report import document_head, to_json
    from gsmerge.research.stress import stress as stress_scene

    files = args.files(args.scene)
    check_outputs([args.report], (*input_files(files), args.targets, args.target_images), overwrite=args.overwrite)
    settings = args.settings()
    load = args.load(files)
    require_views(load)
    _, held_out, adapted = held_out_views(load, args.targets, args.target_images, None)
    notes = [*load.notes, *adapted]
    say_notes(notes, quiet=args.silent)
    names = None if args.cases is None else [name.strip() for name in args.cases.split(",")]
    with stage_progress(quiet=args.silent) as progress:
        outcomes = stress_scene(load, settings, targets=held_out, cases=names, hints=hints, progress=progress)
    document = {
        **document_head(),
        "input": str(files.ply),
        "options": settings.to_dict(),
        "cases": [outcome.to_dict() for outcome in outcomes],
        "held": sum(outcome.passed is True for outcome in outcomes),
        "failed": sum(outcome.passed is False for outcome in outcomes),
        "notes": notes,
    }
    if args.report is not None:
        write_texts({args.report: to_json(document)}, overwrite=args.overwrite)
    print_document(document, _lines(outcomes), as_json=args.json, quiet=args.quiet)
    failed = [outcome.case for outcome in outcomes if outcome.passed is False]
    if failed:
        raise TargetError(f"{len(failed)} of {len(outcomes)} cases failed: {', '.join(failed)}")


def _lines(outcomes: Sequence[StressOutcome]) -> list[str]:
    """Write one line for each case, and the number of passed cases."""
    marks = {True: "held", False: "FAILED", None: "-"}
    width = max((len(outcome.change) for outcome in outcomes), default=0)
    lines = [f"{marks[o.passed]:<7} {o.change:<{width}}  {o.measured}" for o in outcomes]
    lines += [f"        expected of '{o.change}': {o.expected}" for o in outcomes if o.passed is False]
    tried = [outcome for outcome in outcomes if outcome.passed is not None]
    return [*lines, f"{sum(o.passed is True for o in tried)} of {len(tried)} held"]
