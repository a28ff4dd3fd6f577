"""``gsmerge generate``: scenes out of nothing."""

from __future__ import annotations

import re
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from gsmerge.cli import options as opt
from gsmerge.cli.console import announce_compilation, one_line, stage_progress
from gsmerge.cli.settings import told_as_usage
from gsmerge.errors import SceneError, UsageError

if TYPE_CHECKING:
    from gsmerge.research.generate import GenerateOptions, SceneFolder

SCENE, ERRORS = "Scenes", "Errors"


def generate(
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Folder for the scenes: OUT/scene_0000 and on.")],
    scenes: Annotated[int, typer.Option(min=1, help="Number of scenes.", rich_help_panel=SCENE)] = 20,
    views: Annotated[
        str,
        typer.Option(
            metavar="N|N-M", help="Views of a scene, or the range they are drawn from.", rich_help_panel=SCENE
        ),
    ] = "6",
    size: Annotated[
        str, typer.Option(metavar="WxH", help="Size of the views, pixels.", rich_help_panel=SCENE)
    ] = "320x240",
    style: Annotated[
        str,
        typer.Option(help="room, desk, garden, facade, single, or mixed: all in turn.", rich_help_panel=SCENE),
    ] = "mixed",
    path: Annotated[
        str,
        typer.Option(help="Cameras: arc, forward, walk, orbit, wide, or mixed: any.", rich_help_panel=SCENE),
    ] = "mixed",
    noise: Annotated[
        float, typer.Option(min=0.0, max=10.0, help="Factor on the errors of the network.", rich_help_panel=ERRORS)
    ] = 1.0,
    ranges: Annotated[
        Path | None,
        typer.Option(
            help="TOML or JSON file with ranges of the errors, as in docs/internals/generator.md.",
            show_default="the built-in ones",
            rich_help_panel=ERRORS,
        ),
    ] = None,
    seed: opt.SeedOption = None,
    threads: opt.ThreadsOption = None,
    overwrite: opt.OverwriteOption = False,
    json: opt.JsonOption = False,
    dry_run: opt.DryRunOption = False,
    quiet: opt.QuietOption = False,
    debug: opt.DebugOption = False,
) -> None:
    """Make scenes to train and test with, as a feed-forward network would export them."""
    options = _options(views, size, style, path, noise, ranges)
    if out.exists() and not out.is_dir():
        raise SceneError(out, "expected a folder to write scenes to, found a file", "name another")
    number = 0 if seed is None else seed
    how = {"seed": number, "overwrite": overwrite}
    found = _made(out, scenes, options, how, threads=threads, dry_run=dry_run, quiet=quiet or json)
    if json:
        from gsmerge.report import document_head, to_json

        document = {**document_head(), "options": options.to_dict(), "seed": number, "dry_run": dry_run, "notes": []}
        document["scenes"] = [{"folder": str(made.folder), "kept": made.kept} for made in found]
        sys.stdout.write(to_json(document))
    elif not quiet:
        kept = sum(made.kept for made in found)
        line = f"{out}: {'would write ' if dry_run else ''}{len(found) - kept} scenes"
        print(one_line(line + (f", {kept} were there already" if kept else "")))


def _made(
    out: Path,
    scenes: int,
    options: GenerateOptions,
    how: Mapping[str, Any],
    *,
    threads: int | None,
    dry_run: bool,
    quiet: bool,
) -> list[SceneFolder]:
    """Make the scenes, or say which there would be."""
    from gsmerge.research.generate import generate as make_scenes
    from gsmerge.research.generate import plan

    if dry_run:
        return plan(out, scenes, options, **how)
    with announce_compilation(quiet=quiet), stage_progress(quiet=quiet) as progress:

        def told(done: int, total: int) -> None:
            if progress is not None:
                progress("generate", done, total)

        return make_scenes(out, scenes, options, **how, threads=threads, progress=told)


def _options(views: str, size: str, style: str, path: str, noise: float, ranges: Path | None) -> GenerateOptions:
    """What the command line asks for.

    Raises:
        UsageError: If a value is none of the possible ones.
        SceneError: If the file of ranges cannot be read.
    """
    from gsmerge.research.generate import GenerateOptions, read_ranges

    counts = re.fullmatch(r"(\d{1,4})(?:-(\d{1,4}))?", views)
    if counts is None:
        raise UsageError(f"--views: expected a number such as 6, or a range such as 4-10, got {views!r}")
    sides = re.fullmatch(r"(\d{1,5})x(\d{1,5})", size)
    if sides is None:
        raise UsageError(f"--size: expected width and height such as 320x240, got {size!r}")
    numbers = int(counts[1]), int(counts[2] or counts[1])
    width, height = int(sides[1]), int(sides[2])
    with told_as_usage():
        options = GenerateOptions(views=numbers, width=width, height=height, style=style, path=path, noise=noise)
    return options if ranges is None else replace(options, ranges=read_ranges(ranges))
