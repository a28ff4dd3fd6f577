"""``gsmerge lab generate``: make synthetic scenes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

from gsmerge.cli import parameters as opt
from gsmerge.cli.console import print_document, stage_progress
from gsmerge.cli.render_command import parse_size
from gsmerge.errors import SceneError
from gsmerge.runtime.plugins import LazyFunction
from gsmerge.settings.setting import Settings, setting
from gsmerge.values.words import count_words

OPTIONS = LazyFunction("gsmerge.research.generate", "GenerateOptions")


@dataclass(frozen=True)
class SeriesOptions(Settings):
    """Settings of a series of scenes."""

    seed: int = setting(0, "Seed of all random numbers.", least=0)


@opt.command(
    *opt.panel(
        "Scenes",
        opt.option("scenes", int, "Number of scenes.", default=20, min=1),
        opt.option("views", int, "Views of a scene.", default=6, min=2, max=200),
        opt.option("size", str, "Size of the views, pixels.", default="320x240", metavar="WxH", parser=parse_size),
    ),
    opt.settings_option(OPTIONS, SeriesOptions, example="noise=0"),
    opt.output("Folder for the scenes: scene_0000 and on.", default=opt.REQUIRED),
)  # fmt: skip
def generate(args: opt.Args) -> None:
    """Make synthetic scenes to train and test with, as a feed-forward network would export them."""
    from gsmerge.measure.documents import document_head, note_entries
    from gsmerge.research.generate import GenerateOptions
    from gsmerge.research.generate import generate as generate_scenes

    out, (width, height) = args.output, args.size
    options, series = args.make(GenerateOptions, SeriesOptions, views=args.views, width=width, height=height)
    if out.exists() and not out.is_dir():
        raise SceneError(out, "expected a folder to write scenes to, found a file", "name another")
    with stage_progress(quiet=args.silent) as progress:
        scenes = generate_scenes(out, args.scenes, options, seed=series.seed, progress=partial(progress, "generate"))
    document = {**document_head(), "options": options.to_dict(), "seed": series.seed, **note_entries([])}
    document["scenes"] = [{"folder": str(scene.folder), "kept": scene.kept} for scene in scenes]
    kept = sum(scene.kept for scene in scenes)
    line = f"{out}: {count_words(len(scenes) - kept, 'scene')}"
    line += f", {kept} were there already" if kept else ""
    print_document(document, line, as_json=args.json, quiet=args.quiet)
