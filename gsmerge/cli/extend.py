"""``gsmerge extend``: views that arrive batch by batch, folded into a state."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from enum import Enum
from pathlib import Path
from time import perf_counter
from typing import Annotated, Any

import typer

from gsmerge.cli import network_options as net
from gsmerge.cli import options as opt
from gsmerge.cli.console import announce_compilation, one_line, say_notes, stage_progress
from gsmerge.cli.paths import input_files
from gsmerge.cli.settings import reading_of
from gsmerge.errors import UsageError


class BatchFit(str, Enum):
    """What of a batch is fitted to its photos."""

    color = "color"
    none = "none"


StateArgument = Annotated[
    Path, typer.Argument(metavar="STATE", help="A .gsm file: of gsmerge extend or encode, or made by the first batch.")
]
BatchArgument = Annotated[
    list[Path],
    typer.Argument(metavar="SCENE", help="Batches of new views, in order: scenes as gsmerge compact takes them."),
]
BatchFitOption = Annotated[
    BatchFit | None,
    typer.Option(
        help="What to fit to a batch's photos; the full fit comes with gsmerge decode.",
        show_default="color",
        rich_help_panel=opt.MERGING,
    ),
]
StateMaxKOption = Annotated[
    int | None,
    typer.Option(
        min=1,
        max=8,
        help="Most Gaussians per superpixel that can be decoded, settled by the first batch.",
        show_default="4",
        rich_help_panel=opt.COUNT,
    ),
]
ToleranceOption = Annotated[
    float | None,
    typer.Option(
        min=0.0,
        max=1.0,
        help="Colour error up to which what is there already is good enough; 0: every new Gaussian counts.",
        show_default="0.06",
        rich_help_panel=opt.COUNT,
    ),
]
ReplayOption = Annotated[
    int | None,
    typer.Option(
        min=0,
        help="Most photos that the state keeps for the full fit of gsmerge decode.",
        show_default="96",
        rich_help_panel=opt.OUTPUT,
    ),
]


def extend(
    context: typer.Context,
    state: StateArgument,
    scenes: BatchArgument,
    cameras: opt.CamerasOption = None,
    images: opt.ImagesOption = None,
    opacity: opt.OpacityOption = opt.Opacity.auto,
    exporter: opt.DialectOption = "auto",
    quats: opt.QuatsOption = opt.Quats.auto,
    order: opt.OrderOption = opt.Order.auto,
    scene_scale: opt.SceneScaleOption = None,
    max_side: opt.MaxSideOption = None,
    superpixels: opt.SuperpixelsOption = None,
    density: opt.DensityOption = None,
    segmentation: opt.SegmentationOption = None,
    effort: opt.EffortOption = None,
    k: opt.KOption = None,
    max_k: StateMaxKOption = None,
    budget: opt.BudgetOption = None,
    tolerance: ToleranceOption = None,
    robust: opt.RobustOption = None,
    match: opt.MatchOption = None,
    geometry: net.GeometryOption = None,
    fit: BatchFitOption = None,
    unseen: opt.UnseenOption = None,
    checkpoint: net.CheckpointOption = None,
    require_checkpoint: net.RequireCheckpointOption = False,
    replay: ReplayOption = None,
    seed: opt.SeedOption = None,
    threads: opt.ThreadsOption = None,
    json: opt.JsonOption = False,
    quiet: opt.QuietOption = False,
    debug: opt.DebugOption = False,
) -> None:
    """Add new views to a state, which gsmerge decode turns into a compact scene at any time."""
    start = perf_counter()
    hints = reading_of(exporter, quats.value, order.value, scene_scale, max_side)
    if len(scenes) > 1 and (cameras is not None or images is not None):
        raise UsageError("--cameras and --images: expected one batch with them, got several; extend by one at a time")
    from gsmerge.io import find_scene_files
    from gsmerge.online.file import extend_file

    batches = [find_scene_files(scene, cameras=cameras, images=images) for scene in scenes]
    for files in batches:
        if any(path.resolve() == state.resolve() for path in input_files(files)):
            raise UsageError(f"{state}: expected a state other than the input; name another file")
    settings = _given(context.params)
    documents: list[dict[str, Any]] = []
    with announce_compilation(quiet=quiet or json):
        for files in batches:
            before = {"import": perf_counter() - start} if not documents else {}
            with stage_progress(quiet=quiet or json) as progress:
                document = extend_file(
                    state, files, settings, opacity=opacity.value, hints=hints, progress=progress,
                    seconds_before=before,
                )  # fmt: skip
            documents.append(document)
            _tell(document, quiet=quiet or json)
    if json:
        from gsmerge.report import to_json

        sys.stdout.write(to_json({"batches": documents}))


def _given(params: Mapping[str, Any]) -> dict[str, Any]:
    """The settings that were given."""
    from gsmerge.online.options import OnlineOptions
    from gsmerge.options import CompactOptions

    names: Sequence[str] = [*CompactOptions().to_dict(), *OnlineOptions.__dataclass_fields__]
    found = {name: params[name] for name in names if params.get(name) is not None}
    if not found.get("require_checkpoint"):
        found.pop("require_checkpoint", None)
    return {name: value.value if isinstance(value, Enum) else value for name, value in found.items()}


def _tell(document: Mapping[str, Any], *, quiet: bool) -> None:
    """The notes and the line of a batch."""
    from gsmerge.report import human_bytes, seconds_line

    say_notes(document["notes"], quiet=quiet)
    if quiet:
        return
    state, gone = document["state"], document["num_covered"] + document["num_hidden"]
    print(
        one_line(
            f"{state['path']}: batch {state['num_batches']}, {document['num_views']} views,"
            f" {document['num_input']:,} Gaussians -> {document['num_new']:,} groups: {document['num_joined']:,} joined"
            f" others, {gone:,} not needed; {document['num_groups']:,} groups in all,"
            f" {human_bytes(state['bytes'])}; {seconds_line(document)}"
        )
    )
