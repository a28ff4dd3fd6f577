"""``gsmerge extend``: add views that arrive in batches to a state."""

import sys
from pathlib import Path
from time import perf_counter
from typing import Annotated, Any

from gsmerge.cli import parameters as opt
from gsmerge.cli.console import print_document, say_notes, stage_progress
from gsmerge.cli.paths import input_files
from gsmerge.errors import UsageError
from gsmerge.settings.compact import CompactOptions
from gsmerge.settings.extend import ExtendOptions, batch_settings
from gsmerge.settings.reading import NONE

SETTINGS = (CompactOptions, ExtendOptions)


def extend(
    state: Annotated[Path, opt.argument("STATE", "A .gsm file; the first batch creates it.", opt.read_path)],
    scenes: Annotated[list[Path], opt.argument("SCENE...", "Batches of new views, in order; each is a scene as compact "
        "takes it.")],
    cameras: opt.Cameras = None, images: opt.Images = None, hint: opt.Hint = None, masks: opt.Masks = None,
    budget: opt.Budget = None,
    effort: Annotated[str | None, opt.setting_option(opt.METHOD, "draft|fast|default|best", "effort", "draft")] = None,
    set: Annotated[list[str] | None, opt.settings_option(SETTINGS, example="superpixels=2000")] = None,
    dry_run: opt.DryRun = False, threads: opt.Threads = None, json: opt.Json = False, progress: opt.Progress = None,
    quiet: opt.Quiet = False,
) -> None:  # fmt: skip
    """Compact new views and add them to a state, from which gsmerge compact makes a result at any time."""
    from gsmerge.io.formats.table import STATE_ENDING
    from gsmerge.reading.scene_files import find_scene_files

    start = perf_counter()
    if state.suffix.lower() != STATE_ENDING:
        raise UsageError(f"{state}: expected a state whose name ends in {STATE_ENDING}")
    reading = opt.read_hints(hint)
    if len(scenes) > 1 and {cameras, images, masks} - {None, NONE}:
        raise UsageError("--cameras, --images and --masks: expected one batch, got several; add one batch at a time")
    from gsmerge.jobs.states.files import batch_line, extend_file

    given = opt.read_settings(SETTINGS, set, budget=budget, effort=effort, threads=threads)
    with given.usage_errors():
        batch_settings(given.values)
    batches = [find_scene_files(scene, cameras=cameras, images=images, masks=masks) for scene in scenes]
    for files in batches:
        if any(path.resolve() == state.resolve() for path in input_files(files)):
            raise UsageError(f"{state}: expected a state other than the input; name another file")
    # in a dry run, the state that no file holds
    documents = list[dict[str, Any]]()
    tried = None
    for files in batches:
        before = {"import": perf_counter() - start} if not documents else {}
        with stage_progress(quiet=quiet or json) as on_step:
            document, extended = extend_file(
                state, files, given.values, opacity=reading.opacity, hints=reading.hints, progress=on_step,
                seconds_before=before, dry_run=dry_run, tried=tried,
            )  # fmt: skip
        tried = extended if dry_run else None
        documents.append(document)
        say_notes(document["notes"], quiet=quiet or json)
        if not (quiet or json):
            print_document(document, batch_line(document), as_json=False)
    if json:
        from gsmerge.runtime.documents import document_head, note_entries, to_json

        notes = note_entries(note for document in documents for note in document["notes"])
        sys.stdout.write(to_json(document_head() | {"batches": documents} | notes))
