"""``gsmerge extend``: add views that arrive in batches to a state."""

from __future__ import annotations

import sys
from pathlib import Path
from time import perf_counter
from typing import Any

from gsmerge.cli import parameters as opt
from gsmerge.cli.console import print_document, say_notes, stage_progress
from gsmerge.cli.paths import input_files
from gsmerge.errors import UsageError
from gsmerge.settings.compact import CompactOptions
from gsmerge.settings.extend import ExtendOptions
from gsmerge.settings.reading import NONE


@opt.command(
    opt.argument("state", Path, "STATE", "A .gsm file; the first batch creates it."),
    opt.argument(
        "scenes", list[Path], "SCENE...", "Batches of new views, in order; each is a scene as compact takes it."
    ),
    opt.READING,
    "dry_run",
    opt.settings_option(CompactOptions, ExtendOptions, example="budget=2%"),
)
def extend(args: opt.Args) -> None:
    """Compact new views and add them to a state, from which gsmerge compact makes a result at any time."""
    from gsmerge.io.formats.table import STATE_ENDING

    if args.state.suffix.lower() != STATE_ENDING:
        raise UsageError(f"{args.state}: expected a state whose name ends in {STATE_ENDING}")
    hints, scenes = args.hints(), args.scenes
    if len(scenes) > 1 and {args.cameras, args.images} - {None, NONE}:
        raise UsageError("--cameras and --images: expected one batch with them, got several; add one batch at a time")
    from gsmerge.states.files import batch_line, extend_file

    settings = args.values(CompactOptions, ExtendOptions)
    batches = [args.files(scene) for scene in scenes]
    for files in batches:
        if any(path.resolve() == args.state.resolve() for path in input_files(files)):
            raise UsageError(f"{args.state}: expected a state other than the input; name another file")
    documents, trial_state = list[dict[str, Any]](), None  # in a dry run, the state that no file holds
    for files in batches:
        before = {"import": perf_counter() - args.start} if not documents else {}
        with stage_progress(quiet=args.silent) as progress:
            document, state = extend_file(
                args.state, files, settings, opacity=args.opacity, hints=hints, progress=progress,
                seconds_before=before, dry_run=args.dry_run, tried=trial_state,
            )  # fmt: skip
        trial_state = state if args.dry_run else None
        documents.append(document)
        say_notes(document["notes"], quiet=args.silent)
        if not args.silent:
            print_document(document, batch_line(document), as_json=False)
    if args.json:
        from gsmerge.measure.documents import document_head, note_entries, to_json

        notes = note_entries(note for document in documents for note in document["notes"])
        sys.stdout.write(to_json(document_head() | {"batches": documents} | notes))
