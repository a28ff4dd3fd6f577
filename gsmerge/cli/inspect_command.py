"""``gsmerge inspect``: check and describe files, and say what compact would make of a scene."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

from gsmerge.cli import parameters as opt
from gsmerge.cli.console import print_document, say_notes, stage_progress
from gsmerge.errors import SceneError, UsageError, name_notes


def inspect(
    paths: Annotated[list[Path], opt.argument("SCENE|FILE...", "One or several scenes; also cameras, .gsm files, "
        "networks and lod-meta.json.")],
    cameras: opt.Cameras = None, images: opt.Images = None, hint: opt.Hint = None,
    threads: opt.OwnThreads = None, json: opt.Json = False, progress: opt.Progress = None,
    quiet: opt.Quiet = False,
) -> None:  # fmt: skip
    """Check and describe files, and say what compact would make of each scene, or why compact refuses the scene."""
    from gsmerge.io.formats.table import INDEX
    from gsmerge.jobs.file_checks import holds_scene

    path, reading = paths[0], opt.read_hints(hint)
    if len(paths) == 1 and (holds_scene(path) or path.name == INDEX):
        _inspect_scene(path, cameras, images, reading, json=json, quiet=quiet)
        return
    if cameras is not None or images is not None:
        raise UsageError("--cameras and --images: expected one scene with them")
    _print_checks(paths, reading, json=json, quiet=quiet)


def _inspect_scene(
    path: Path, cameras: str | None, images: str | None, reading: opt.Reading, *, json: bool, quiet: bool
) -> None:
    """Describe a scene in detail; SceneError if ``compact`` refuses the scene."""
    from gsmerge.io.formats.table import INDEX
    from gsmerge.jobs.file_checks import check_content
    from gsmerge.jobs.inspect import inspect as inspect_scene
    from gsmerge.jobs.inspect import inspection_lines
    from gsmerge.runtime.documents import document_head
    from gsmerge.runtime.record import record_run

    with stage_progress(quiet=quiet or json) as progress, record_run(progress):
        facts = inspect_scene(path, cameras=cameras, images=images, opacity=reading.opacity, **vars(reading.hints))
        problems = check_content(path).problems if path.name == INDEX else ()
    document, lines = {**document_head(), **facts, "problems": list(problems)}, inspection_lines(facts)
    print_document(document, lines, as_json=json, quiet=quiet)
    if facts["compact"] is None:
        problem_path, _, problem = facts["alignment_problem"].partition(": ")
        raise SceneError(problem_path, problem)
    if problems:
        raise SceneError(path, "; ".join(problems))


def _print_checks(paths: Sequence[Path], reading: opt.Reading, *, json: bool, quiet: bool) -> None:
    """Print a line for each file; SceneError if ``compact`` refuses one."""
    from gsmerge.jobs.file_checks import FileCheck, check_content
    from gsmerge.runtime.documents import document_head, note_entries

    checks, silent = list[FileCheck](), quiet or json
    with stage_progress(quiet=silent) as progress:
        for path in paths:
            progress(f"inspect: {path.name}", len(checks), len(paths))
            checks.append(check_content(path, opacity=reading.opacity, hints=reading.hints))
    wrong, several = [check for check in checks if check.problems], len(checks) > 1
    notes = [note for check in checks for note in name_notes(check.path, check.notes)]
    say_notes(notes, quiet=silent)
    document = {
        **document_head(),
        "files": [asdict(check) for check in checks],
        "num_wrong": len(wrong),
        **note_entries(notes),
    }
    lines = [check.line for check in checks if several or not check.problems]
    print_document(document, lines, as_json=json, quiet=quiet)
    if wrong:
        # for several files, the printed lines have already named the problems
        problem = "refused, for the reason above" if several and not silent else "; ".join(wrong[0].problems)
        raise SceneError(wrong[0].path, problem, f"wrong files: {len(wrong)} of {len(checks)}" if several else "")
