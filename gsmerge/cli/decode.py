"""``gsmerge decode``: a compact scene from an encoded one."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Annotated, Any

import typer

from gsmerge.cli import options as opt
from gsmerge.cli.console import announce_compilation, one_line, say_notes
from gsmerge.cli.paths import check_format, check_output, default_output
from gsmerge.errors import SceneError

if TYPE_CHECKING:
    from gsmerge.stored.encoded import Encoded

EncodedArgument = Annotated[Path, typer.Argument(metavar="ENCODED", help="A .gsm file of gsmerge encode.")]
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
    encoded: EncodedArgument,
    k: DecodedKOption = None,
    budget: DecodedBudgetOption = None,
    output: DecodedOption = None,
    threads: opt.ThreadsOption = None,
    overwrite: opt.OverwriteOption = False,
    json: opt.JsonOption = False,
    dry_run: opt.DryRunOption = False,
    quiet: opt.QuietOption = False,
    debug: opt.DebugOption = False,
) -> None:
    """Write a compact scene from an encoded one, without its images: what compact --fit none gives, and no fit."""
    start = perf_counter()
    out = output or default_output(encoded)
    check_output(out, (encoded,), overwrite=overwrite)
    check_format(out)
    document = _run(encoded, out, {"k": k, "budget": budget}, threads, overwrite, dry_run, start, quiet=quiet or json)
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
    path: Path,
    out: Path,
    wish: Mapping[str, Any],
    threads: int | None,
    overwrite: bool,
    dry_run: bool,
    start: float,
    *,
    quiet: bool,
) -> dict[str, Any]:
    """Read, decode and write; returns the report."""
    from gsmerge.io import atomic_output, lost_harmonics, output_format, write_gaussians
    from gsmerge.report import document_head, seconds_document
    from gsmerge.stored.decode import decode_scene, plan_decode
    from gsmerge.stored.file import load_encoded

    imported = perf_counter()
    encoded = load_encoded(path)
    plan, read = plan_decode(encoded, **wish), perf_counter()
    lost = lost_harmonics(out, encoded.division.children.sh_degree)
    found = {"path": str(path), "bytes": path.stat().st_size, "num_groups": len(encoded)}
    document = {
        **document_head(),
        "input": found | {"num_gaussians_encoded": encoded.settings.num_input, "encoding": dict(encoded.about)},
        **wish,
        "notes": [*plan.notes, *([lost] if lost else [])],
    }
    if dry_run:
        most = int(plan.counts.sum()) + encoded.num_kept
        return document | {"dry_run": True, "output": {"path": str(out), "num_gaussians_at_most": most}}
    with atomic_output(out, overwrite=overwrite) as temporary:
        with announce_compilation(quiet=quiet):
            gaussians = decode_scene(encoded, **wish, threads=threads)
        if len(gaussians) == 0:
            raise SceneError(path, "expected Gaussians that show something, found none", "encode the scene again")
        decoded, ending = perf_counter(), output_format(out)
        write_gaussians(temporary, gaussians, overwrite=True, comments=_comments(encoded), ending=ending)
    seconds = {"import": imported - start, "read": read - imported, "decode": decoded - read}
    seconds["write"] = perf_counter() - decoded
    return document | {
        "output": {"path": str(out), "bytes": out.stat().st_size, "num_gaussians": len(gaussians)},
        "ratio": len(gaussians) / max(encoded.settings.num_input, 1),
        **seconds_document(seconds),
    }


def _comments(encoded: Encoded) -> Sequence[str]:
    """Comments of the source's header that compact passes on."""
    source = encoded.about.get("source")
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
