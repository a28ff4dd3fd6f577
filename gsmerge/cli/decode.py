"""``gsmerge decode``: a compact scene from an encoded one, or from a state of views."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Annotated, Any

import typer

from gsmerge.cli import options as opt
from gsmerge.cli.console import announce_compilation, one_line, say_notes, stage_progress
from gsmerge.cli.paths import check_format, check_output, default_output
from gsmerge.cli.settings import given_settings
from gsmerge.errors import SceneError

if TYPE_CHECKING:
    from gsmerge.options import CompactOptions

EncodedArgument = Annotated[Path, typer.Argument(metavar="ENCODED", help="A .gsm file of gsmerge encode or extend.")]
DecodedFitOption = Annotated[
    opt.Fit | None,
    typer.Option(
        help="What to fit to the photos that a state has kept.",
        show_default="full where there are photos",
        rich_help_panel=opt.MERGING,
    ),
]
DecodedKOption = Annotated[
    str | None,
    typer.Option(
        "--k",
        parser=opt.parse_k,
        metavar="[1-8|auto]",
        help="Gaussians per group, up to what was encoded. auto: as many in all as compact takes without photos.",
        show_default="as encoded",
        rich_help_panel=opt.COUNT,
    ),
]
DecodedBudgetOption = Annotated[
    str | None,
    typer.Option(
        help='Gaussians in the result, such as 40000 or "2%" of the input; at least one per group.',
        rich_help_panel=opt.COUNT,
    ),
]
DecodedOption = Annotated[
    Path | None,
    typer.Option(
        "--output",
        "-o",
        help="The compact scene: .ply, .compressed.ply, .spz or .splat, by its name.",
        show_default="ENCODED.compact.ply",
        rich_help_panel=opt.OUTPUT,
    ),
]


def decode(
    context: typer.Context,
    encoded: EncodedArgument,
    k: DecodedKOption = None,
    budget: DecodedBudgetOption = None,
    fit: DecodedFitOption = None,
    effort: opt.EffortOption = None,
    fit_steps: opt.FitStepsOption = None,
    time_budget: opt.TimeBudgetOption = None,
    device: opt.DeviceOption = None,
    output: DecodedOption = None,
    seed: opt.SeedOption = None,
    threads: opt.ThreadsOption = None,
    overwrite: opt.OverwriteOption = False,
    json: opt.JsonOption = False,
    dry_run: opt.DryRunOption = False,
    quiet: opt.QuietOption = False,
    debug: opt.DebugOption = False,
) -> None:
    """Write a compact scene from an encoded one, as compact --fit none, or from a state, fitted to its photos."""
    start = perf_counter()
    out = output or default_output(encoded)
    check_output(out, (encoded,), overwrite=overwrite)
    check_format(out)
    settings = given_settings(context.params)
    document = _run(encoded, out, settings, context.params, start, quiet=quiet or json)
    say_notes(document["notes"], quiet=quiet or json)
    if json:
        from gsmerge.report import to_json

        sys.stdout.write(to_json(document))
    elif dry_run:
        count = document["output"]["num_gaussians_at_most"]
        print(one_line(f"would write  {out}: at most {count:,} Gaussians"))
    elif not quiet:
        print(one_line(_summary(document)))


def _run(
    path: Path, out: Path, settings: CompactOptions, params: Mapping[str, Any], start: float, *, quiet: bool
) -> dict[str, Any]:
    """Read, decode and write; returns the report."""
    from gsmerge.encoded.decode import plan_decode
    from gsmerge.io import atomic_output, lost_harmonics, output_format, write_gaussians
    from gsmerge.online.decode import check_fit, decodable, decode_stored, default_fit, num_photos
    from gsmerge.online.file import load_stored
    from gsmerge.report import document_head, seconds_document

    imported, wish = perf_counter(), {"k": params["k"], "budget": params["budget"]}
    stored = load_stored(path)
    lost, read = lost_harmonics(out, stored.sh_degree), perf_counter()
    found = {"path": str(path), "bytes": path.stat().st_size, "num_groups": len(stored)}
    document = {
        **document_head(),
        "input": found | {"num_gaussians_encoded": stored.settings.num_input, "encoding": dict(stored.about)},
        **wish,
    }
    notes = [lost] if lost else []
    fit = settings.fit if params["fit"] is not None or num_photos(stored) else default_fit(stored)
    check_fit(stored, fit)
    if params["dry_run"]:
        encoded = decodable(stored)
        plan = plan_decode(encoded, **wish)
        most = int(plan.counts.sum()) + encoded.num_kept
        told = {"dry_run": True, "output": {"path": str(out), "num_gaussians_at_most": most}}
        return document | told | {"notes": [*plan.notes, *notes]}
    with atomic_output(out, overwrite=params["overwrite"]) as temporary:
        with announce_compilation(quiet=quiet), stage_progress(quiet=quiet) as progress:
            decoded = decode_stored(
                stored, **wish, options=fit, seed=settings.seed, threads=settings.threads, progress=progress
            )
        if len(decoded.gaussians) == 0:
            raise SceneError(path, "expected Gaussians that show something, found none", "encode the scene again")
        done, ending = perf_counter(), output_format(out)
        write_gaussians(temporary, decoded.gaussians, overwrite=True, comments=_comments(stored.about), ending=ending)
    seconds = {"import": imported - start, "read": read - imported, "decode": done - read}
    seconds["write"] = perf_counter() - done
    return document | {
        "output": {"path": str(out), "bytes": out.stat().st_size, "num_gaussians": len(decoded.gaussians)},
        "ratio": len(decoded.gaussians) / max(stored.settings.num_input, 1),
        "fit": decoded.fit and asdict(decoded.fit),
        **seconds_document(seconds),
        "notes": [*decoded.notes, *notes],
    }


def _comments(about: Mapping[str, Any]) -> Sequence[str]:
    """Comments of the source's header that compact passes on."""
    source = about.get("source")
    told = source.get("comments") if isinstance(source, dict) else None
    lines = [line for line in told if isinstance(line, str)] if isinstance(told, list) else []
    return [line for line in lines if line.isascii() and line.isprintable()]


def _summary(document: Mapping[str, Any]) -> str:
    """The line that it ends with."""
    from gsmerge.report import human_bytes, seconds_line

    before, after = document["input"], document["output"]
    return (
        f"{after['path']}: {before['num_groups']:,} groups -> {after['num_gaussians']:,} Gaussians"
        f" ({100 * document['ratio']:.2f} % of the scene's), {human_bytes(before['bytes'])} ->"
        f" {human_bytes(after['bytes'])}; {seconds_line(document)}"
    )
