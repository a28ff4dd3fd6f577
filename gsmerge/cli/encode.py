"""``gsmerge encode``: a scene as Feature Gaussians in a file, to be decoded at any K without its images."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Annotated, Any

import typer

from gsmerge.cli import network_options as net
from gsmerge.cli import options as opt
from gsmerge.cli.compact import print_plan
from gsmerge.cli.console import announce_compilation, one_line, say_notes, stage_progress
from gsmerge.cli.paths import check_output, input_files
from gsmerge.cli.settings import given_settings, reading_of

if TYPE_CHECKING:
    from gsmerge.encoded.encoded import Encoded
    from gsmerge.io import ReadHints, SceneFiles
    from gsmerge.io.formats.ply import OpacityChoice
    from gsmerge.options import CompactOptions

MaxKOption = Annotated[
    int | None,
    typer.Option(
        min=1,
        max=8,
        help="Most Gaussians per superpixel that can be decoded: more take more space.",
        show_default="4, or 8 with a --budget",
        rich_help_panel=opt.COUNT,
    ),
]
EncodedOption = Annotated[
    Path | None,
    typer.Option("--output", "-o", help="The encoded scene.", show_default="SCENE.gsm", rich_help_panel=opt.OUTPUT),
]


def encode(
    context: typer.Context,
    scene: opt.SceneArgument,
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
    max_k: MaxKOption = None,
    budget: opt.BudgetOption = None,
    max_bytes: opt.MaxBytesOption = None,
    preset: opt.PresetOption = None,
    robust: opt.RobustOption = None,
    match: opt.MatchOption = None,
    geometry: net.GeometryOption = None,
    unseen: opt.UnseenOption = None,
    checkpoint: net.CheckpointOption = None,
    require_checkpoint: net.RequireCheckpointOption = False,
    output: EncodedOption = None,
    seed: opt.SeedOption = None,
    threads: opt.ThreadsOption = None,
    overwrite: opt.OverwriteOption = False,
    json: opt.JsonOption = False,
    dry_run: opt.DryRunOption = False,
    quiet: opt.QuietOption = False,
    debug: opt.DebugOption = False,
) -> None:
    """Keep a scene as merged Feature Gaussians, of which gsmerge decode makes what compact --fit none makes."""
    start = perf_counter()
    hints = reading_of(exporter, quats.value, order.value, scene_scale, max_side)
    from gsmerge.io import find_scene_files

    files = find_scene_files(scene, cameras=cameras, images=images)
    out = output or files.ply.with_suffix(".gsm")
    check_output(out, (*input_files(files), *net.checkpoint_files(checkpoint)), overwrite=overwrite)
    settings = given_settings({**context.params, "fit": "none"})
    if dry_run:
        print_plan(files, settings, out, opacity=opacity.value, hints=hints, as_json=json)
        return
    document = _run(
        files, settings, out, max_k, opacity=opacity.value, hints=hints, overwrite=overwrite, quiet=quiet or json,
        start=start,
    )  # fmt: skip
    say_notes(document["notes"], quiet=quiet or json)
    if json:
        from gsmerge.report import to_json

        sys.stdout.write(to_json(document))
    elif not quiet:
        print(one_line(_summary(document)))


def _run(
    files: SceneFiles,
    settings: CompactOptions,
    out: Path,
    max_k: int | None,
    *,
    opacity: OpacityChoice,
    hints: ReadHints,
    overwrite: bool,
    quiet: bool,
    start: float,
) -> dict[str, Any]:
    """Read, encode and write; returns the report."""
    from gsmerge.compact_file import read_input
    from gsmerge.encoded.encode import encode_scene
    from gsmerge.encoded.gsm_file import save_encoded
    from gsmerge.io import atomic_output
    from gsmerge.report import file_sha256

    imported = perf_counter()
    with atomic_output(out, overwrite=overwrite) as temporary:
        given = read_input(files, opacity=opacity, hints=hints)
        read = perf_counter()
        with announce_compilation(quiet=quiet), stage_progress(quiet=quiet) as progress:
            encoded = encode_scene(given.scene, settings, max_k=max_k, progress=progress)
        done = perf_counter()
        source = {"name": files.ply.name, "sha256": file_sha256(files.ply), "bytes": files.ply.stat().st_size}
        source |= {"comments": list(given.comments), "notes": list(given.notes)}
        save_encoded(temporary, encoded, overwrite=True, source=source)
    seconds = {"import": imported - start, "read": read - imported, "encode": done - read}
    seconds["write"] = perf_counter() - done
    return _document(files.ply, out, encoded, source | given.recognised, given.notes, seconds)


def _document(
    ply: Path,
    out: Path,
    encoded: Encoded,
    found: Mapping[str, Any],
    notes: Sequence[str],
    seconds: Mapping[str, float],
) -> dict[str, Any]:
    """The report as plain JSON types."""
    from gsmerge.report import document_head, seconds_document

    settings, size = encoded.settings, out.stat().st_size
    told = {name: value for name, value in found.items() if name not in ("name", "comments", "notes")}
    counts = {"num_groups": len(encoded), "num_gaussians_at_most": encoded.max_gaussians, "max_k": settings.max_k}
    return {
        **document_head(),
        "input": {"path": str(ply), "num_gaussians": settings.num_input, **told},
        "output": {"path": str(out), "bytes": size, **counts},
        "ratio_bytes": size / found["bytes"],
        "options": encoded.about["options"],
        "seed": encoded.about["options"]["seed"],
        "choices": encoded.about["choices"],
        **seconds_document(seconds),
        "notes": [*notes, *encoded.about["notes"]],
    }


def _summary(document: Mapping[str, Any]) -> str:
    """The line that it ends with."""
    from gsmerge.report import human_bytes, seconds_line

    before, after = document["input"], document["output"]
    return (
        f"{after['path']}: {before['num_gaussians']:,} Gaussians -> {after['num_groups']:,} groups,"
        f" {human_bytes(before['bytes'])} -> {human_bytes(after['bytes'])} ({100 * document['ratio_bytes']:.0f} %);"
        f" decodes to {after['num_gaussians_at_most']:,} Gaussians at most; {seconds_line(document)}"
    )
