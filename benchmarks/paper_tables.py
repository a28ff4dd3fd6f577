"""The superpixel merging paper's tables with ``recipe=paper``: its section of docs/results.md, as Markdown.

python benchmarks/paper_tables.py                                 # finished runs are kept, so it can be stopped
python benchmarks/paper_tables.py --page docs/results.md          # and the section there is replaced
python benchmarks/paper_tables.py fox,fern --only views sizes --no-lpips

The recipe has no budget, so K counts; what it is compared with has as many Gaussians as K = 1. Every result is made
once and scored once, on the visible pixels of held-out photos.
"""

from __future__ import annotations

import argparse
import re
import sys
import tempfile
import textwrap
from collections.abc import Callable, Iterator, Sequence, Sized
from pathlib import Path

import numpy as np
import printed_figures as printed
from networks import Store, applies, words
from page_tables import make_table
from paper_runs import (
    COUNTS,
    FIT,
    INPUT,
    MOMENTS,
    PHOTO_SIDE,
    PLAIN,
    RESIZED,
    SIZES,
    STYLE_WAYS,
    STYLES,
    VARIANTS,
    VIEW_WAYS,
    WHOLE,
    Bench,
    Case,
    Runs,
    Way,
    num_views,
)  # fmt: skip
from shared_scenes import scene_folders

from gsmerge.measure.lpips import INSTALL, lpips_available
from gsmerge.networks.checkpoint import IN_PACKAGE, load_checkpoint
from gsmerge.research.charts.lines import Interval, mean_interval

TITLE = "## The paper's own method"


def mean_cell(runs: Runs) -> str:
    """Means of PSNR / SSIM / LPIPS over the scenes."""
    means = np.mean([run["seen"] for run in runs.values()], 0)
    return "/".join(f"{value:.{3 if i else 2}f}" for i, value in enumerate(means))


def share(runs: Runs) -> str:
    return f"{100 * np.mean([run['ratio'] for run in runs.values()]):.1f}%"


def compared(runs: Runs, whole: Runs) -> str:
    """A way's figures, and its PSNR less that of the recipe."""
    return mean_cell(runs) + (f" ({plus_minus(difference(runs, whole))})" if runs is not whole else "")


def difference(runs: Runs, whole: Runs) -> Interval:
    """PSNR of some runs less that of others, paired by scene."""
    mine, theirs = ({scene: run["seen"][0] for scene, run in some.items()} for some in (runs, whole))
    return mean_interval([mine[scene] - theirs[scene] for scene in mine if scene in theirs])


def plus_minus(interval: Interval) -> str:
    return f"{interval.mean:+.2f} ±{interval.high - interval.mean:.2f}"


def over_counts(bench: Bench, way: Way) -> Runs:
    """Each scene's means over the numbers of views that it has, as the paper averages."""
    by_count = [bench.runs(way, Case(views=count)) for count in bench.counts]
    means: Runs = {}
    for scene in by_count[0]:
        some = [runs[scene] for runs in by_count if scene in runs]
        means[scene] = {name: np.mean([run[name] for run in some], 0) for name in ("ratio", "seen")}
    return means


def views_section(bench: Bench) -> str:
    """Numbers of views, and what the figures are of."""
    rows, whole = [], over_counts(bench, WHOLE)
    for way in VIEW_WAYS:
        runs = whole if way is WHOLE else over_counts(bench, way)
        cells = [mean_cell(bench.runs(way, Case(views=count))) for count in bench.counts]
        gain = "" if way is WHOLE else words(difference(runs, whole))
        rows.append((way.name, share(runs), *cells, mean_cell(runs), gain))
    for way in VIEW_WAYS:
        if way.key in printed.VIEWS:
            kept, *cells, mean = printed.VIEWS[way.key]
            cells = [cell for count, cell in zip(COUNTS, cells, strict=True) if count in bench.counts]
            rows.append((f"printed: {way.name}", kept, *cells, mean, ""))
    names = [f"{count} views ({captures(bench.runs(WHOLE, Case(views=count)))})" for count in bench.counts]
    head = ("", "kept", *names, "mean", "PSNR less K = 1 (95%)")
    text = """Mean: of each capture over the numbers of views that it has, then over the captures. Our depth was always
    predicted from all input views, the paper's from those of the column. Printed: with Depth Anything 3."""
    return section("By number of views", text, make_table(head, rows))


