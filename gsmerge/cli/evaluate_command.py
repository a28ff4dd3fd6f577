"""``gsmerge evaluate``: measure quality, bytes and render time of a scene and its compact versions."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gsmerge.cli import parameters as opt
from gsmerge.cli.before_after import BeforeAfter, lpips_networks, read_before_after
from gsmerge.cli.console import print_document, say_notes, stage_progress, terminal_columns
from gsmerge.cli.paths import check_outputs, input_files, write_texts
from gsmerge.errors import UsageError
from gsmerge.settings.evaluate import EvaluateOptions
from gsmerge.settings.setting import Settings, setting

SUFFIXES = (".json", ".csv")


@dataclass(frozen=True)
class MeasuringOptions(Settings):
    """Settings of the command, in addition to the settings of :func:`gsmerge.evaluate`."""

    views: int | None = setting(None, "Number of input views to use as the context, at equal intervals; the "
        "held-out views midway between them are the targets.", least=1)  # fmt: skip
    masks: str | None = setting(None, "Folder of masks with the names of the photos, dark where a photo does not "
        "count.")  # fmt: skip


@opt.command(
    opt.BEFORE,
    opt.AFTER,
    f"{opt.READING} {opt.TARGETS}",
    "lpips",
    opt.settings_option(EvaluateOptions, MeasuringOptions, example="context=false or photo_side=476"),
    *opt.panel(
        opt.OUTPUT_GROUP,
        opt.option("output", list[Path], "File to write: .json, or .csv (a row for each result and view); may be "
                   "repeated.", "--output", "-o"),
    ),
)  # fmt: skip
def evaluate(args: opt.Args) -> None:
    """Measure a scene and its compact versions against photos: PSNR, SSIM, LPIPS, fog, counts, bytes, render time."""
    args.after = args.after or []
    args.lpips, lpips_notes = lpips_networks(args.lpips)
    options, measuring = args.make(EvaluateOptions, MeasuringOptions)
    if not options.context and args.targets is None:
        raise UsageError("context=false: expected held-out views to measure instead; name them with --targets")
    args.views, args.masks = measuring.views, None if measuring.masks is None else opt.named_or_none(measuring.masks)
    files, outputs = args.files(args.before), args.output or []
    if args.quiet and not (outputs or args.json):
        raise UsageError("--quiet: expected -o or --json with it, since otherwise nothing is shown or written")
    _check_output_files(args, outputs, input_files(files))
    from gsmerge.measure.documents import to_json
    from gsmerge.measure.evaluate import evaluate as evaluate_scene
    from gsmerge.measure.scores import evaluation_csv, evaluation_document, evaluation_lines

    with stage_progress(quiet=args.silent) as progress:
        progress("read", 0, 0)
        pair = read_before_after(args, files)
    notes = [*pair.notes, *lpips_notes]
    if pair.plys and len(pair.scene) < len(pair.load.scene):
        notes.append(
            f"scores assume results of {len(pair.scene)} views; a result of more views has seen the held-out photos"
        )
    say_notes(notes, quiet=args.silent)
    with stage_progress(quiet=args.silent) as progress:
        evaluation = evaluate_scene(
            pair.scene, pair.gaussians, pair.held_out, options, cameras=pair.cameras, progress=progress
        )
    document = evaluation_document(evaluation, _describe_files(pair), notes)
    writers = {".json": to_json, ".csv": evaluation_csv}
    write_texts({path: writers[path.suffix](document) for path in outputs})
    lines = evaluation_lines(document, terminal_columns(sys.stdout))
    print_document(document, lines, as_json=args.json, quiet=args.quiet, wrap=False)
    say_notes(evaluation.notes, quiet=args.silent)


def _check_output_files(args: opt.Args, outputs: Sequence[Path], inputs: Sequence[Path]) -> None:
    """Raise UsageError if an output cannot be written."""
    for path in outputs:
        if path.suffix not in SUFFIXES:
            raise UsageError(f"{path}: expected a name ending in {opt.join_words(SUFFIXES)}; gsmerge view makes pages")
    check_outputs(outputs, (*inputs, *args.after, args.targets, args.target_images), reports=True)


def _describe_files(pair: BeforeAfter) -> dict[str, dict[str, Any]]:
    """Return path and bytes of the scene and of each compact version, by name."""
    from gsmerge.measure.evaluate import INPUT

    infos = {INPUT: pair.load.info, **{name: ply.info for name, ply in pair.plys.items()}}
    return {
        name: {"path": info.path, "bytes": info.file_bytes, "bytes_by_attribute": info.bytes_by_attribute}
        for name, info in infos.items()
    }
