"""``gsmerge check``: whether files are sound."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

from gsmerge.cli import parameters as opt
from gsmerge.cli.console import print_document, say_notes, stage_progress
from gsmerge.errors import SceneError


@opt.command(
    opt.argument("paths", list[Path], "FILE...", "Files of Gaussians (.ply, .spz, .sog, .splat, .glb), "
                 "cameras (.json, .npz, ..., a COLMAP folder), .gsm files, networks (.safetensors), "
                 "and folders of scenes, with their cameras and photos."),
)  # fmt: skip
def check(args: opt.Args) -> None:
    """Read files to their ends and say what is wrong: counts, NaN, ranges, checksums."""
    from gsmerge.file_checks import FileCheck, check_content
    from gsmerge.report import document_head

    checks = list[FileCheck]()
    with stage_progress(quiet=args.silent) as progress:
        for path in args.paths:
            progress(f"check: {path.name}", len(checks), len(args.paths))
            checks.append(check_content(path))
    wrong = [result for result in checks if result.problems]
    notes = [f"{result.path}: {note}" for result in checks for note in result.notes]
    say_notes(notes, quiet=args.silent)
    document = {
        **document_head(),
        "files": [asdict(result) for result in checks],
        "num_wrong": len(wrong),
        "notes": notes,
    }
    print_document(document, [result.line for result in checks], as_json=args.json, quiet=args.quiet)
    if wrong:
        problem = "; ".join(wrong[0].problems)
        more = f"wrong files: {len(wrong)} of {len(checks)}" if len(checks) > 1 else ""
        raise SceneError(wrong[0].path, problem, more)