def sizes_section(bench: Bench) -> str:
    rows = []
    for size in SIZES:
        case = Case(size=size)
        whole = bench.runs(WHOLE, case)
        cells = [compared(bench.runs(way, case), whole) for way in (MOMENTS, FIT)]
        rows.append((size, share(whole), mean_cell(whole), *cells, printed.SIZES.get(size, "")))
    head = ("superpixels", "kept", "the recipe", MOMENTS.name, FIT.name, "printed: AnySplat")
    text = """All views, K = 1, equal counts. In brackets: PSNR less that of the recipe, with the 95 % interval."""
    return section("By size", text, make_table(head, rows))


def backbones_section(bench: Bench) -> str:
    rows, before = [], bench.runs(INPUT, PLAIN)
    cases = [PLAIN, *(Case(style) for style in STYLES)]
    wholes = [bench.runs(WHOLE, case) for case in cases]
    for way in STYLE_WAYS:
        cells = []
        for case, whole in zip(cases, wholes, strict=True):
            runs = whole if way is WHOLE else bench.runs(way, case)
            kept = np.mean([run["count"] / before[scene]["count"] for scene, run in runs.items()])
            less = "" if runs is whole else f" ({difference(runs, whole).mean:+.2f})"
            cells.append(f"{100 * kept:.1f}%: {mean_cell(runs)}{less}")
        rows.append((way.name, *cells, *printed.BACKBONES.get(way.key, ("",) * 3)))
    names = ("DA3", "DepthSplat", "AnySplat, voxels")
    head = ("", "plain", *STYLES[:2], "anysplat, voxels", *(f"printed: {name}" for name in names))
    text = """All views, one depth network, written as four programs write their files. Percentages are of one Gaussian
    per pixel; in brackets: PSNR less that of K = 1."""
    return section("By backbone, and of voxels", text, make_table(head, rows))


def ablation_section(bench: Bench) -> str:
    whole = bench.runs(WHOLE, PLAIN)
    known: list[tuple[str, Runs, Runs]] = [("the whole", whole, whole)]
    checkpoint = bench.files["paper"]
    known += [(way.name, bench.runs(way, PLAIN), whole) for way in VARIANTS if applies(way, checkpoint)]
    known += [(name, bench.runs(WHOLE, Case(size=size)), whole) for size, name in RESIZED.items()]
    rows = []
    for name, runs, base in known:
        kept = f"{100 * np.mean([run['matched'] for run in runs.values()]):.0f}%"
        gain = "" if runs is base else words(difference(runs, base))
        rows.append((name, kept, share(runs), mean_cell(runs), gain, printed.ABLATION.get(name, "")))
    names = ("groups kept across views", "kept", "the recipe", "PSNR less the whole (95%)")
    text = "All views, K = 1."
    return section("Without a part", text, make_table(("", *names, "printed: AnySplat"), rows))


def captures(some: Sized) -> str:
    return "1 capture" if len(some) == 1 else f"{len(some)} captures"


SECTIONS: dict[str, Callable[[Bench], str]] = {
    "views": views_section,
    "sizes": sizes_section,
    "backbones": backbones_section,
    "ablation": ablation_section,
}


def planned(parts: Sequence[str], bench: Bench) -> Iterator[tuple[Way, Case]]:
    """What the sections need, so that each scene is read once."""
    if "views" in parts:
        yield from ((way, Case(views=count)) for count in bench.counts for way in VIEW_WAYS)
    if "sizes" in parts:
        yield from ((way, Case(size=size)) for size in SIZES for way in (WHOLE, MOMENTS, FIT))
    if "ablation" in parts:
        yield from ((way, PLAIN) for way in (WHOLE, *VARIANTS) if applies(way, bench.files["paper"]))
        yield from ((WHOLE, Case(size=size)) for size in RESIZED)
    if "backbones" in parts:
        yield from ((way, PLAIN) for way in STYLE_WAYS)
        yield from ((way, Case(style)) for style in STYLES for way in STYLE_WAYS)


