"""numbers -> a JSON document with a stable schema, one line for people, and an estimate beforehand."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from dataclasses import asdict, is_dataclass
from pathlib import Path
from typing import Any

from gsmerge import __version__

SCHEMA_VERSION = 1

# Seconds on one processor, per million pixels of all views together (or Gaussians, which is the same number).
# Measured on the scenes of benchmarks/; they only have to be right within a factor of two.
COST_FIXED = 2.0
COST_READ = 0.4
COST_SEGMENT = {"fast": 1.0, "default": 2.0, "best": 4.0}
COST_MERGE = 1.5
COST_ROBUST = 6.0
COST_FIT = 3.0
BYTES_FIXED = 400_000_000  # interpreter, torch and numba
BYTES_PER_GAUSSIAN = 160
BYTES_PER_PIXEL = 40  # the photo as floats and what segmentation and rendering keep of it


def file_sha256(path: Path) -> str:
    """Hexadecimal SHA-256 of a file."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest() if hasattr(hashlib, "file_digest") else _digest(file)


def _digest(file: Any) -> str:
    state = hashlib.sha256()
    while block := file.read(1 << 20):
        state.update(block)
    return state.hexdigest()


def report_document(report: Any, *, input_path: Path, output_path: Path, seconds: Mapping[str, float]) -> dict[str, Any]:
    """The report of one ``compact`` as plain JSON types.

    Args:
        report: The :class:`gsmerge.CompactReport`.
        input_path: The ``.ply`` that was read; hashed here.
        output_path: The ``.ply`` that was written.
        seconds: Wall time of the stages outside the report (imports, reading, writing), by name.

    Returns:
        ``schema_version`` 1: tool, input, output, ratio, options, seed, choices, seconds, psnr, memory, notes.
        Keys are only ever added within one schema version.
    """
    numbers = asdict(report) if is_dataclass(report) and not isinstance(report, type) else dict(report)
    stages = {**seconds, **numbers["seconds"]}
    return {
        "schema_version": SCHEMA_VERSION,
        "tool": {"name": "gsmerge", "version": __version__},
        "input": {
            "path": os.fspath(input_path),
            "sha256": file_sha256(input_path),
            "bytes": input_path.stat().st_size,
            "num_gaussians": numbers["num_input"],
        },
        "output": {
            "path": os.fspath(output_path),
            "bytes": output_path.stat().st_size,
            "num_gaussians": numbers["num_output"],
        },
        "ratio": numbers["num_output"] / max(numbers["num_input"], 1),
        "options": numbers["options"],
        "seed": numbers["options"]["seed"],
        "choices": numbers["choices"],
        "seconds": {name: round(value, 4) for name, value in stages.items()},
        "total_seconds": round(sum(stages.values()), 4),
        "psnr_input_views": {"before": numbers["psnr_before"], "after": numbers["psnr_after"]},
        "peak_memory_bytes": numbers["peak_memory_bytes"],
        "notes": list(numbers["notes"]),
    }


def to_json(document: Mapping[str, Any]) -> str:
    """Strict JSON, indented, with a closing newline; infinities become null."""
    return json.dumps(_finite(document), indent=2, allow_nan=False) + "\n"


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    if isinstance(value, float) and not (abs(value) < float("inf")):
        return None
    return value


def summary_line(document: Mapping[str, Any]) -> str:
    """The one line that ``compact`` ends with: counts, ratio, bytes, PSNR, seconds per stage."""
    before, after = document["input"], document["output"]
    psnr = document["psnr_input_views"]
    quality = (
        f"; input views {psnr['before']:.2f} -> {psnr['after']:.2f} dB"
        if psnr["before"] is not None and psnr["after"] is not None
        else ""
    )
    stages = ", ".join(f"{name} {value:.2f}" for name, value in document["seconds"].items())
    return (
        f"{after['path']}: {before['num_gaussians']:,} -> {after['num_gaussians']:,} Gaussians"
        f" ({100 * document['ratio']:.2f} %), {human_bytes(before['bytes'])} -> {human_bytes(after['bytes'])}"
        f"{quality}; {document['total_seconds']:.1f} s ({stages})"
    )


def human_bytes(count: float) -> str:
    """``1234567`` -> ``1.2 MB`` (powers of ten)."""
    for unit in ("B", "kB", "MB"):
        if count < 1000:
            return f"{count:.0f} {unit}" if unit == "B" else f"{count:.1f} {unit}"
        count /= 1000
    return f"{count:.1f} GB"


def estimate(
    num_gaussians: int, num_views: int, height: int, width: int, options: Mapping[str, Any], *, images: bool, threads: int
) -> dict[str, Any]:
    """What a run will make of a scene, before it is read.

    Args:
        num_gaussians: Rows of the input.
        num_views: Views.
        height: Image height, pixels.
        width: Image width, pixels.
        options: Flat resolved options, as of ``CompactOptions.to_dict()``.
        images: Whether photos are there; robust merging and the colour fit need them.
        threads: Threads that will run.

    Returns:
        ``superpixels_per_view``, ``num_output_at_most``, ``seconds`` and ``memory_bytes``; the last two hold
        within a factor of about two on a common processor, kernels already compiled.
    """
    million = num_views * height * width / 1e6
    per_view = options.get("superpixels") or max(1, round(options["density"] * height * width))
    seconds = million * (COST_READ + COST_MERGE + COST_SEGMENT.get(options["preset"], COST_SEGMENT["best"]))
    robust = bool(options["robust"]) and images and num_views >= 3
    fitted = options["fit"] != "none" and images
    seconds += million * (COST_ROBUST * robust + COST_FIT * fitted)
    pixels = num_views * height * width if images else 0
    return {
        "superpixels_per_view": per_view,
        "num_output_at_most": min(num_gaussians, per_view * num_views * options["k"]),
        "robust": robust,
        "fit": options["fit"] if fitted else "none",
        "seconds": round(COST_FIXED + seconds / min(threads, num_views), 1),
        "memory_bytes": BYTES_FIXED + BYTES_PER_GAUSSIAN * num_gaussians + BYTES_PER_PIXEL * pixels,
    }
