"""``gsmerge inspect``: check and describe files, and say what compact would make of a scene."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

from gsmerge.cli import parameters as opt
from gsmerge.cli.console import print_document, say_notes, stage_progress
from gsmerge.errors import SceneError, UsageError, name_notes


def inspect(
    paths: Annotated[list[Path], opt.argument("SCENE|FILE...", "One or several scenes; also cameras, .gsm files, "
        "networks and lod-meta.json.")],
    cameras: opt.Cameras = None, images: opt.Images = None, hint: opt.Hint = None, masks: opt.Masks = None,
    threads: opt.OwnThreads = None, json: opt.Json = False, progress: opt.Progress = None,
    quiet: opt.Quiet = False,
) -> None:  # fmt: skip
    """Check and describe files, and say what compact would make of each scene, or why compact refuses the scene."""
    from gsmerge.io.formats.table import INDEX
    from gsmerge.jobs.file_checks import FileCheck, check_content, holds_scene
    from gsmerge.runtime.documents import document_head, note_entries

    path = paths[0]
    reading = opt.read_hints(hint)
    silent = quiet or json
    if len(paths) == 1 and (holds_scene(path) or path.name == INDEX):  # describe a scene in detail
        from gsmerge.jobs.inspect import inspect as inspect_scene
        from gsmerge.jobs.inspect import inspection_lines
        from gsmerge.runtime.record import record_run

        with stage_progress(quiet=silent) as on_step, record_run(on_step):
            facts = inspect_scene(
                path, cameras=cameras, images=images, masks=masks, opacity=reading.opacity, **vars(reading.hints)
            )  # fmt: skip
            problems = check_content(path).problems if path.name == INDEX else ()
        described = {**document_head(), **facts, "problems": list(problems)}
        print_document(described, inspection_lines(facts), as_json=json, quiet=quiet)
        if facts["compact"] is None:
            problem_path, _, problem = facts["alignment_problem"].partition(": ")
            raise SceneError(problem_path, problem)
        if problems:
            raise SceneError(path, "; ".join(problems))
        return
    if any(named is not None for named in (cameras, images, masks)):
        raise UsageError("--cameras, --images and --masks: expected one scene with them")
    checks = list[FileCheck]()
    with stage_progress(quiet=silent) as on_step:
        for path in paths:
            on_step(f"inspect: {path.name}", len(checks), len(paths))
            checks.append(check_content(path, opacity=reading.opacity, hints=reading.hints))
    wrong = [check for check in checks if check.problems]
    several = len(checks) > 1
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
