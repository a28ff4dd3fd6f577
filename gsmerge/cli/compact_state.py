"""``gsmerge compact STATE.gsm``: the main job, where the views are in a state of ``gsmerge extend`` already."""

from __future__ import annotations

from dataclasses import replace
from time import perf_counter

from gsmerge.cli import parameters as opt
from gsmerge.cli.console import print_document, say_notes, stage_progress
from gsmerge.cli.paths import FileOptions, check_format, check_outputs, default_output
from gsmerge.errors import UsageError
from gsmerge.settings.extend import SUFFIX

# Arguments and options of ``compact`` that say something about a state, too
ALLOWED = (
    "scenes", "k", "budget", "fit", "effort", "device", "set", "output", "overwrite", "dry_run", "json", "quiet",
    "seed", "threads",
)  # fmt: skip


def compact_state(args: opt.Args, start: float) -> None:
    """Write a compact scene of a state, fitted to its photos; ``start``: the time when the command began."""
    path = next(path for path in args.scenes if path.suffix.lower() == SUFFIX)
    if len(args.scenes) > 1:
        raise UsageError(f"{path}: expected a state alone, got {len(args.scenes)} inputs")
    for name, value in vars(args).items():
        if value and name not in ALLOWED and value != opt.OPTIONS[name].default:
            flag = f"--{name.replace('_', '-')}"
            raise UsageError(
                f"{flag}: expected a scene with it, {path} is a state, which gsmerge extend makes of scenes"
            )
    out = args.output or default_output(path)
    check_outputs((out,), (path,), overwrite=args.overwrite or args.dry_run)
    from gsmerge.fit import FitOptions
    from gsmerge.settings.compact import CompactOptions
    from gsmerge.states.files import compact_file, compact_line

    left = {"viewer_cameras": False, "columns": "needed"}  # a state has no names of views
    wanted, writing = args.make(FitOptions, FileOptions, **left)
    check_format(out, writing)
    run = args.given(("effort", "device", "seed", "threads"))
    with opt.usage_errors():
        settings = replace(CompactOptions(fit=wanted), **run)
    before = {"import": perf_counter() - start}
    with stage_progress(quiet=args.silent) as progress:
        document = compact_file(
            path, out, settings, k=args.k, budget=args.budget, always_fit=args.fit is not None,
            normals=writing.normals, spz_version=writing.spz_version, overwrite=args.overwrite,
            dry_run=args.dry_run, progress=progress, seconds_before=before,
        )  # fmt: skip
    say_notes(document["notes"], quiet=args.silent)
    print_document(document, compact_line(document), as_json=args.json, quiet=args.quiet and not args.dry_run)
