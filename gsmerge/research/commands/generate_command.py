"""``gsmerge generate``: synthetic scenes."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gsmerge.cli import parameters as opt
from gsmerge.cli.console import print_document, stage_progress
from gsmerge.errors import SceneError, UsageError

if TYPE_CHECKING:
    from gsmerge.research.generate import GenerateOptions


@opt.command(
    *opt.panel(
        "Scenes",
        opt.option("scenes", int, "Number of scenes.", default=20, min=1),
        opt.option("views", str, "Views of a scene, or a range to draw their number from.", default="6",
                   metavar="N|N-M"),
        opt.option("size", str, "Size of the views, pixels.", default="320x240", metavar="WxH"),
        opt.option("style", str, "room, garden, mixed: these two in turn, or building: many rooms.", default="mixed"),
        opt.option("path", str, "Cameras: arc, forward, walk, orbit, wide, or mixed: any; a walk in a building.",
                   default="mixed"),
    ),
    *opt.panel(
        "Errors",
        opt.option("noise", float, "Factor on the simulated errors of the network.", default=1.0, min=0.0, max=10.0),
        opt.option("ranges", Path, "TOML or JSON file with ranges of the errors, as in docs/internals/lab.md.",
                   wording="the built-in ones"),
    ),
    opt.output("Folder for the scenes: scene_0000 and on.", default=opt.REQUIRED),
    f"overwrite dry_run {opt.RUN}",
)  # fmt: skip
def generate(args: opt.Args) -> None:
    """Make synthetic scenes to train and test with, as a feed-forward network would export them."""
    options, out = _options(args), args.output
    if out.exists() and not out.is_dir():
        raise SceneError(out, "expected a folder to write scenes to, found a file", "name another")
    seed = args.seed or 0
    from gsmerge.report import document_head
    from gsmerge.research.generate import generate as generate_scenes
    from gsmerge.research.generate import plan

    where: dict[str, Any] = {"seed": seed, "overwrite": args.overwrite}
    if args.dry_run:
        scenes = plan(out, args.scenes, options, **where)
    else:
        with stage_progress(quiet=args.silent) as progress:
            move = partial(progress, "generate")
            scenes = generate_scenes(out, args.scenes, options, **where, threads=args.threads, progress=move)
    document = {**document_head(), "options": options.to_dict(), "seed": seed, "dry_run": args.dry_run, "notes": []}
    document["scenes"] = [{"folder": str(scene.folder), "kept": scene.kept} for scene in scenes]
    kept = sum(scene.kept for scene in scenes)
    line = f"{out}: {'would write ' if args.dry_run else ''}{len(scenes) - kept} scenes"
    line += f", {kept} were there already" if kept else ""
    print_document(document, line, as_json=args.json, quiet=args.quiet)


def _options(args: opt.Args) -> GenerateOptions:
    """Parse the settings of the scenes."""
    from gsmerge.research.generate import GenerateOptions, read_ranges

    counts = re.fullmatch(r"(\d{1,4})(?:-(\d{1,4}))?", args.views)
    if counts is None:
        raise UsageError(f"--views: expected a number such as 6, or a range such as 4-10, got {args.views!r}")
    sides = re.fullmatch(r"(\d{1,5})x(\d{1,5})", args.size)
    if sides is None:
        raise UsageError(f"--size: expected width and height such as 320x240, got {args.size!r}")
    views, (width, height) = (int(counts[1]), int(counts[2] or counts[1])), map(int, sides.groups())
    with opt.usage_errors():
        options = GenerateOptions(
            views=views, width=width, height=height, style=args.style, path=args.path, noise=args.noise
        )
    return options if args.ranges is None else replace(options, ranges=read_ranges(args.ranges))
