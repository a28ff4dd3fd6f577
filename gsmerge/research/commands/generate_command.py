"""``gsmerge lab generate``: make synthetic scenes."""

from functools import partial
from pathlib import Path
from typing import Annotated

from gsmerge.cli import parameters as opt
from gsmerge.cli.console import print_document, stage_progress
from gsmerge.cli.render_command import parse_size
from gsmerge.errors import SceneError, count_words
from gsmerge.frozen import dataclass
from gsmerge.runtime.plugins import LazyFunction
from gsmerge.settings.setting import Setting, Settings, setting

PANEL = "Scenes"
OPTIONS = LazyFunction("gsmerge.research.generate", "GenerateOptions")


@dataclass(frozen=True)
class SeriesOptions(Settings):
    """Settings of a series of scenes."""

    seed: int = setting(0, "Seed of all random numbers.", least=0)


SETTINGS = (OPTIONS, SeriesOptions)
SCENES = Setting("Number of scenes.", kind=int, least=1)
VIEWS = Setting("Views of a scene.", kind=int, least=2, most=200)


def generate(
    *,
    scenes: Annotated[opt.Parsed, opt.option(PANEL, "NUMBER", SCENES.help, default=20,
        read=opt.reader(SCENES.read))] = "20",
    views: Annotated[opt.Parsed, opt.option(PANEL, "NUMBER", VIEWS.help, default=6, read=opt.reader(VIEWS.read))] = "6",
    size: Annotated[opt.Parsed, opt.option(PANEL, "WxH", "Size of the views, pixels.", default="320x240",
        read=opt.reader(parse_size))] = "320x240",
    set: Annotated[list[str] | None, opt.settings_option(SETTINGS, example="noise=0")] = None,
    output: Annotated[Path, opt.output("Folder for the scenes: scene_0000 and on.")],
    json: opt.Json = False, progress: opt.Progress = None, quiet: opt.Quiet = False,
) -> None:  # fmt: skip
    """Make synthetic scenes to train and test with, as a feed-forward network would export them."""
    from gsmerge.research.generate import GenerateOptions
    from gsmerge.research.generate import generate as generate_scenes
    from gsmerge.runtime.documents import document_head, note_entries

    given = opt.read_settings(SETTINGS, set)
    width, height = size
    options, series = given.make(GenerateOptions, SeriesOptions, views=views, width=width, height=height)
    if output.exists() and not output.is_dir():
        raise SceneError(output, "expected a folder to write scenes to, found a file", "name another")
    with stage_progress(quiet=quiet or json) as on_step:
        made = generate_scenes(output, scenes, options, seed=series.seed, progress=partial(on_step, "generate"))
    document = {**document_head(), "options": options.to_dict(), "seed": series.seed, **note_entries([])}
    document["scenes"] = [{"folder": str(scene.folder), "kept": scene.kept} for scene in made]
    kept = sum(scene.kept for scene in made)
    line = f"{output}: {count_words(len(made) - kept, 'scene')}"
    line += f", {kept} were there already" if kept else ""
    print_document(document, line, as_json=json, quiet=quiet)
