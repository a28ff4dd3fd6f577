"""``gsmerge encode``: a scene as Feature Gaussians in a file, to be decoded at any K without its images."""

from __future__ import annotations

from collections.abc import Mapping
from time import perf_counter
from typing import Any

from gsmerge.cli import parameters as opt
from gsmerge.cli.console import print_document, say_notes, stage_progress
from gsmerge.cli.paths import check_outputs, checkpoint_files, input_files


@opt.command(
    opt.SCENE,
    opt.output("The encoded scene.", "SCENE.gsm"),
    f"{opt.READING} k max_k superpixels budget effort checkpoint set",
    f"overwrite dry_run {opt.RUN}",
)
def encode(args: opt.Args) -> None:
    """Store a scene as merged Feature Gaussians, from which gsmerge decode makes results of any size."""
    start = perf_counter()
    hints, settings = args.hints(), args.settings(fit="none")
    files = args.files(args.scene)
    out = args.output or files.base.with_suffix(".gsm")
    inputs = (*input_files(files), *checkpoint_files(settings.checkpoint))
    check_outputs((out,), inputs, overwrite=args.overwrite or args.dry_run)
    if args.dry_run:
        from gsmerge.cli.compact_command import print_plan

        print_plan(args, files, settings, out, hints)
        return
    from gsmerge.compaction.files import read_input
    from gsmerge.encoded.gsm_file import save_encoded
    from gsmerge.encoded.to_encoded import encode_scene
    from gsmerge.io import atomic_output
    from gsmerge.report import document_head, file_sha256, seconds_document

    imported = perf_counter()
    with atomic_output(out, overwrite=args.overwrite) as temporary:
        given = read_input(files, opacity=args.opacity, hints=hints)
        read = perf_counter()
        with stage_progress(quiet=args.silent) as progress:
            encoded = encode_scene(given.scene, settings, max_k=args.max_k, progress=progress)
        done = perf_counter()
        hashed: dict[str, Any] = {"sha256": file_sha256(*files.plys)}
        hashed["bytes"] = sum(path.stat().st_size for path in files.plys)
        texts = {"comments": list(given.comments), "notes": list(given.notes)}
        save_encoded(temporary, encoded, overwrite=True, source={"name": files.ply.name, **hashed, **texts})
    seconds = {"import": imported - start, "read": read - imported, "encode": done - read}
    seconds["write"] = perf_counter() - done
    own, size, about = encoded.settings, out.stat().st_size, encoded.about
    counts = {"num_groups": len(encoded), "num_gaussians_at_most": encoded.max_gaussians, "max_k": own.max_k}
    document = {
        **document_head(),
        "input": {"path": str(files.ply), "num_gaussians": own.num_input, **hashed, **given.recognised},
        "output": {"path": str(out), "bytes": size, **counts},
        "ratio_bytes": size / hashed["bytes"],
        "options": about["options"],
        "seed": about["options"]["seed"],
        "choices": about["choices"],
        **seconds_document(seconds),
        "notes": [*given.notes, *about["notes"]],
    }
    say_notes(document["notes"], quiet=args.silent)
    print_document(document, _summary(document), as_json=args.json, quiet=args.quiet)


def _summary(document: Mapping[str, Any]) -> str:
    """Write the line that the command ends with."""
    from gsmerge.report import human_bytes, seconds_line

    scene, file = document["input"], document["output"]
    line = f"{file['path']}: {scene['num_gaussians']:,} Gaussians -> {file['num_groups']:,} groups, "
    line += f"{human_bytes(scene['bytes'])} -> {human_bytes(file['bytes'])} ({100 * document['ratio_bytes']:.0f} %); "
    return f"{line}decodes to {file['num_gaussians_at_most']:,} Gaussians at most; {seconds_line(document)}"
