"""``gsmerge compact``: the main job."""

from __future__ import annotations

import shlex
import sys
from time import perf_counter
from typing import TYPE_CHECKING

from gsmerge.cli import options as opt
from gsmerge.cli.console import announce_compilation, print_document, say, say_notes, stage_progress
from gsmerge.cli.paths import check_format, check_outputs, checkpoint_files, default_output, input_files
from gsmerge.errors import TargetError

if TYPE_CHECKING:
    from gsmerge.io import SceneFiles


@opt.command(
    opt.SCENE,
    f"{opt.READING} {opt.COUNTS} {opt.MERGE} method {opt.NETWORKS} {opt.FIT} {opt.CLEAN}",
    opt.output(opt.COMPACT_SCENE, "SCENE.compact.ply"),
    f"no_normals spz_version overwrite report no_viewer_cameras save_cameras dry_run {opt.RUN}",
)
def compact(args: opt.Args) -> None:
    """Write a compact scene that renders like the given one, or better, with 1 to 10 % of its Gaussians."""
    start = perf_counter()
    hints = args.hints()
    from gsmerge.compact_file import level_output
    from gsmerge.io.cameras.json_files import viewer_cameras_path

    files = args.files(args.scene)
    out = args.output or default_output(files.ply)
    levels = [level_output(out, level) for level in range(1, args.levels or 1)]
    cameras = None if args.no_viewer_cameras else viewer_cameras_path(out)
    inputs = (*input_files(files), *checkpoint_files(args.checkpoint))
    check_outputs(
        (out, *levels, args.report, cameras, args.save_cameras), inputs, overwrite=args.overwrite or args.dry_run
    )
    settings = args.settings()
    check_format(out, args.spz_version, settings.budget)
    if args.dry_run:
        from gsmerge.cli.plan import print_plan

        print_plan(args, files, settings, out, hints)
        return
    _warn_of_memory(files, quiet=args.silent)
    from gsmerge.compact_file import compact_files
    from gsmerge.report import result_table, summary_lines

    seconds_before = {"import": perf_counter() - start}
    needs_fit = settings.method == "unmerged-fit" or (settings.method == "gsmerge" and settings.fit.fit == "full")
    with (
        announce_compilation(quiet=args.silent, share=needs_fit) as finish,
        stage_progress(quiet=args.silent) as progress,
    ):

        def move(stage: str, done: int, total: int) -> None:
            if stage == "fit":
                finish()
            progress(stage, done, total)

        document = compact_files(
            files, settings, out, opacity=args.opacity, hints=hints, overwrite=args.overwrite, progress=move,
            hashed=args.json or args.report is not None, seconds_before=seconds_before, report_path=args.report,
            normals=not args.no_normals, spz_version=args.spz_version, cameras_path=cameras,
            saved_cameras=args.save_cameras,
        )  # fmt: skip

    say_notes(document["notes"], quiet=args.silent)
    lines = summary_lines(document)
    if sys.stdout.isatty():
        view = shlex.join(["gsmerge", "view", str(args.scene), str(out)])
        lines = result_table(document, view if out.suffix.lower() == ".ply" else None)
    print_document(document, lines, as_json=args.json, quiet=args.quiet)
    if document["unmet"]:
        raise TargetError(document["unmet"])


def _warn_of_memory(files: SceneFiles, *, quiet: bool) -> None:
    """Warn before anything is read if the scene is not likely to fit into this machine's memory."""
    from gsmerge.io.formats.ply_file import header_counts
    from gsmerge.runtime.estimate import memory_bytes, memory_problem
    from gsmerge.runtime.memory import machine_memory

    count, num_rest = header_counts(files.ply)
    problem = memory_problem(memory_bytes(count, photos=True, num_rest=num_rest), machine_memory())
    if problem is not None:
        say(f"gsmerge: warning: {problem}", quiet=quiet)
