"""``gsmerge evaluate``: measure quality, bytes and render time of a scene and its compact versions."""

import sys
from pathlib import Path
from typing import Annotated

from gsmerge.cli import parameters as opt
from gsmerge.cli.before_after import lpips_networks, read_before_after
from gsmerge.cli.console import print_document, say_notes, stage_progress, terminal_columns
from gsmerge.cli.paths import check_outputs, input_files, write_texts
from gsmerge.errors import UsageError
from gsmerge.frozen import dataclass
from gsmerge.settings.evaluate import EvaluateOptions
from gsmerge.settings.setting import Settings, setting

SUFFIXES = (".json", ".csv")


@dataclass(frozen=True)
class MeasuringOptions(Settings):
    """Settings of the command, in addition to the settings of :func:`gsmerge.evaluate`."""

    views: int | None = setting(None, "Number of input views to use as the context, at equal intervals; the "
        "held-out views midway between them are the targets.", least=1)  # fmt: skip


SETTINGS = (EvaluateOptions, MeasuringOptions)


def evaluate(
    before: opt.Before, after: opt.After = None, cameras: opt.Cameras = None, images: opt.Images = None,
    hint: opt.Hint = None, masks: opt.Masks = None, targets: opt.Targets = None, target_images: opt.TargetImages = None,
    lpips: opt.Lpips = None,
    set: Annotated[list[str] | None, opt.settings_option(SETTINGS, example="context=false or photo_side=476")] = None,
    output: Annotated[list[Path] | None, opt.output("File to write: .json, or .csv (a row for each result and view); "
        "may be repeated.", read=opt.read_paths)] = None,
    overwrite: opt.Overwrite = False, threads: opt.OwnThreads = None, json: opt.Json = False,
    progress: opt.Progress = None, quiet: opt.Quiet = False,
) -> None:  # fmt: skip
    """Measure a scene and its compact versions against photos: PSNR, SSIM, LPIPS, fog, counts, bytes, render time."""
    from gsmerge.reading.scene_files import find_scene_files

    nets, lpips_notes = lpips_networks(lpips)
    given = opt.read_settings(SETTINGS, set, lpips=lpips)
    reading = opt.read_hints(hint)
    silent = quiet or json
    options, measuring = given.make(*SETTINGS, lpips=nets)
    if not options.context and targets is None:
        raise UsageError("context=false: expected held-out views to measure instead; name them with --targets")
    after = after or []
    outputs = output or []
    files = find_scene_files(before, cameras=cameras, images=images, masks=masks)
    if quiet and not (outputs or json):
        raise UsageError("--quiet: expected -o or --json with it, since otherwise nothing is shown or written")
    for path in outputs:
        if path.suffix not in SUFFIXES:
            raise UsageError(f"{path}: expected a name ending in {opt.join_words(SUFFIXES)}; gsmerge view makes pages")
    check_outputs(outputs, (*input_files(files), *after, targets, target_images), overwrite=overwrite)
    from gsmerge.runtime.documents import to_json
    from gsmerge.scoring.evaluate import INPUT
    from gsmerge.scoring.evaluate import evaluate as evaluate_scene
    from gsmerge.scoring.evaluation_report import evaluation_csv, evaluation_document, evaluation_lines

    with stage_progress(quiet=silent) as on_step:
        on_step("read", 0, 0)
        pair = read_before_after(
            files, after, reading, targets=targets, target_images=target_images, views=measuring.views
        )
    notes = [*pair.notes, *lpips_notes]
    if pair.plys and len(pair.scene) < len(pair.load.scene):
        notes.append(
            f"scores assume results of {len(pair.scene)} views; a result of more views has seen the held-out photos"
        )
    say_notes(notes, quiet=silent)
    with stage_progress(quiet=silent) as on_step:
        evaluation = evaluate_scene(
            pair.scene, pair.gaussians, pair.held_out, options, cameras=pair.cameras, progress=on_step
        )
    infos = {INPUT: pair.load.info, **{name: ply.info for name, ply in pair.plys.items()}}
    files_by_name = {
        name: {"path": info.path, "bytes": info.file_bytes, "bytes_by_attribute": info.bytes_by_attribute}
        for name, info in infos.items()
    }
    document = evaluation_document(evaluation, files_by_name, notes)
    writers = {".json": to_json, ".csv": evaluation_csv}
    write_texts({path: writers[path.suffix](document) for path in outputs})
    lines = evaluation_lines(document, terminal_columns(sys.stdout))
    print_document(document, lines, as_json=json, quiet=quiet, wrap=False)
    say_notes(evaluation.notes, quiet=silent)