def head_section(bench: Bench) -> str:
    """What the figures are of, and how the paper's differ."""
    training = load_checkpoint(bench.files["paper"]).training
    steps, scenes = training["step"], len(training["data"])
    names = ", ".join(f"{folder.name} ({num_views(folder)} views)" for folder in bench.folders)
    how = f"""`--set recipe=paper`: BASS superpixels, encoder, geometry of the head for K = 1, matching by latents and
    boxes, merger, refiner, heads, pruning by opacity, no fit and no budget; 5.3 % superpixels before merging, unless a
    table says otherwise. `moment-matching` and the defaults have at most as many Gaussians as the recipe with K = 1.
    Cells are means of PSNR/SSIM/LPIPS, photos at {PHOTO_SIDE} pixels, held-out views, pixels that the input views see;
    intervals are 95 % t intervals of differences paired by capture. `python benchmarks/paper_tables.py --page
    docs/results.md` writes this section."""
    data = f"""Captures: {names}. [Networks](internals/networks.md) were trained for {steps:,} steps on {scenes} scenes.
    Printed: the paper's own figures, of DL3DV-Bench, MipNeRF360 and Tanks and Temples, with the backbone that is named,
    and networks trained for 300,000 steps on DL3DV-10K. The two compare only in order and differences."""
    return "\n\n".join((TITLE, filled(how), filled(data)))


def section(title: str, text: str, *tables: str) -> str:
    return "\n\n".join((f"### {title}", filled(text), *tables))


def filled(text: str) -> str:
    """A paragraph in lines of the pages' length."""
    return textwrap.fill(" ".join(text.split()), 120, break_long_words=False, break_on_hyphens=False)


def replace_section(page: Path, section: str) -> None:
    """Put the section in the place of the one with its title; its parts that are written by hand stay, at the end."""
    text = page.read_text(encoding="utf-8")
    old = re.search(rf"^{re.escape(TITLE)}\n.*?(?=^## |\Z)", text, re.DOTALL | re.MULTILINE)
    if old is None:
        raise SystemExit(f"{page}: expected a section {TITLE!r}, found none")
    parts = re.findall(r"^### .*?(?=^### |\Z)", old[0], re.DOTALL | re.MULTILINE)
    kept = [part.strip() for part in parts if part.splitlines()[0] not in section.splitlines()]
    new = "\n\n".join((section, *kept)) + "\n\n"
    page.write_text(text[: old.start()] + new + text[old.end() :], encoding="utf-8")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("scenes", nargs="?", default="eval", help="train, eval, or names with commas between")
    parser.add_argument("--only", nargs="*", default=list(SECTIONS), choices=list(SECTIONS))
    parser.add_argument("--no-lpips", dest="lpips", action="store_false")
    parser.add_argument("--checkpoint", type=Path, default=IN_PACKAGE["paper"], help="networks of the recipe")
    parser.add_argument("--page", type=Path, help="replace the section of this page")
    parser.add_argument("--cache", type=Path, default=Path(tempfile.gettempdir()) / "gsmerge-benchmarks")
    args = parser.parse_args()
    folders = scene_folders(args.scenes)
    if args.lpips and not lpips_available("vgg"):
        parser.error(f"LPIPS needs weights: {INSTALL}; or give --no-lpips")
    if args.page and len(args.only) < len(SECTIONS):
        parser.error("--page: expected all parts, of which a page's section consists")
    args.cache.mkdir(parents=True, exist_ok=True)
    files = {"paper": args.checkpoint}
    store = Store(args.cache / "paper_tables.jsonl")
    bench = Bench(folders, store, args.cache, files, args.lpips)
    for folder in bench.folders:
        for way, case in planned(args.only, bench):
            if num_views(folder) >= (case.views or 0):
                bench.run(folder, way, case)
    sections = [head_section(bench), *(SECTIONS[name](bench) for name in args.only)]
    text = "\n\n".join(sections)
    print(text)
    print(f"{bench.spent / 60:.1f} processor minutes", file=sys.stderr)
    if args.page:
        replace_section(args.page, text)


if __name__ == "__main__":
    main()
